import numpy as np
import pytest
import trimesh

from refgs.errors import InputError
from refgs.formats.mesh import Mesh
from refgs.geometry.mesh import clean, denoised_normals, is_crumbs, parts, smooth_normals


def as_mesh(*parts):
    whole = trimesh.util.concatenate(parts)
    return Mesh(np.array(whole.vertices), np.array(whole.faces))


def ball(radius=1.0, at=(0, 0, 0), level=4):
    return trimesh.creation.icosphere(level, radius).apply_translation(at)


def count_parts(mesh):
    return len(parts(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False))[1])


def test_crumbs_go_and_small_objects_stay():
    """Keep objects of a quarter and of a fiftieth of the largest one's area. Remove crumbs of a two-hundredth."""
    crumbs = [ball(0.07, (0, 3 + i, 0), level=2) for i in range(5)]
    mesh = clean(as_mesh(ball(), ball(0.5, (3, 0, 0)), ball(0.15, (0, 0, 3)), *crumbs), 100000)
    assert count_parts(mesh) == 3
    assert mesh.vertices[:, 1].max() < 1.01 and mesh.vertices[:, 0].max() > 3.4 and mesh.vertices[:, 2].max() > 3.1
    assert mesh.faces.max() == len(mesh.vertices) - 1


def frayed(seed=0):
    """Make a ball that is cut below: in a band of 0.3 its faces are missing at random, and no crumb is loose yet."""
    whole = ball(level=6)
    height = whole.triangles_center[:, 2] + 0.5
    random = np.random.default_rng(seed)
    whole.update_faces(height > 0.3 * random.random(len(height)))
    part, areas = parts(whole)
    whole.update_faces(part == areas.argmax())
    return whole


@pytest.mark.parametrize("seed", range(3))
def test_a_frayed_border_leaves_no_crumbs(seed):
    """Simplify a surface whose border frays, as where photos end. Without trimming, it falls into 44 to 53 parts."""
    mesh = clean(as_mesh(frayed(seed)), 15000)
    assert count_parts(mesh) == 1
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area > 2 * np.pi * (1 + 0.2)  # the ball's as far down as its faces are there, 1.2 of its radius


def test_small_holes_close_and_large_ones_and_thin_parts_stay():
    """Close two holes near a large one without opening that, and keep a ring of wire. The large one may lose faces at its corners."""
    ring = trimesh.creation.torus(1.5, 0.01, major_sections=256, minor_sections=4)
    holes = ball(level=5)
    for x, radius in ((0, 0.5), (0.6, 0.05), (-0.7, 0.06)):
        x0, y, z = (holes.triangles_center - [x, 0, 0]).T
        holes.update_faces((np.hypot(x0, y) > radius) | (z < 0))
    mesh = clean(as_mesh(holes, ring), 100000)
    both = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert both.is_winding_consistent
    cut, whole = sorted(both.split(only_watertight=False), key=lambda part: part.is_watertight)
    assert len(whole.faces) == len(ring.faces)
    assert abs(cut.area - 2 * np.pi * (1 + np.sqrt(1 - 0.5**2))) < 0.02
    edges, faces = np.unique(cut.edges_sorted, axis=0, return_counts=True)
    x, y, z = cut.vertices[edges[faces == 1]].mean(axis=1).T
    assert np.abs(np.hypot(x, y) - 0.5).max() < 0.04 and z.min() > 0


def test_a_strip_that_is_all_border_stays():
    x, y = np.meshgrid(np.arange(50.0), np.arange(2.0), indexing="ij")
    corner = 2 * np.arange(49)[:, None]
    faces = np.concatenate([corner + np.array(three) for three in ((0, 2, 1), (1, 2, 3))])
    strip = Mesh(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), faces)
    assert len(clean(strip, 1000).faces) == len(faces)


def test_crumbs_are_known_from_things_of_several_parts():
    row = [ball(at=(3 * i, 0, 0), level=1) for i in range(20)]
    assert is_crumbs(as_mesh(*row)) and is_crumbs(as_mesh(*row[:6]))
    assert not is_crumbs(as_mesh(*row[:5]))
    assert not is_crumbs(as_mesh(ball(radius=5, at=(0, 9, 0)), *row))


def test_simplification_keeps_shape_winding_and_budget():
    mesh = clean(as_mesh(ball(level=6)), 4000)
    assert 3000 < len(mesh.faces) <= 4000
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.01
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normal * corners.mean(1)).sum(1) > 0).all()
    assert (mesh.normals * mesh.vertices).sum(1).min() > 0.99
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight


def test_a_noisy_mesh_meets_the_budget_too():
    mesh = as_mesh(ball(level=6))
    mesh.vertices += 0.02 * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    assert len(clean(mesh, 4000).faces) <= 4000


def test_degenerate_duplicate_and_not_finite_faces_go():
    good = ball(level=2)
    vertices = np.vstack([good.vertices, [[np.nan, 0, 0]]])
    faces = np.vstack([good.faces, good.faces[:5], [[0, 0, 1]], [[0, 1, len(vertices) - 1]]])
    mesh = clean(Mesh(vertices, faces), 100000)
    assert len(mesh.faces) == len(good.faces) and np.isfinite(mesh.vertices).all()


def test_an_empty_mesh_is_explained():
    with pytest.raises(InputError, match="no surface in common"):
        clean(Mesh.empty(), 100)


def test_smooth_normals_do_not_depend_on_the_triangulation():
    # Faces are weighted by their angle, so a cube's corner normal is the diagonal for any triangulation of its sides.
    cube = trimesh.creation.box()
    normals = smooth_normals(cube.vertices, cube.faces)
    np.testing.assert_allclose(normals, cube.vertices / np.linalg.norm(cube.vertices, axis=1, keepdims=True), atol=1e-9)


def test_no_edge_has_three_faces():
    """Check that no edge has more than two faces after a mesh is simplified.

    The meshes are a very thin sheet, and two thin sheets that cross. Simplification folds such sheets until edges touch.
    """
    rng = np.random.default_rng(0)
    sheet = ball(level=6)
    sheet.vertices[:, 2] *= 0.002
    crossing = sheet.copy().apply_transform(trimesh.transformations.rotation_matrix(1.2, [1, 0, 0]))
    for thin in (as_mesh(sheet), as_mesh(sheet, crossing)):
        thin.vertices += 1e-4 * rng.normal(size=thin.vertices.shape)
        mesh = clean(thin, 300)
        edges = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).edges_sorted
        assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2


def wavy(mesh: trimesh.Trimesh, seed: int):
    """Displace a mesh along its normals by waves six edges long, and by noise. Returns the vertices."""
    generator, edge = np.random.default_rng(seed), mesh.edges_unique_length.mean()
    along = generator.normal(size=(3, 8))
    heights = np.sin(mesh.vertices @ (2 * np.pi / (6 * edge) * along / np.linalg.norm(along, axis=0))).sum(axis=1)
    heights = edge * (0.06 * heights + 0.1 * generator.normal(size=len(heights)))
    return mesh.vertices + heights[:, None] * mesh.vertex_normals


def degrees(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))


@pytest.mark.parametrize("seed", [0, 1])
def test_denoised_normals_are_smooth_on_a_ball(seed):
    mesh = ball(level=6)
    vertices = wavy(mesh, seed)
    before, after = (degrees(f(vertices, mesh.faces), mesh.vertices) for f in (smooth_normals, denoised_normals))
    assert before.mean() > 5
    assert after.mean() < 0.3 * before.mean()


@pytest.mark.parametrize("seed", [0, 1])
def test_denoised_normals_keep_the_edges_of_a_box(seed):
    """Check that the sides of a wavy box become flat, up to two triangles from their edges."""
    mesh = trimesh.creation.box((2, 2, 2))
    for _ in range(6):
        mesh = mesh.subdivide()
    vertices, size = wavy(mesh, seed), np.abs(mesh.vertices)
    true = np.sign(mesh.vertices) * (np.arange(3) == size.argmax(axis=1)[:, None])
    from_edge = (1 - np.sort(size, axis=1)[:, 1]) * 32  # in triangles
    before, after = (degrees(f(vertices, mesh.faces), true) for f in (smooth_normals, denoised_normals))
    for where in (from_edge > 1.5, (from_edge > 1.5) & (from_edge < 5.5)):
        assert before[where].mean() > 5
        assert after[where].mean() < 0.6 * before[where].mean()


def test_denoised_normals_of_flat_and_tiny_meshes_are_as_they_were():
    box = trimesh.creation.box((2, 2, 2))
    assert denoised_normals(box.vertices, box.faces) == pytest.approx(smooth_normals(box.vertices, box.faces), abs=1e-6)
    one = np.eye(3)
    assert denoised_normals(one, np.array([[0, 1, 2]])) == pytest.approx(np.full((3, 3), 3**-0.5), abs=1e-6)
