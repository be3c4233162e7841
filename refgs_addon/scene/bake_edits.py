"""Bake the edits of a run into its mesh's textures, so that an edited mesh can be exported without the trainer."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from mathutils.kdtree import KDTree

from ..errors import InputError
from ..nodes.edit_tree import AMOUNT, COLOR, SURFACE
from .atomic_file import unwritable
from .color_spaces import to_rec709
from .edit import evaluated_splats, splats_of
from .glb_pictures import replace_pictures
from .import_run import add_mesh, data_blocks
from .mesh_exchange import TEXTURES, textures_of
from .pictures import read_png, write_png
from .splat_cloud import linear_to_srgb, srgb_to_linear

EDITED = ("base_color", "metallic", "roughness")
PADDING = 8  # texels around each chart that take its edits, too: bilinear look-ups and small mipmaps read them
CHUNK = 1 << 19  # texels that are looked at together, which limits the memory


def bake_edits(collection: bpy.types.Collection, mesh: Path, folder: Path) -> Path:
    """Write a run's mesh with its edits into `folder`, as mesh.glb and textures/. Returns the path of that mesh.glb.

    `mesh` is the mesh.glb of the run folder. The textures get what the mesh shows in Blender: each vertex has the edits of the nearest
    splat, and they are linear in between. Texels without edits keep their bytes. Shape, uv map, tangents, normal and occlusion textures
    stay. The float EXR files of edited textures are left out. Splats that were deleted stay in the mesh. If there is no folder of textures
    beside the mesh, its own pictures are taken.

    Raises InputError if a texture is missing, if the mesh has no uv map, or if it is not one that RefGS wrote.
    """
    target, packed = folder / TEXTURES, folder / "packed.png"
    places, faces, uv = _triangles(mesh)
    values = _edits_at(splats_of(collection), places)
    try:
        files = textures_of(mesh, target)
        pictures = {name: read_png(files[name]) for name in (*EDITED, "occlusion")}
        if len({picture.shape for picture in pictures.values()}) > 1:
            raise InputError(f"the textures beside {mesh} differ in size: make the run's mesh again")
        for texels, triangles, weights in _texels(uv, *pictures["occlusion"].shape[:2]):
            edit = np.einsum("pc,pcv->pv", weights, values[faces[triangles]])
            for name, new, amount in zip(EDITED, ([0, 1, 2], [3], [4]), ([5], [6], [7]), strict=True):
                _blend(pictures[name], texels, edit[:, new], edit[:, amount], srgb=name == "base_color")
        if not target.exists():
            edited = shutil.ignore_patterns(*(f"{name}.*" for name in EDITED))
            shutil.copytree(mesh.parent / TEXTURES, target, ignore=edited)
        for name in EDITED:
            write_png(target / f"{name}.png", pictures[name][..., :3])
        channels = [pictures[name][..., :1] for name in ("occlusion", "roughness", "metallic")]
        write_png(packed, np.concatenate(channels, axis=2))
        (folder / mesh.name).write_bytes(replace_pictures(mesh, target / "base_color.png", packed))
        packed.unlink()
    except (OSError, RuntimeError) as error:
        raise unwritable(folder / mesh.name, error) from None
    return folder / mesh.name


def _triangles(mesh: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read a mesh by Blender's importer: its vertices (V, 3), triangles (T, 3) and uv coordinates (T, 3, 2), in Blender's axes."""
    before = data_blocks()
    try:
        scene = bpy.data.scenes.new("bake")
        with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
            item = add_mesh(mesh, "bake", scene.collection)[0]
        data = item.data
        if not data.uv_layers or not data.polygons:
            raise InputError(f"{mesh} has no uv map to bake edits into: make the run's mesh again")
        data.calc_loop_triangles()
        places, loops, faces, uv = (
            np.empty(count, kind)
            for count, kind in (
                (3 * len(data.vertices), np.float32),
                (3 * len(data.loop_triangles), np.int32),
                (3 * len(data.loop_triangles), np.int32),
                (2 * len(data.loops), np.float32),
            )
        )
        data.vertices.foreach_get("co", places)
        data.loop_triangles.foreach_get("loops", loops)
        data.loop_triangles.foreach_get("vertices", faces)
        data.uv_layers.active.data.foreach_get("uv", uv)
        turn = np.array(item.matrix_world)
        places = places.reshape(-1, 3) @ turn[:3, :3].T + turn[:3, 3]
        return places, faces.reshape(-1, 3), uv.reshape(-1, 2)[loops].reshape(-1, 3, 2)
    finally:
        bpy.data.batch_remove(data_blocks() - before)


def _edits_at(splats: bpy.types.Object, places: np.ndarray) -> np.ndarray:
    """Return the edits of the splats nearest to `places` (V, 3), as (V, 8).

    The columns are the new base colour (linear Rec.709), metallic and roughness, premultiplied, then the amounts of these three.
    """
    with evaluated_splats(splats) as cloud:
        count = len(cloud.points)
        values = np.zeros((count, 9), np.float32)
        for i, name in enumerate((COLOR, SURFACE, AMOUNT)):
            if name in cloud.attributes:
                column = np.empty(3 * count, np.float32)
                cloud.attributes[name].data.foreach_get("vector", column)
                values[:, 3 * i : 3 * i + 3] = column.reshape(-1, 3)
        centres = np.empty(3 * count, np.float32)
        cloud.attributes["position"].data.foreach_get("vector", centres)
    if not count:
        raise InputError(f"all splats of {splats.name} are deleted: restore some")
    values[:, :3] = to_rec709(values[:, :3])
    tree = KDTree(count)
    for number, centre in enumerate(centres.reshape(-1, 3)):
        tree.insert(centre, number)
    tree.balance()
    nearest = np.fromiter((tree.find(place)[1] for place in places), int, len(places))
    return values[nearest][:, [0, 1, 2, 3, 4, 6, 7, 8]]


def _texels(uv: np.ndarray, height: int, width: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the texels of a texture that belong to triangles with the corners `uv` (T, 3, 2), in chunks.

    Each chunk has the texels' indices (P,), rows from the top, their triangles (P,) and the weights of the corners (P, 3). First come the
    texels whose centres are in triangles, then those around them, to the distance PADDING.
    """
    corner = uv.astype(np.float64) * (width, height) - 0.5
    low = np.ceil(corner.min(axis=1) - 1e-6).astype(int).clip(0, (width - 1, height - 1))
    high = np.floor(corner.max(axis=1) + 1e-6).astype(int).clip(-1, (width - 1, height - 1))
    side = (high - low + 1).clip(0)
    ends = side.prod(axis=1).cumsum()
    owner = np.full((height, width), -1, np.int32)
    edges = np.searchsorted(ends, np.arange(CHUNK, ends[-1] + CHUNK, CHUNK))
    for first, last in zip([0, *edges], [*edges, len(ends)], strict=True):
        if first < last:
            counts = side[first:last].prod(axis=1)
            triangle = np.repeat(np.arange(first, last), counts)
            place = np.arange(len(triangle)) - np.repeat(counts.cumsum() - counts, counts)
            x = low[triangle, 0] + place % side[triangle, 0]
            y = low[triangle, 1] + place // side[triangle, 0]
            inside = _weights(corner[triangle], x, y).min(axis=1) >= -1e-6
            owner[height - 1 - y[inside], x[inside]] = triangle[inside]
    source = np.arange(owner.size, dtype=np.int32).reshape(owner.shape)
    for _ in range(PADDING):
        before = owner.copy()
        for to, by in _NEIGHBOURS:
            fill = (owner[to] < 0) & (before[by] >= 0)
            owner[to][fill], source[to][fill] = before[by][fill], source[by][fill]
    texels = np.flatnonzero(owner.ravel() >= 0)
    for first in range(0, len(texels), CHUNK):
        texel = texels[first : first + CHUNK]
        triangle, centre = owner.ravel()[texel], source.ravel()[texel]
        weights = _weights(corner[triangle], centre % width, height - 1 - centre // width)
        yield texel, triangle, weights.astype(np.float32)


# Slices of a picture, and of the same picture moved by one texel to each side.
_ALL, _LATER, _EARLIER = slice(None), slice(1, None), slice(None, -1)
_NEIGHBOURS = [
    ((_LATER, _ALL), (_EARLIER, _ALL)),
    ((_EARLIER, _ALL), (_LATER, _ALL)),
    ((_ALL, _LATER), (_ALL, _EARLIER)),
    ((_ALL, _EARLIER), (_ALL, _LATER)),
]


def _weights(corner: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the barycentric coordinates (P, 3) of points in triangles (P, 3, 2). One is negative outside, all if the area is 0."""
    a, b, c = (corner[:, i] for i in range(3))
    point = np.stack([x, y], axis=1) - a
    area = _cross(b - a, c - a)
    flat = np.abs(area) < 1e-12
    area[flat] = 1.0
    second, third = _cross(point, c - a) / area, _cross(b - a, point) / area
    weights = np.stack([1 - second - third, second, third], axis=1)
    weights[flat] = -1.0
    return weights


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _blend(picture: np.ndarray, texels: np.ndarray, added: np.ndarray, amount: np.ndarray, srgb: bool) -> None:
    """Blend premultiplied values over texels of a picture (H, W, 4). `srgb`: the picture is sRGB-encoded, and the values are linear."""
    edited = amount[:, 0] > 0
    rows, added, amount = texels[edited], added[edited], amount[edited]
    flat = picture.reshape(-1, 4)
    learned = flat[rows, :3]
    mixed = (srgb_to_linear(learned) if srgb else learned) * (1 - amount) + added
    flat[rows, :3] = linear_to_srgb(mixed) if srgb else mixed.clip(0, 1)
