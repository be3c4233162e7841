"""Write splats in version 2 of SPZ, which nothing writes any more, as the README of the format describes it."""

import gzip
import struct

import numpy as np

BITS = 12


def write_spz_2(path, splats):
    """Write 3D Gaussians or surfels, of degree 1 at most, number by number."""
    count, coefficients = splats.sh.shape[:2]
    scales = np.column_stack([splats.scales, splats.scales[:, :1]])[:, :3]
    data = bytearray(struct.pack("<4sIIBBBB", b"NGSP", 2, count, int(coefficients**0.5) - 1, BITS, 0, 0))
    for value in splats.positions.ravel():
        data += int(np.rint(value * 2**BITS)).to_bytes(3, "little", signed=True)
    data += bytes(round(255 * float(value)) for value in splats.opacities)
    data += bytes(min(255, max(0, round((0.15 * float(value) + 0.5) * 255))) for value in splats.sh[:, 0].ravel())
    data += bytes(min(255, max(0, round(16 * (np.log(value) + 10)))) for value in scales.ravel())
    for w, x, y, z in splats.rotations:
        sign = -1 if w < 0 else 1
        data += bytes(round((sign * float(value) + 1) * 127.5) for value in (x, y, z))
    data += bytes(min(255, max(0, round(128 * float(value) + 128))) for value in splats.sh[:, 1:].ravel())
    path.write_bytes(gzip.compress(bytes(data)))
