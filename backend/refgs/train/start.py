"""Where surfels start: on the visual hull, on structure-from-motion points, or at random."""

import math

import numpy as np
from scipy.spatial import cKDTree

from refgs.capture import Capture, LoadedView
from refgs.geometry.hull import visual_hull_points
from refgs.model.surfels import Parameters, initial_parameters
from refgs.settings import Settings, SurfelSettings

GEOMETRY = ("position", "rotation", "scale", "opacity")
FAINT = 0.1  # opacity, at the most, of points that may lie anywhere


def start_parameters(capture: Capture, views: list[LoadedView], settings: Settings) -> tuple[Parameters, str]:
    """Initial parameters and one line that says where they came from."""
    count, seed = min(settings.surfels.start, settings.surfels.budget), settings.train.seed
    colours, opacity, shown = None, settings.surfels.opacity, count
    if all(view.alpha is not None for view in views):
        shown = on_hull(count, settings.surfels)
        positions, normals, spacing = visual_hull_points(
            [view.alpha for view in views],
            [view.camera for view in views],
            capture.centre,
            capture.radius,
            count,
            resolution=settings.surfels.hull,
            seed=seed,
            on_hull=shown,
        )
        source = "the visual hull of the masks"
    elif capture.points is not None and len(capture.points) >= 100:
        positions, colours = _thinned(capture.points, capture.point_colors, count, seed)
        normals, spacing, opacity = _towards_cameras(positions, views), _spacing(positions), min(opacity, FAINT)
        source = f"{len(positions)} structure-from-motion points"
    else:
        positions = _random(capture, count, seed)
        normals, spacing, opacity = _towards_cameras(positions, views), _spacing(positions), min(opacity, FAINT)
        source = "random points (no masks and no structure-from-motion points)"
    parameters = _initial(positions, normals, spacing, colours, settings.surfels, opacity)
    parameters["opacity"].data[shown:].clamp_(max=math.log(FAINT / (1 - FAINT)))
    return parameters, f"{len(positions)} surfels start on {source}"


def on_hull(count: int, settings: SurfelSettings) -> int:
    """How many of the surfels start on the visual hull; those that follow start inside, where it has hollows that no mask shows."""
    return max(1, count - round(settings.inside * count))


def start_appearance(settings: Settings) -> Parameters:
    """Colour and material as they start, one row for all surfels; without gradients."""
    one = _initial(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.ones(1), None, settings.surfels, 0.5)
    return {name: value.detach() for name, value in one.items() if name not in GEOMETRY}


def _initial(positions, normals, spacing, colours, surfels: SurfelSettings, opacity: float) -> Parameters:
    return initial_parameters(
        positions,
        normals,
        spacing,
        colours,
        axes=3 if surfels.primitive == "3dgs" else 2,
        opacity=opacity,
        sh_degree=surfels.sh_degree,
        albedo=surfels.albedo,
        metallic=surfels.metallic,
        roughness=surfels.roughness,
    )


def _thinned(points: np.ndarray, colours: np.ndarray | None, count: int, seed: int):
    if len(points) > count:
        chosen = np.random.default_rng(seed).choice(len(points), count, replace=False)
        points, colours = points[chosen], None if colours is None else colours[chosen]
    return points, colours


def _random(capture: Capture, count: int, seed: int) -> np.ndarray:
    """Uniform in the ball of interest; where the capture is a room, half of them beyond it, uniform in inverse distance."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = np.cbrt(rng.random(count))
    if not capture.bounded:
        distance[::2] = 1 / rng.uniform(0.1, 1, len(distance[::2]))
    return capture.centre + capture.radius * distance[:, None] * direction


def _towards_cameras(positions: np.ndarray, views: list[LoadedView]) -> np.ndarray:
    """Unit vectors (N, 3) from each point to the nearest camera: a surface that was seen faces someone."""
    cameras = np.stack([view.camera.position for view in views])
    towards = cameras[cKDTree(cameras).query(positions)[1]] - positions
    return towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)


def _spacing(positions: np.ndarray) -> np.ndarray:
    """Mean distance (N,) to the three nearest neighbours."""
    k = min(4, len(positions))
    distance = cKDTree(positions).query(positions, k=k)[0][:, 1:] if k > 1 else np.ones((len(positions), 1))
    return np.maximum(distance.mean(axis=1), 1e-7)
