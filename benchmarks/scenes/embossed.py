"""Build a tall hat of embossed gold, as from the Bronze Age, in a museum's soft light. Its beads and lines are a few pixels wide."""

import numpy as np

from benchmarks.scenes.lights import museum
from scripts.demo.shapes import Material, Mesh, Scene, lathe, step

MATERIALS = (Material((0.944, 0.720, 0.330), metallic=1.0, roughness=0.30),)
UNDER = [(0.0, -0.90), (0.30, -0.92), (0.45, -0.99), (0.60, -1.0)]
OVER = [(0.62, -0.985), (0.60, -0.965), (0.50, -0.90), (0.42, -0.80), (0.375, -0.64), (0.36, -0.45), (0.33, -0.30)]
SHAFT = [(0.265, -0.10), (0.215, 0.20), (0.17, 0.55), (0.125, 0.85), (0.085, 0.955), (0.04, 0.992), (0.0, 1.0)]
LINE = 0.036  # from one raised line to the next
BAND = (0.026, 0.09, 0.055)  # heights of bands with beads, with ringed bosses, and with leaves between them


def build() -> Scene:
    """Build the hat, two units high. The relief stands out by up to 0.013."""
    smooth = lathe([(0, UNDER + OVER + SHAFT)], rows=520, columns=600)
    return Scene(_raised(smooth), MATERIALS, light=museum(), lowest=-0.15)


def _raised(mesh: Mesh) -> Mesh:
    """Move each vertex along its normal by the height of the relief there."""
    corners = mesh.vertices[mesh.triangles]
    normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        np.add.at(normals, mesh.triangles[:, corner], across)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    outside = step(-0.3, 0.0, normals[:, 2] + 0.2 * (mesh.vertices[:, 2] > -0.9)) * step(
        1.0, 0.985, mesh.vertices[:, 2]
    )
    return Mesh(mesh.vertices + (outside * _relief(mesh.vertices))[:, None] * normals, mesh.triangles, mesh.material)


def _relief(points: np.ndarray) -> np.ndarray:
    """Compute the height of the relief at points (n, 3): horizontal bands of several kinds, with raised lines between them."""
    angle, height, bottom = np.arctan2(points[:, 1], points[:, 0]), np.zeros(len(points)), -0.96
    radius = np.hypot(points[:, 0], points[:, 1])
    kind = 0
    while bottom < 0.97:
        for _ in range(2):
            height += 0.009 * _dome((points[:, 2] - bottom) / (0.3 * LINE))
            bottom += LINE
        band = BAND[kind % 3]
        up = points[:, 2] - (bottom + band / 2 - LINE / 2)
        here = np.abs(up) < band / 2
        width = np.median(radius[here]) if here.any() else 0.0
        if width > 0.06:
            count = round(2 * np.pi * width / (1.15 * band + 0.012))
            along = ((angle * count / (2 * np.pi)) % 1 - 0.5) * 2 * np.pi * width / count
            away = np.hypot(along, up) / (band / 2)
            if kind % 3 == 0:
                shape = 0.012 * _dome(away)
            elif kind % 3 == 1:
                shape = 0.013 * _dome(away / 0.4) + 0.009 * _dome((away - 0.78) / 0.2)
            else:
                shape = 0.012 * _dome(np.hypot(along / (0.25 * band), up / (0.5 * band)))
            height += here * shape
        bottom, kind = bottom + band, kind + 1
    return height


def _dome(distance: np.ndarray) -> np.ndarray:
    """Compute the profile of a bead: 1 at its middle, and 0 from a distance of 1 on."""
    return (1 - distance**2).clip(0) ** 1.5
