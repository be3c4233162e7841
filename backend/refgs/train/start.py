"""Make the initial parameters of the surfels: geometry, colour and material."""

import math
from typing import NamedTuple

import numpy as np

from refgs.capture import Capture, LoadedView
from refgs.capture.first_points import FirstPoints, first_points
from refgs.model.surfels import Parameters, initial_parameters
from refgs.render.baselines import axes_of
from refgs.settings import Settings, SurfelSettings

GEOMETRY = ("position", "rotation", "scale", "opacity")
FAINT = 0.1  # largest opacity of points that may not lie on the surface


class Start(NamedTuple):
    """Hold the initial `parameters` of the surfels, and the `points` at which they start."""

    parameters: Parameters
    points: FirstPoints

    @property
    def on_hull(self) -> int:
        """Count the surfels on the visual hull, which come first. Without a hull, count all."""
        return len(self.points.positions) if self.points.on_hull is None else self.points.on_hull

    @property
    def said(self) -> str:
        """Tell the user where the surfels start."""
        return f"{len(self.points.positions)} surfels start on {self.points.source}"


def start_parameters(capture: Capture, views: list[LoadedView], settings: Settings, hollows: bool = False) -> Start:
    """Make the initial parameters of the surfels. `first_points` chooses their positions; `hollows` is passed on to it."""
    points = first_points(capture, views, settings.surfels, settings.train.seed, hollows)
    opacity = settings.surfels.opacity
    parameters = _initial(points, settings.surfels, min(opacity, FAINT) if points.on_hull is None else opacity)
    start = Start(parameters, points)
    parameters["opacity"].data[start.on_hull :].clamp_(max=math.log(FAINT / (1 - FAINT)))
    return start


def start_appearance(settings: Settings) -> Parameters:
    """Make the initial colour and material parameters, each with one row for all surfels."""
    one = FirstPoints(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.ones(1), None, None, None, "")
    made = _initial(one, settings.surfels, 0.5)
    return {name: value.detach() for name, value in made.items() if name not in GEOMETRY}


def _initial(points: FirstPoints, surfels: SurfelSettings, opacity: float) -> Parameters:
    return initial_parameters(
        points.positions,
        points.normals,
        points.spacing,
        points.colours,
        axes=axes_of(surfels),
        opacity=opacity,
        sh_degree=surfels.sh_degree,
        albedo=surfels.albedo,
        metallic=surfels.metallic,
        roughness=surfels.roughness,
    )
