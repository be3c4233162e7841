"""Rasterise on the CPU."""

import ctypes

import torch

from refgs.kernels.layout import struct
from refgs.kernels.load import borrow, kernels, parallel
from refgs.render.raster import Scene

PROJECTED = ctypes.sizeof(struct("Projected", "raster.h"))
OCTAGON = ctypes.sizeof(struct("Octagon", "raster.h"))


class Raster(struct("Raster", "raster.h"), Scene):
    """Hold the arguments of the CPU rasteriser's kernels, and run these (see `Scene`)."""

    def project(self, device: torch.device) -> None:
        library, n = kernels(), self.splats
        tiles = library.refgs_tiles(self.width, self.height)
        self.keep(
            projected=torch.empty(n * PROJECTED, dtype=torch.uint8),
            octagons=torch.empty(n * OCTAGON, dtype=torch.uint8),
            order=torch.empty(n, dtype=torch.int32),
            splat_start=torch.empty(n + 1, dtype=torch.int64),
            tile_start=torch.empty(tiles + 1, dtype=torch.int64),
            reach=torch.empty(tiles, dtype=torch.int32),
        )
        self.attach(keys=borrow("keys", 4 * n))
        parallel(library.refgs_project, self)
        library.refgs_sort(ctypes.byref(self))
        self.keep(
            members=torch.empty(self.pairs, dtype=torch.int32),
            places=torch.empty(self.pairs, dtype=torch.int32),
        )
        library.refgs_bin(ctypes.byref(self))

    def blend(self) -> None:
        library = kernels()
        parallel(library.refgs_forward, self, library.refgs_scratch_size(self.channels))

    def differentiate(self) -> None:
        library = kernels()
        row_start = torch.empty_like(self.kept["tile_start"])
        self.attach(row_start=row_start)
        library.refgs_rows(ctypes.byref(self))
        self.attach(rows=borrow("rows", self.row_count * library.refgs_row_size(self.channels)))
        parallel(library.refgs_backward, self, library.refgs_scratch_size(self.channels))
        parallel(library.refgs_gather, self)
