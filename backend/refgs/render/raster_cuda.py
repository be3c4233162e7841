"""Rasterise on a CUDA card."""

import ctypes

import torch

from refgs.kernels import cuda, load
from refgs.kernels.layout import struct
from refgs.render.raster import Scene

SIZES = (4, 8, 12, 16, 20)  # channel counts that kernels are compiled for; others take the next larger one
MOST = SIZES[-1]
TILE, THREADS, PHASES = 16, 128, 8  # as in raster.cu
PROJECTED = ctypes.sizeof(struct("Projected", "raster.h"))
GEOMETRY = 16  # floats of a gradient row before its features, as there
SHORT = 1 << 15  # tiles that an int16 can number: such keys sort in half the time


def how_many(ends: torch.Tensor) -> int:
    """Return the last of the running sums `ends`, which is the total. Return 0 if `ends` is empty.

    `ends` is on the card. The CPU waits here until the card has computed it, because the CPU needs the total to allocate memory.
    """
    return int(ends[-1]) if len(ends) else 0


class Raster(struct("Raster", "raster.cu"), Scene):
    """Hold the arguments of the CUDA rasteriser's kernels, and run these (see `Scene`)."""

    def project(self, device: torch.device) -> None:
        def integers(*shape: int) -> torch.Tensor:
            return torch.empty(shape, dtype=torch.int32, device=device)

        n, self.tiles = self.splats, -(-self.width // TILE) * -(-self.height // TILE)
        self.keep(
            projected=torch.empty(n * PROJECTED, dtype=torch.uint8, device=device),
            counts=integers(n),
            starts=integers(n),
            tile_start=integers(self.tiles + 1),
            reach=integers(self.tiles),
            last=integers(self.tiles),
        )
        counts, depths = self.kept["counts"], integers(n)
        self.attach(depths=depths)
        load.run("refgs_raster_project", self, depths, n)
        order = torch.sort(depths, stable=True).indices
        ends = counts[order].cumsum(0)
        self.pair_count = pairs = how_many(ends)
        if pairs >= 1 << 31:
            raise RuntimeError(f"{pairs:,} pairs of a surfel and a tile are more than 32 bits can number")
        self.keep(pairs=integers(pairs, 2), members=integers(pairs), places=integers(pairs))
        self.attach(order=order, ends=ends)
        load.run("refgs_raster_list", self, depths, n)
        tile = self.kept["pairs"][:, 0]
        sorted = torch.sort(tile.short() if self.tiles <= SHORT else tile, stable=True).indices
        self.attach(sorted=sorted)
        load.run("refgs_raster_bin", self, depths, pairs + 1)

    def blend(self) -> None:
        self.size = next(size for size in SIZES if size >= self.channels)
        kernel = "trimmed" if self.upper < 1 or self.lower > 0 else self.size
        cuda.launch(f"refgs_raster_forward_{kernel}", self, self.kept["reach"].device, self.tiles, THREADS)

    def differentiate(self) -> None:
        like = self.kept["reach"]
        rows = torch.empty(self.pair_count * (GEOMETRY + self.size), device=like.device)
        self.attach(rows=rows)
        cuda.launch(f"refgs_raster_backward_{self.size}", self, like.device, self.tiles, THREADS)
        load.run("refgs_raster_gather", self, like, self.splats)
        load.run("refgs_raster_gather_features", self, like, self.splats * -(-self.channels // 4) * PHASES)
