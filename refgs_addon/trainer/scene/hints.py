"""Find the splats that the artist calls metal or paint, and write them as a hint for the trainer.

The trainer keeps the hinted splats metal or paint when it trains again.
"""

import json
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector
from mathutils.kdtree import KDTree

from ...errors import InputError
from ...scene.atomic_file import atomic_write
from ...scene.deleted_splats import points_of
from ...scene.regions import REGION
from ...scene.splat_cloud import splat_axes
from .questions import KINDS

HALF = 0.5  # of the light along a ray, which the splats in front let through at the splat that is under the cursor
SOLID = 0.2  # opacity of splats that make up a surface; fainter ones belong to the part of the nearest solid one
NEIGHBOURS = 13  # the splat itself is among them
MOST = 0.6  # of a splat's neighbours that are in a part, above which it belongs there, whatever its normal
BEND = np.cos(np.radians(15))  # of the normals of two neighbours on a smooth surface; at a crease they differ more
LIFT = 0.004  # of the highlight above the surface, in the run's longest side: the mesh may lie above the splats
STEP = 0.35  # sine of the angle between a smooth surface and the line to a neighbour on it


def chosen_part(splats: bpy.types.Object, active: bpy.types.Object | None) -> np.ndarray | None:
    """Return the positions (P, 3) of the splats that the artist has chosen, in the splats' coordinates. Returns None if none are chosen.

    In Edit Mode, these are the selected points (see `deleted_splats.add_points`). Otherwise, they are the splats in the box or ball that is
    the `active` object (see `regions.add_region`).
    """
    points = points_of(splats)
    if points is not None and points.mode == "EDIT":
        points.update_from_editmode()
        vertices = points.data.vertices
        chosen = np.empty(len(vertices), bool)
        vertices.foreach_get("select", chosen)
        places = np.empty(3 * len(vertices), np.float32)
        vertices.foreach_get("co", places)
        return places.reshape(-1, 3)[chosen] if chosen.any() else None
    if active is None or REGION not in active or active.type != "EMPTY" or active.empty_display_type == "ARROWS":
        return None
    places = _attribute(splats, "position", "vector", 3)
    matrix = np.array(active.matrix_world.inverted_safe() @ _to_world(splats))
    inside = np.abs(places @ matrix[:3, :3].T + matrix[:3, 3])
    inside /= max(active.empty_display_size, 1e-12)
    chosen = (np.linalg.norm(inside, axis=1) if active.empty_display_type == "SPHERE" else inside.max(axis=1)) <= 1
    return places[chosen] if chosen.any() else None


def part_at(splats: bpy.types.Object, origin: Vector, direction: Vector) -> np.ndarray:
    """Find the part of the surface that a ray hits first. Returns the positions (P, 3) of that part's splats, in the splats' coordinates.

    A part is a piece of the surface without creases. Changes of the trained material do not end a part, because that material may be wrong.
    `origin` and `direction` of the ray are in world space. Raises InputError if the ray hits no splat.
    """
    surface = Surface(splats)
    seed = surface.hit(origin, direction)
    if seed is None:
        raise InputError("no splat is under the cursor: click on the part")
    return surface.position[surface.smooth_part(seed)]


class Surface:
    """Hold the splats of a run, read once, to find the parts under a mouse that moves."""

    def __init__(self, splats: bpy.types.Object):
        self._matrix = _to_world(splats)
        self.position, self._scale, self._normal = (
            _attribute(splats, name, "vector", 3) for name in ("position", "scale", "normal")
        )
        self._opacity = _attribute(splats, "opacity", "value", 1)[:, 0]
        self._axes = splat_axes(_attribute(splats, "rotation", "value", 4))

    def hit(self, origin: Vector, direction: Vector) -> int | None:
        """Return the index of the splat that a ray in world space hits first, or None."""
        inverse = self._matrix.inverted_safe()
        start, along = np.array(inverse @ origin), np.array(inverse.to_3x3() @ direction)
        normal, towards = np.cross(*self._axes), self.position - start
        slope = normal @ along
        distance = np.einsum("na,na->n", normal, towards) / np.where(np.abs(slope) < 1e-9, np.inf, slope)
        offset = distance[:, None] * along - towards
        u, v = (np.einsum("na,na->n", offset, axis) / self._scale[:, i] for i, axis in enumerate(self._axes))
        alpha = self._opacity * np.exp(-0.5 * (u * u + v * v)) * (distance > 0)
        hit = np.flatnonzero(alpha > 1 / 255)
        if not len(hit):
            return None
        hit = hit[np.argsort(distance[hit])]
        through = np.cumprod(1 - alpha[hit])
        return int(hit[min(np.searchsorted(-through, -HALF), len(hit) - 1)])

    def smooth_part(self, seed: int) -> np.ndarray:
        """Return a mask (N,) of the splats that a crease-free surface connects to the `seed`."""
        solid, near, owner = self._neighbours
        seed = owner[seed]
        part = np.arange(len(self.position)) == seed
        front = np.array([seed])
        while len(front):
            pairs = np.repeat(front, near.shape[1]), near[front].ravel()
            line = self.position[pairs[1]] - self.position[pairs[0]]
            line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-12)
            lifted = np.maximum(*(np.abs(np.einsum("na,na->n", self._normal[ends], line)) for ends in pairs))
            smooth = np.einsum("na,na->n", *(self._normal[ends] for ends in pairs)) > BEND
            front = np.unique(pairs[1][smooth & (lifted < STEP) & ~part[pairs[1]]])
            part[front] = True
        while (gaps := solid & ~part & (part[near].mean(axis=1) > MOST)).any():
            part |= gaps
        return part[owner]

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of the splats nearest to the `points` (P, 3)."""
        tree, part = _tree(self.position, range(len(self.position))), np.zeros(len(self.position), bool)
        part[[tree.find(point)[1] for point in points]] = True
        return part

    def corners(self, part: np.ndarray) -> np.ndarray:
        """Return the corners (P, 4, 3) of the splats in `part`, a mask (N,), in world space. They lie a little above the surface."""
        u, v = (axis[part] * self._scale[part, i, None] for i, axis in enumerate(self._axes))
        centre = self.position[part] + LIFT * np.ptp(self.position, axis=0).max() * self._normal[part]
        matrix = np.array(self._matrix)
        return (
            np.stack([centre - u - v, centre + u - v, centre + u + v, centre - u + v], 1) @ matrix[:3, :3].T
            + matrix[:3, 3]
        )

    @cached_property
    def _neighbours(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the mask (N,) of solid splats, the indices (N, K) of their neighbours, and of each splat's nearest solid one (N,)."""
        solid = self._opacity >= SOLID
        if not solid.any():
            solid[:] = True
        rows, owner = np.flatnonzero(solid), np.arange(len(solid))
        tree = _tree(self.position, rows)
        near = np.zeros((len(solid), min(NEIGHBOURS, len(rows))), int)
        near[rows] = [[other for _, other, _ in tree.find_n(self.position[row], near.shape[1])] for row in rows]
        for row in np.flatnonzero(~solid):
            owner[row] = tree.find(self.position[row])[1]
        return solid, near, owner


def _tree(places: np.ndarray, rows: Iterable[int]) -> KDTree:
    """Return a tree of the `rows` of `places` (N, 3)."""
    rows = list(rows)
    tree = KDTree(len(rows))
    for row in rows:
        tree.insert(places[row], row)
    tree.balance()
    return tree


def write_hint(file: Path, kind: str, points: np.ndarray) -> None:
    """Write a hint for the trainer to a JSON file: the splats at the positions `points` (P, 3) are of the `kind` "metal" or "paint".

    Raises InputError for another kind, or if the file cannot be written.
    """
    if kind not in KINDS:
        raise InputError(f"a part cannot be {kind}: choose one of {', '.join(KINDS)}")
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(file) as temporary:
        temporary.write_text(json.dumps({"hints": [{"kind": kind, "points": points.tolist()}]}), encoding="utf-8")


def _to_world(splats: bpy.types.Object) -> Matrix:
    """Return the matrix from the splats' coordinates to world space, even for hidden splats."""
    local = splats.matrix_parent_inverse @ splats.matrix_basis
    return splats.parent.matrix_world @ local if splats.parent else splats.matrix_basis.copy()


def _attribute(splats: bpy.types.Object, name: str, field: str, width: int) -> np.ndarray:
    """Read the values of an attribute as float32 (N, width); `field` is "vector" or "value"."""
    attribute = splats.data.attributes[name]
    values = np.empty(width * len(attribute.data), np.float32)
    attribute.data.foreach_get(field, values)
    return values.reshape(-1, width)
