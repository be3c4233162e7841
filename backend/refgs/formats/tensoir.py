"""Describe metadata.json, the camera of one view in the data set TensoIR-Synthetic. `refgs.capture.tensoir` cites the layout's source."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator

from refgs.formats.validate import Matrix, Model, Number, read_json


def _rows(text: Any) -> list[list[str]]:
    numbers = str(text).split(",")
    if len(numbers) != 16:
        raise ValueError("is not 16 numbers with commas between")
    return [numbers[row : row + 4] for row in range(0, 16, 4)]


class Metadata(Model):
    """Hold a camera: OpenGL camera-to-world matrix, horizontal field of view (radians), and size (pixels)."""

    cam_transform_mat: Annotated[Matrix, BeforeValidator(_rows)]
    cam_angle_x: Number | None = None
    imw: Number | None = None
    imh: Number | None = None


def read_metadata(file: Path) -> Metadata:
    """Read the camera of a view. Raises InputError."""
    return read_json(file, Metadata, "Download the data set again.")
