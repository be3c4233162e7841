"""Clean up triangle meshes and compute their smooth normals."""

import fast_simplification
import numpy as np
import trimesh
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from refgs.errors import InputError
from refgs.formats.mesh import Mesh, SmoothMesh

KEEP = 0.01  # of the largest part's area: smaller parts are crumbs. the largest crumb of four real captures has 0.006
HOLE = 32  # edges around a small hole, about seven voxels across
NEAR = 0.03  # of the object's radius, within which normals are averaged
MOST_NEAR = 64  # vertices within this distance
ALIKE = 25.0  # degrees between normals: one standard deviation, beyond which they belong to another side of a crease
ROUNDS = 3  # of averaging
FRAY = 2  # rings of faces, from a border inwards: what is nowhere farther from the border frays out


def clean(mesh: Mesh, triangles: int) -> SmoothMesh:
    """Clean up a mesh, simplify it to about `triangles` faces if it has more, and compute smooth normals.

    - Crumbs are removed: connected parts with less than KEEP times the largest part's area.
    - Holes of at most HOLE edges are closed. The object has no holes there; the surface is missing because no photo shows it.
    - Frays are removed: narrow strips along a border. All vertices of a fray are less than FRAY faces from the border. Thin parts of a
      closed surface stay, because it has no border.

    Simplification is by quadric error (Garland and Heckbert 1997). In the returned mesh, no edge has more than two faces. Faces keep their
    winding. Raises InputError if the mesh has no valid face.
    """
    work = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    work.update_faces(np.isfinite(work.triangles).all((1, 2)))
    work.remove_unreferenced_vertices()
    work.merge_vertices(digits_vertex=None)
    work.update_faces(work.nondegenerate_faces() & work.unique_faces())
    if len(work.faces) == 0:
        raise InputError(
            "the depth maps have no surface in common, so there is no mesh: check that the renderings show the object "
            "and that it lies in the region of interest"
        )
    work.update_faces(_large(work))
    work = _without_holes(work)
    # Simplification would cut frays off and make crumbs of them.
    work.update_faces(_untrimmed(work))
    if len(work.faces) > triangles:
        # Take the gentlest setting that reaches the budget. On a sphere, normals are off by 0.1° with 3, and by 0.5° with 7, the
        # library's default, at some vertices by 30°. On a very noisy mesh 3 stops early.
        vertices, faces = work.vertices, work.faces
        for aggressiveness in (3, 5, 7):
            vertices, faces = fast_simplification.simplify(
                work.vertices, work.faces, target_count=triangles, agg=aggressiveness
            )[:2]
            if len(faces) <= triangles:
                break
        work = trimesh.Trimesh(vertices, faces, process=False)
        work.update_faces(work.nondegenerate_faces() & work.unique_faces())
    work.update_faces(_manifold(work))
    work.update_faces(_large(work))  # what hung on by removed faces
    used, faces = np.unique(work.faces, return_inverse=True)
    vertices = np.asarray(work.vertices)[used]
    faces = faces.reshape(-1, 3)
    return SmoothMesh(vertices, faces, smooth_normals(vertices, faces))


def _large(mesh: trimesh.Trimesh) -> np.ndarray:
    """Mark the faces (F,) of connected parts with at least KEEP times the largest area."""
    part, areas = parts(mesh)
    return (areas >= KEEP * areas.max())[part]


def _without_holes(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Close holes of at most HOLE edges with fans of triangles."""
    border = _border(mesh)
    if not len(border):
        return mesh
    part = trimesh.graph.connected_component_labels(border, len(mesh.vertices))[border[:, 0]]
    loop = np.unique(part, return_inverse=True)[1].reshape(-1)
    length = np.bincount(loop)
    # Where two holes touch at a vertex, it is not known which edges belong to which.
    touching = np.bincount(border[:, 0], minlength=len(mesh.vertices))[border[:, 0]] > 1
    closed = (length <= HOLE) & (np.bincount(loop, touching) == 0)
    middle = np.stack([np.bincount(loop, x) for x in mesh.vertices[border[:, 0]].T], axis=1) / length[:, None]
    number = len(mesh.vertices) + np.cumsum(closed) - 1
    chosen = closed[loop]
    fans = np.c_[border[chosen][:, ::-1], number[loop[chosen]]]
    return trimesh.Trimesh(np.r_[mesh.vertices, middle[closed]], np.r_[mesh.faces, fans], process=False)


def _untrimmed(mesh: trimesh.Trimesh) -> np.ndarray:
    """Mark the faces (F,) that belong neither to crumbs nor to frays (see `clean`)."""
    # A morphological opening: FRAY rings of faces are removed along the borders, and the pieces that are crumbs then; what remains grows
    # back. Surfaces fray where photos end, because few photos show what is there.
    border = np.zeros(len(mesh.vertices), bool)
    border[_border(mesh)] = True
    core = ~_grown(border, mesh.faces, FRAY - 1)[mesh.faces].any(axis=1)
    if not core.any():
        return _large(mesh)
    kept = np.zeros(len(mesh.vertices), bool)
    inner = trimesh.Trimesh(mesh.vertices, mesh.faces[core], process=False)
    kept[inner.faces[_large(inner)]] = True
    return np.any(_grown(kept, mesh.faces, FRAY - 1)[mesh.faces], axis=1)


def _border(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the edges (B, 2) of one face only, in the face's winding order."""
    edge = mesh.edges_unique_inverse
    return mesh.edges[np.bincount(edge)[edge] == 1]


def _grown(marked: np.ndarray, faces: np.ndarray, rings: int) -> np.ndarray:
    """Mark all vertices (V,) that are at most `rings` faces away from vertices already marked."""
    for _ in range(rings):
        touched = marked[faces].any(axis=1)
        marked = marked.copy()
        marked[faces[touched]] = True
    return marked


def _manifold(mesh: trimesh.Trimesh) -> np.ndarray:
    """Mark the faces (F,) to keep so that no edge has more than two faces."""
    # Edges with three faces arise when simplification folds a thin part of the mesh. The two largest are kept.
    edge, face = mesh.edges_unique_inverse, mesh.edges_face
    order = np.lexsort((-mesh.area_faces[face], edge))
    start = np.r_[0, np.flatnonzero(np.diff(edge[order])) + 1]
    place = np.arange(len(order)) - np.repeat(start, np.diff(np.r_[start, len(order)]))
    kept = np.ones(len(mesh.faces), bool)
    kept[face[order[place > 1]]] = False
    return kept


def is_crumbs(mesh: Mesh, many: int = 5) -> bool:
    """Tell whether a mesh has over `many` parts, each under half of the area."""
    _, areas = parts(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False))
    return len(areas) > many and areas.max() < areas.sum() / 2


def parts(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Return each face's connected part (F,), and each part's area."""
    part = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    return part, np.bincount(part, mesh.area_faces)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute a smooth unit normal at each vertex (V, 3), from the normals of its faces.

    A face's normal is weighted by the face's angle at the vertex (Thürmer and Wüthrich 1998).
    """
    corners = vertices[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    length = np.maximum(np.linalg.norm(edges, axis=-1, keepdims=True), 1e-30)
    edges /= length
    angle = np.arccos(np.clip(-(edges * np.roll(edges, 1, axis=1)).sum(-1), -1, 1))
    face = np.cross(edges[:, 0], edges[:, 1])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-30)
    weighted = (angle[..., None] * face[:, None]).reshape(-1, 3)
    normals = np.stack([np.bincount(faces.ravel(), weighted[:, a], len(vertices)) for a in range(3)], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])


def denoised_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute normals (V, 3) of a noisy mesh by a bilateral filter (Zheng et al. 2011), which smooths surfaces but not creases.

    A normal becomes the mean over vertices in a distance of NEAR times the object's radius, or over the MOST_NEAR nearest ones. They are
    weighted by their area, by how near they are, and by how alike their normals are.
    """
    normals = smooth_normals(vertices, faces).astype(np.float32)
    thirds = np.repeat(trimesh.triangles.area(vertices[faces]) / 3, 3)
    areas = np.bincount(faces.ravel(), thirds, len(vertices))
    reach = NEAR * np.linalg.norm(np.ptp(vertices, axis=0)) / 2
    count = int(np.clip(np.pi * reach**2 / max(areas.mean(), 1e-30), 1, min(MOST_NEAR, len(vertices))))
    distance, near = cKDTree(vertices).query(vertices, k=np.arange(1, count + 1))
    weight = np.exp(-2 * (distance / max(np.median(distance[:, -1]), 1e-30)) ** 2) * areas[near]
    weight = weight.astype(np.float32)
    for _ in range(ROUNDS):
        around = normals[near]
        alike = np.exp((np.einsum("vka,va->vk", around, normals) - 1) / np.radians(ALIKE) ** 2)
        mean = np.einsum("vk,vka->va", weight * alike, around)
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        normals = np.where(length > 1e-12, mean / np.maximum(length, 1e-12), normals)
    return normals.astype(np.float64)
