"""Textures for a mesh, baked from the splats around it."""

from dataclasses import dataclass

import numpy as np
import xatlas
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from refgs.export.splats import Splats
from refgs.export.tangents import vertex_tangents
from refgs.geometry.mesh import Mesh

_NEIGHBOURS = 24
_CHUNK = 1 << 15  # texels blended at a time: about 100 MB


@dataclass
class Textures:
    """Square maps of S×S texels, float32, the first row at v = 1.

    base_color (S, S, 3) linear Rec.709; metallic and roughness (S, S); normal (S, S, 3), unit vectors in MikkTSpace
    tangent space, y along v (OpenGL, glTF and Blender); mask (S, S), true where a texel's centre lies on the mesh: the
    rest is padding that repeats the nearest such texel.
    """

    base_color: np.ndarray
    metallic: np.ndarray
    roughness: np.ndarray
    normal: np.ndarray
    mask: np.ndarray


def unwrap(mesh: Mesh) -> Mesh:
    """The mesh cut into charts with uv, by xatlas; charts keep 1/128 of the texture's side from each other.

    Vertices on seams are doubled; their normals are those of `mesh`. Time grows faster than linearly (50,000 triangles
    13 s, 200,000 four minutes): simplify first.
    """
    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), mesh.normals.astype(np.float32))
    pack = xatlas.PackOptions()
    pack.resolution = 1024
    pack.padding = 8
    atlas.generate(pack_options=pack)
    source, faces, uv = atlas[0]
    return Mesh(mesh.vertices[source], faces.astype(np.int64), mesh.normals[source], uv.astype(np.float64))


def bake(mesh: Mesh, splats: Splats, size: int) -> Textures:
    """Blend the splats near each texel's point of the mesh, as the renderer would in front of it.

    `mesh` has normals and uv (`unwrap`). A splat counts by its opacity, its Gaussian at the point's projection on its
    plane, a Gaussian of the point's distance to that plane as wide as the splat itself, and the cosine between its
    normal and the mesh's. Where no splat reaches, the nearest ones decide.
    """
    face, weights = _rasterise(mesh, size)
    mask = face >= 0
    corners = mesh.faces[face[mask]]
    weights = weights[mask]

    def at_texels(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", weights, values[corners]).astype(np.float32)

    points, normals = at_texels(mesh.vertices), at_texels(mesh.normals)
    blended = _blend(splats, points, normals)
    tangents, signs = vertex_tangents(mesh)
    tangent = at_texels(tangents)
    bitangent = signs[corners[:, :1]].astype(np.float32) * np.cross(normals, tangent)
    # A shader forms x·tangent + y·bitangent + z·normal from interpolated vectors that are neither of unit length nor
    # orthogonal: what it needs is the solution, not three dot products.
    basis = np.stack([tangent, bitangent, normals], axis=2)
    regular = np.abs(np.linalg.det(basis)) > 1e-3
    basis[~regular] = np.eye(3)
    local = np.linalg.solve(basis, blended[:, 5:, None])[..., 0]
    local[~regular] = (0, 0, 1)
    # A normal below the horizon of the mesh cannot be encoded.
    local[:, 2] = np.maximum(local[:, 2], 0.05)
    local /= np.linalg.norm(local, axis=1, keepdims=True)

    nearest = tuple(distance_transform_edt(~mask, return_distances=False, return_indices=True))
    texels = np.zeros((size, size, 8), np.float32)
    texels[mask] = np.concatenate([blended[:, :5], local], axis=1)
    texels = texels[nearest]
    return Textures(
        base_color=np.ascontiguousarray(texels[..., :3]),
        metallic=np.ascontiguousarray(texels[..., 3]),
        roughness=np.ascontiguousarray(texels[..., 4]),
        normal=np.ascontiguousarray(texels[..., 5:]),
        mask=mask,
    )


def _rasterise(mesh: Mesh, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The face (S, S) at each texel's centre, -1 where there is none, and its barycentric weights (S, S, 3)."""
    flat = np.concatenate([mesh.uv * size, np.zeros((len(mesh.uv), 1))], axis=1).astype(np.float32)
    scene = EmbreeScene()
    TriangleMesh(scene, flat, mesh.faces.astype(np.int32))
    face = np.empty((size, size), np.int32)
    weights = np.empty((size, size, 3), np.float32)
    origins = np.ones((size, 3), np.float32)
    origins[:, 0] = np.arange(size) + 0.5
    down = np.tile(np.float32([0, 0, -1]), (size, 1))
    for row in range(size):
        origins[:, 1] = size - row - 0.5
        hit = scene.run(origins, down, output=1)
        face[row] = np.where(hit["tfar"] < 1e30, hit["primID"], -1)
        weights[row] = np.stack([1 - hit["u"] - hit["v"], hit["u"], hit["v"]], axis=1)
    return face, weights


def _blend(splats: Splats, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Base colour, metallic, roughness and normal (N, 8), blended at points (N, 3) with normals (N, 3)."""
    values = np.concatenate(
        [splats.albedo, splats.metallic[:, None], splats.roughness[:, None], splats.normals], axis=1
    ).astype(np.float32)
    frame = _frames(splats)
    count = min(_NEIGHBOURS, len(splats))
    tree = cKDTree(splats.positions)
    # Texels are much smaller than splats: those that share a cell of a third of the splats' spacing share neighbours.
    some = splats.positions[:: max(1, len(splats) // 2000)]
    spacing = float(np.median(tree.query(some, k=[min(2, len(splats))])[0])) or 1.0
    cell = np.floor(points / (spacing / 3)).astype(np.int64)
    cell -= cell.min(0)
    _, first, cell = np.unique(np.ravel_multi_index(cell.T, cell.max(0) + 1), return_index=True, return_inverse=True)
    neighbours = tree.query(points[first], k=count, workers=-1)[1].reshape(len(first), count)

    result = np.empty((len(points), values.shape[1]), np.float32)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        near = neighbours[cell[part]]
        offset = points[part, None] - splats.positions[near]
        u, v, d = np.moveaxis(np.einsum("nkac,nkc->nka", frame[near], offset, optimize=True), -1, 0)
        facing = np.maximum(np.einsum("nkc,nc->nk", splats.normals[near], normals[part]), 0)
        distance = (offset**2).sum(-1)
        # The last term decides only where no splat reaches.
        weight = facing * splats.opacities[near] * np.exp(-0.5 * (u * u + v * v + d * d))
        weight += 1e-5 / (1 + distance / spacing**2) ** 4
        weight /= weight.sum(1, keepdims=True)
        rows = np.arange(len(near) + 1) * count
        result[part] = csr_matrix((weight.ravel(), near.ravel(), rows), (len(near), len(splats))) @ values
    result[:, 5:] /= np.maximum(np.linalg.norm(result[:, 5:], axis=1, keepdims=True), 1e-12)
    return result


def _frames(splats: Splats) -> np.ndarray:
    """Matrices (N, 3, 3) that take an offset from a splat to its two axes and its normal, in standard deviations."""
    w, x, y, z = (splats.rotations / np.linalg.norm(splats.rotations, axis=1, keepdims=True)).T
    u = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    v = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
    scales = np.maximum(splats.scales, 1e-12)
    n = np.cross(u, v) / scales[:, :2].mean(1, keepdims=True)
    return np.stack([u / scales[:, :1], v / scales[:, 1:2], n], axis=1).astype(np.float32)
