"""Build a bell and a candlestick of polished brass with turned wood: both are brown, and only one is metal."""

from benchmarks.scenes.night import wood
from benchmarks.scenes.solids import disc, sculpt
from scripts.demo.shapes import Material, Scene, join, lathe, moved

BRASS, WOOD = range(2)
MATERIALS = (
    Material((0.887, 0.690, 0.370), metallic=1.0, roughness=0.10),
    Material(wood, metallic=0.0, roughness=0.35),
)
HOLLOW = [(0.0, 0.40), (0.20, 0.36), (0.26, 0.20), (0.35, 0.02), (0.37, 0.0)]
BELL = [(0.39, 0.0), (0.40, 0.02), (0.37, 0.06), (0.29, 0.21), (0.25, 0.36), (0.21, 0.43), (0.08, 0.47)]
GRIP = [
    (0.065, 0.49),
    (0.075, 0.54),
    (0.10, 0.64),
    (0.085, 0.76),
    (0.06, 0.84),
    (0.085, 0.91),
    (0.07, 0.97),
    (0.0, 1.0),
]
STICK = [(0.0, 0.0), (0.27, 0.0), (0.28, 0.02), (0.25, 0.05), (0.10, 0.10), (0.06, 0.17), (0.10, 0.24), (0.055, 0.31)]
STEM = [(0.05, 0.45), (0.075, 0.52), (0.055, 0.58), (0.09, 0.64), (0.17, 0.68), (0.175, 0.70), (0.08, 0.70)]
SOCKET = [(0.08, 0.80), (0.07, 0.81), (0.06, 0.79), (0.055, 0.72), (0.0, 0.71)]


def build() -> Scene:
    """Build the bell with a wooden handle, and the candlestick, on a wooden board 1.9 units wide."""
    board = disc((0, 0, -0.55), (0, 0, 1), 0.95, 0.05, 0.03)
    mesh = join(
        moved(lathe([(BRASS, HOLLOW + BELL), (WOOD, GRIP)], rows=420, columns=360), (0.38, 0.12, -0.49)),
        moved(lathe([(BRASS, STICK + STEM + SOCKET)], rows=420, columns=280), (-0.46, -0.14, -0.50)),
        sculpt(board, (-1, -1, -0.62), (1, 1, -0.48), 0.011, WOOD),
    )
    return Scene(moved(mesh, (0, 0, 0.05)), MATERIALS, light="courtyard", lowest=0.0)
