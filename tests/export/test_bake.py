import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import cKDTree

from refgs.export.bake import bake
from refgs.export.occlusion import openness
from refgs.export.unwrap import unwrap
from refgs.formats.mesh import SmoothMesh
from refgs.formats.splats import Splats
from refgs.formats.textures import write_textures
from tests.makers.painted_ball import ball, look_up, on_surface, paint, shaded_normals, sphere_of_splats
from tests.makers.splats import arrays, chosen


@pytest.fixture(scope="module")
def unwrapped():
    return unwrap(ball())


def degrees(a, b):
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


def test_materials_come_back_where_they_were(unwrapped):
    textures = bake(unwrapped, sphere_of_splats(), 256)
    faces, weights, uv = on_surface(unwrapped)
    points = np.einsum("nk,nkc->nc", weights, unwrapped.vertices[faces])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    error = np.abs(look_up(textures.base_color, uv) - paint(points))
    assert error.mean() < 0.01 and error.max() < 0.05
    assert np.abs(look_up(textures.metallic, uv) - (0.5 + 0.5 * points[:, 2])).max() < 0.05
    assert np.abs(look_up(textures.roughness, uv) - (0.5 - 0.4 * points[:, 0])).max() < 0.05


def test_doubt_is_a_texture_where_splats_have_it(unwrapped, tmp_path):
    splats = sphere_of_splats()
    without = bake(unwrapped, splats, 256)
    assert without.doubt is None
    splats.doubt = 0.5 + 0.5 * splats.positions[:, 1]
    textures = bake(unwrapped, splats, 256)
    faces, weights, uv = on_surface(unwrapped)
    points = np.einsum("nk,nkc->nc", weights, unwrapped.vertices[faces])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    assert np.abs(look_up(textures.doubt, uv) - (0.5 + 0.5 * points[:, 1])).max() < 0.05
    for name in ("base_color", "normal"):
        np.testing.assert_allclose(getattr(textures, name), getattr(without, name), atol=1e-5)
    write_textures(tmp_path, textures)
    grey = np.asarray(Image.open(tmp_path / "doubt.png"))
    np.testing.assert_allclose(grey / 255, textures.doubt.clip(0, 1), atol=0.51 / 255)
    write_textures(tmp_path / "without", without)
    assert {path.stem for path in tmp_path.glob("*.png")} - {
        path.stem for path in (tmp_path / "without").iterdir()
    } == {"doubt"}


def test_the_normal_map_mends_a_coarse_mesh():
    # Disturb the vertex normals: the normal map has to correct them when it is shaded.
    mesh = ball(2)
    mesh.normals = mesh.normals + 0.15 * np.random.default_rng(0).normal(size=mesh.normals.shape)
    mesh.normals /= np.linalg.norm(mesh.normals, axis=1, keepdims=True)
    mesh = unwrap(mesh)
    textures = bake(mesh, sphere_of_splats(), 512)
    np.testing.assert_allclose(np.linalg.norm(textures.normal, axis=-1), 1, atol=1e-5)
    faces, weights, uv = on_surface(mesh)
    points, n = (np.einsum("nk,nkc->nc", weights, a[faces]) for a in (mesh.vertices, mesh.normals))
    error = degrees(shaded_normals(mesh, textures.normal, faces, weights, uv), points)
    assert degrees(n, points).mean() > 5
    assert error.mean() < 1 and np.percentile(error, 99) < 4


@pytest.mark.parametrize("size", [128, 320])
def test_how_many_rows_are_baked_at_a_time_does_not_matter(unwrapped, monkeypatch, size):
    """Check that baking 37 rows of texels at a time gives the same textures as baking all rows at once.

    The small texture is computed at every texel. The large one is computed at a lower resolution, then enlarged.
    """
    splats, found = sphere_of_splats(300), []
    splats.doubt = splats.metallic
    for rows in (37, size):
        monkeypatch.setattr("refgs.export.bake._ROWS", rows)
        found.append(bake(unwrapped, splats, size))
    for name, value in arrays(found[0]).items():
        np.testing.assert_allclose(value, getattr(found[1], name), atol=1e-5, err_msg=name)


def test_padding_repeats_the_nearest_texel(unwrapped):
    textures = bake(unwrapped, sphere_of_splats(500), 128)
    rows, columns = np.nonzero(textures.mask)
    tree = cKDTree(np.stack([rows, columns], axis=1))
    outside = np.argwhere(~textures.mask)
    distance = tree.query(outside)[0]
    for (row, column), d in list(zip(outside, distance, strict=True))[::37]:
        near = np.array(tree.query_ball_point((row, column), d + 1e-6))
        assert (textures.base_color[rows[near], columns[near]] == textures.base_color[row, column]).all(1).any()


def test_charts_keep_a_128th_of_the_side_apart(unwrapped):
    textures = bake(unwrapped, sphere_of_splats(100), 512)
    charts, count = label(textures.mask, np.ones((3, 3)))
    assert count > 3
    for chart in range(1, count + 1):
        others = distance_transform_edt((charts == 0) | (charts == chart))
        assert others[charts == chart].min() >= 4


def change_by_inner(mesh, outer, inner):
    """Bake two layers of splats, the inner one black. Return how much the inner layer changes the texels' colours (T, 3)."""
    inner.albedo[:] = 0
    both = Splats(**{name: np.concatenate([value, getattr(inner, name)]) for name, value in arrays(outer).items()})
    alone = bake(mesh, outer, 128)
    return np.abs(bake(mesh, both, 128).base_color - alone.base_color)[alone.mask]


def test_the_inside_of_a_shell_does_not_show_outside(unwrapped):
    assert change_by_inner(unwrapped, sphere_of_splats(), sphere_of_splats(radius=0.97, outward=-1)).max() < 0.02


def test_far_or_transparent_splats_still_give_colour(unwrapped):
    splats = sphere_of_splats(radius=3)
    splats.opacities[:] = 0
    textures = bake(unwrapped, splats, 64)
    assert np.isfinite(textures.normal).all() and textures.base_color.std() > 0.1
    one = chosen(splats, slice(1))
    np.testing.assert_allclose(bake(unwrapped, one, 64).base_color[0, 0], one.albedo[0], rtol=1e-5)


def test_normals_are_those_of_the_point_not_of_the_splats_middle(unwrapped):
    # With few, uneven splats, the mean of the splats that a ray meets lies beside the ray.
    splats = chosen(sphere_of_splats(3000), np.random.default_rng(3).permutation(3000)[:1500])
    splats.scales *= 1.5
    faces, weights, uv = on_surface(unwrapped)
    points = np.einsum("nk,nkc->nc", weights, unwrapped.vertices[faces])
    normal_map = bake(unwrapped, splats, 256).normal
    assert degrees(shaded_normals(unwrapped, normal_map, faces, weights, uv), points).mean() < 0.6


def test_the_nearer_layer_hides_the_farther(unwrapped):
    """Check that only the outer of two outward-facing layers shows in the texture. The inner one must not be blended in."""
    outer, inner = sphere_of_splats(), sphere_of_splats(radius=0.96)
    outer.opacities[:], inner.opacities[:] = 0.95, 0.95
    assert change_by_inner(unwrapped, outer, inner).mean() < 0.02


def test_what_stands_in_the_open_and_what_does_not():
    """Check openness, the fraction of the light that reaches a surface: about 1/2 on the ground beside a wall, and 1 on a sphere."""
    np.testing.assert_allclose(openness(ball()), 1)
    ground = trimesh.creation.box((8, 8, 0.1)).subdivide().subdivide().subdivide()
    wall = trimesh.creation.box((0.1, 8, 8)).apply_translation((-4, 0, 4))
    corner = trimesh.util.concatenate([ground, wall])
    mesh = SmoothMesh(np.array(corner.vertices), np.array(corner.faces), np.array(corner.vertex_normals))
    free = openness(mesh)
    x, y, z = mesh.vertices.T
    top = (z > 0) & (z < 0.1) & (np.abs(y) < 1)
    near, far = top & (np.abs(x + 3) < 0.1), top & (np.abs(x - 3) < 0.1)
    assert near.any() and far.any()
    assert 0.5 < free[near].mean() < 0.65 and free[far].mean() > 0.85
