import numpy as np
import trimesh
from skimage.measure import marching_cubes

from refgs.geometry.isosurface import BLOCK, isosurface

CORNERS = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def blocks_about(sdf, blocks, band=6.0):
    """Split a cubic voxel grid into `blocks`³ blocks, and keep those whose centre is within `band` voxels of the surface.

    `sdf` computes signed distances. Return the indices (B, 3) of the blocks that are kept, and the signed distances (B, BLOCK³) of their
    voxels.
    """
    block = np.stack(np.meshgrid(*[np.arange(blocks)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    block = block[np.abs(sdf(BLOCK * block + BLOCK / 2)) < band]
    return block, sdf(BLOCK * block[:, None] + CORNERS).astype(np.float32)


def ball(centre, radius):
    return lambda p: np.linalg.norm(p - centre, axis=-1) - radius


def test_it_is_the_surface_of_the_whole_grid_across_chunks():
    """Check the mesh of a ball that lies in eight chunks of 64³ voxels.

    It has the same vertices and the same number of faces as a mesh by marching cubes on one grid of 128³ voxels.
    """
    sdf = ball([63.7, 64.2, 60.1], 40.3)
    mesh = isosurface(*blocks_about(sdf, 32))
    grid = np.stack(np.meshgrid(*[np.arange(128)] * 3, indexing="ij"), axis=-1)
    vertices, faces, _, _ = marching_cubes(sdf(grid).astype(np.float32), 0.0)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert len(mesh.vertices) == len(vertices) and len(mesh.faces) == len(faces)
    assert solid.is_watertight and solid.euler_number == 2 and solid.volume > 0
    assert np.abs(np.sort(mesh.vertices, axis=0) - np.sort(vertices, axis=0)).max() < 1e-4


def test_a_surface_on_the_planes_between_chunks_has_no_cracks():
    """Check that the meshes of three cubes, each across several chunks, are watertight after coincident vertices are merged.

    The sides of one cube lie exactly on voxel centres. Those of the other two lie half way between voxel centres.
    """
    for middle, radius in ((64.0, 32.0), (64.0, 20.5), (63.5, 30.0)):
        mesh = isosurface(*blocks_about(lambda p, m=middle, r=radius: np.abs(p - m).max(axis=-1) - r, 32))
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        solid.merge_vertices(digits_vertex=6)
        solid.update_faces(solid.nondegenerate_faces())
        assert solid.is_watertight, (middle, radius)


def test_space_between_costs_nothing():
    """Check that two balls far apart are meshed in little memory: one grid around both would take 17 TB."""
    block, signed = blocks_about(ball([30.0, 30.0, 30.0], 12.0), 16)
    mesh = isosurface(np.concatenate([block, block + 4096]), np.concatenate([signed, signed]))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight and solid.body_count == 2
    assert np.abs(mesh.vertices.max(axis=0) - (BLOCK * 4096 + 42)).max() < 0.1


def test_what_is_not_known_has_no_faces():
    block, signed = blocks_about(ball([30.0, 30.0, 30.0], 12.0), 16)
    signed[(BLOCK * block[:, None] + CORNERS)[..., 2] > 30] = np.nan
    mesh = isosurface(block, signed)
    assert len(mesh.faces) and mesh.vertices[:, 2].max() <= 30
    assert len(isosurface(block, np.full_like(signed, np.nan)).faces) == 0
    assert len(isosurface(block[:0], signed[:0]).faces) == 0
