"""Mesh the zero level of signed distances on sparse blocks of voxels."""

import numpy as np
from skimage.measure import marching_cubes

from refgs.formats.mesh import Mesh

BLOCK = 4  # voxels along a block's side
_CHUNK = 16  # blocks along the side of a chunk, which marching cubes meshes at a time: 1 MB


def isosurface(block: np.ndarray, signed: np.ndarray) -> Mesh:
    """Run marching cubes (Lewiner et al. 2003) over unique blocks (M, 3) of BLOCK³ voxels with signed distances (M, BLOCK³).

    Unknown distances are NaN or infinite; only cells with eight known corners have faces. Vertices are in voxels; the origin is the
    centre of the first voxel of block (0, 0, 0). Chunks are meshed one by one, each with one layer of its neighbours' voxels, and their
    common vertices are merged. So memory grows with the blocks, not with the volume that they span.
    """
    rows, chunks = _assign_to_chunks(block)
    order = np.lexsort(chunks.T)
    rows, chunks = rows[order], chunks[order]
    first = np.flatnonzero(np.r_[True, (chunks[1:] != chunks[:-1]).any(axis=1)]) if len(rows) else np.zeros(0, int)
    vertices, faces, count = [], [], 0
    for part in np.split(np.arange(len(rows)), first[1:]) if len(rows) else ():
        chunk = chunks[part[0]]
        found = _mesh_chunk(block[rows[part]] - _CHUNK * chunk, signed[rows[part]])
        if found is not None:
            vertices.append(found[0] + float(BLOCK * _CHUNK) * chunk)
            faces.append(found[1] + count)
            count += len(found[0])
    if not vertices:
        return Mesh.empty()
    return _merge_vertices(np.concatenate(vertices), np.concatenate(faces))


def _assign_to_chunks(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Assign blocks to chunks. Returns K pairs: indices (K,) of blocks, and the chunk (K, 3) that each is assigned to.

    A block on the lower side of a chunk is also assigned to the chunk before, whose last cells need its voxels.
    """
    rows, chunks = [], []
    for back in np.ndindex(2, 2, 2):
        row = np.flatnonzero((block % _CHUNK == 0)[:, np.array(back, bool)].all(axis=1))
        rows.append(row)
        chunks.append(block[row] // _CHUNK - back)
    return np.concatenate(rows), np.concatenate(chunks)


def _mesh_chunk(block: np.ndarray, signed: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Mesh one chunk: vertices, exact in the chunk's frame, and faces. `block` counts from the chunk's corner."""
    side = _CHUNK + 1
    grid = np.full((side * BLOCK,) * 3, np.nan, np.float32)
    grid.reshape((side, BLOCK) * 3).transpose(0, 2, 4, 1, 3, 5)[tuple(block.T)] = signed.reshape(
        -1, BLOCK, BLOCK, BLOCK
    )
    end = _CHUNK * BLOCK + 1
    grid = grid[:end, :end, :end]
    known = np.isfinite(grid)
    grid[~known] = 1
    # Mark the cells with eight known corners: marching cubes visits a cell if its last corner is in the mask.
    for axis in range(3):
        known[(slice(None),) * axis + (slice(1, None),)] &= known[(slice(None),) * axis + (slice(-1),)].copy()
        known[(slice(None),) * axis + (0,)] = False
    if not known.any() or not grid.min() < 0 < grid.max():
        return None
    try:
        vertices, faces, _, _ = marching_cubes(grid, 0.0, mask=known)
    except RuntimeError:  # the mask has no surface
        return None
    return vertices.astype(np.float64), faces.astype(np.int64)


def _merge_vertices(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Merge the vertices that chunks share.

    Shared vertices have equal coordinates, bit for bit: on the plane between chunks both are interpolated from the same two voxels.
    """
    shared = np.flatnonzero((vertices % (BLOCK * _CHUNK) == 0).any(axis=1))
    _, kept, which = np.unique(vertices[shared], axis=0, return_index=True, return_inverse=True)
    target = np.arange(len(vertices))
    target[shared] = shared[kept][which.reshape(-1)]
    used, faces = np.unique(target[faces], return_inverse=True)
    return Mesh(vertices[used], faces.reshape(-1, 3))
