"""Make a ball of splats whose base colour is given by a formula. Read textures of its mesh as a renderer does."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from refgs.formats.mesh import SmoothMesh, UnwrappedMesh
from refgs.formats.splats import Splats
from refgs.formats.tangents import vertex_tangents
from refgs.geometry.mesh import smooth_normals
from tests.makers.distances import spread


def paint(p: np.ndarray) -> np.ndarray:
    """Compute the ball's base colour (P, 3), which varies smoothly, at points (P, 3) on the unit sphere."""
    return 0.5 + 0.4 * np.sin(2 * p + [0, 1, 2])


def sphere_of_splats(count: int = 4000, radius: float = 1.0, outward: float = 1.0) -> Splats:
    """Cover a sphere evenly with splats that have the colours of `paint`. Each is as large as the spacing between them.

    Normals are multiplied by `outward`: −1 turns them inward.
    """
    n = spread(count)
    u = np.cross(n, [0.3, 0.5, 0.8])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    rotations = Rotation.from_matrix(np.stack([u, np.cross(n, u), n], axis=2)).as_quat()[:, [3, 0, 1, 2]]
    f = np.float32
    return Splats(
        positions=(radius * n).astype(f),
        normals=(outward * n).astype(f),
        sh=np.zeros((count, 1, 3), f),
        opacities=np.full(count, 0.8, f),
        scales=np.full((count, 2), radius * np.sqrt(4 * np.pi / count), f),
        rotations=rotations.astype(f),
        albedo=paint(n).astype(f),
        metallic=(0.5 + 0.5 * n[:, 2]).astype(f),
        roughness=(0.5 - 0.4 * n[:, 0]).astype(f),
        received=np.ones((count, 3), f),
        indirect=np.zeros((count, 0, 3), f),
    )


def ball(level: int = 3, radius: float = 1.0) -> SmoothMesh:
    """Make a triangle mesh of a sphere, with smooth normals."""
    sphere = trimesh.creation.icosphere(level, radius)
    return SmoothMesh(np.array(sphere.vertices), np.array(sphere.faces), smooth_normals(sphere.vertices, sphere.faces))


def on_surface(mesh: UnwrappedMesh, count: int = 3000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw random points of a mesh. Return the vertex indices of their faces (P, 3), their barycentric weights (P, 3) and uv (P, 2)."""
    rng = np.random.default_rng(2)
    faces = mesh.faces[rng.integers(len(mesh.faces), size=count)]
    weights = rng.dirichlet([1, 1, 1], size=count)
    return faces, weights, np.einsum("nk,nkc->nc", weights, mesh.uv[faces])


def look_up(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Interpolate a texture bilinearly at `uv`, as a renderer does. The texture's first row is at the top, v = 1."""
    size = len(texture)
    x, y = uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    s, t = (x - x0).reshape(-1, *[1] * (texture.ndim - 2)), (y - y0).reshape(-1, *[1] * (texture.ndim - 2))

    def at(row, column):
        return texture[row.clip(0, size - 1), column.clip(0, size - 1)]

    above, below = (at(y, x0) * (1 - s) + at(y, x0 + 1) * s for y in (y0, y0 + 1))
    return above * (1 - t) + below * t


def shaded_normals(mesh: UnwrappedMesh, normal_map: np.ndarray, faces, weights, uv) -> np.ndarray:
    """Compute the normals (P, 3) that a renderer gets from a normal map. They are not normalised.

    `faces`, `weights` and `uv` describe points of the mesh, as `on_surface` returns them.
    """
    tangents, signs = vertex_tangents(mesh)
    n, t = (np.einsum("nk,nkc->nc", weights, a[faces]) for a in (mesh.normals, tangents))
    c = look_up(normal_map, uv)
    return c[:, :1] * t + c[:, 1:2] * signs[faces[:, :1]] * np.cross(n, t) + c[:, 2:] * n
