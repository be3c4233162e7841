import numpy as np
import pytest
import trimesh

from refgs.errors import InputError
from refgs.formats.mesh import Mesh
from refgs.geometry.mesh import clean, is_crumbs, smooth_normals


def as_mesh(*parts):
    whole = trimesh.util.concatenate(parts)
    return Mesh(np.array(whole.vertices), np.array(whole.faces))


def ball(radius=1.0, at=(0, 0, 0), level=4):
    return trimesh.creation.icosphere(level, radius).apply_translation(at)


def test_floaters_go_and_large_parts_stay():
    mesh = clean(as_mesh(ball(), ball(0.5, (3, 0, 0)), ball(0.1, (0, 3, 0))), 100000)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).body_count == 2
    assert mesh.vertices[:, 1].max() < 1.01 and mesh.vertices[:, 0].max() > 3.4
    assert mesh.faces.max() == len(mesh.vertices) - 1


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
