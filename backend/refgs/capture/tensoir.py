"""Read captures of TensoIR-Synthetic: a folder for each view, `train_000`, `test_000` and so on, with its camera and its pictures.

The layout and its conventions are those that the loaders of TensoIR read (Jin et al., CVPR 2023; `dataLoader/tensoIR_rotation_setting.py`
and `dataLoader/tensoIR_relighting_test.py` in its repository). NeRFactor's data have the same layout.

    metadata.json       cam_transform_mat   camera to world with OpenGL's axes: 16 numbers, row by row, with commas between them
                        cam_angle_x         horizontal field of view in radians
                        imw, imh            width and height in pixels
    rgba.png            the photo, with straight alpha. Some copies of the data set have another name for it: see PHOTOS. Its mask may
                        be a file (see `find_masks`)
    normal.png          n/2 + 1/2, in world coordinates
    albedo.png          linear base colour
    rgba_LIGHT.png      the same view under another light, for each LIGHT in LIGHTS

A light is the panorama LIGHT.hdr, in Blender's orientation. It is in `Environment_Maps`, which is beside the scene's folder or one
folder further up. The views `val_000` … are not used.
"""

from pathlib import Path

from refgs.capture.files import Files, leave_out_missing, photo_view
from refgs.capture.images import read_header
from refgs.capture.mask_files import find_masks
from refgs.capture.transforms import frame_camera
from refgs.capture.types import Split, View
from refgs.formats.tensoir import read_metadata
from refgs.formats.transforms import Frame

LIGHTS = ("bridge", "city", "fireplace", "forest", "night")  # that TensoIR relights with
PHOTOS = ("rgba.png", "rgba_sunset.png", "rgba_sunset_000.png")  # the first that is there
_MAPS = (
    "high_res_envmaps_2k",
    "high_res_envmaps_1k",
    ".",
)  # in Environment_Maps; the pictures were rendered with the larger ones


def is_tensoir(folder: Path) -> bool:
    """Tell whether a folder is a scene of TensoIR-Synthetic."""
    return (folder / "train_000" / "metadata.json").is_file()


def read_tensoir(folder: Path) -> tuple[list[View], list[str]]:
    """Read a TensoIR capture's views in its own coordinates, and warnings. Raises InputError."""
    found = _folders(folder, "train") + _folders(folder, "test")
    named = [(pair, f"{pair[0].name}/{PHOTOS[0]}", _photo(pair[0])) for pair in found]
    photos, warnings = leave_out_missing(folder, named)
    if light_folder(folder) is None:
        what = "Environment_Maps is neither beside the scene's folder nor above it"
        warnings.append(f"{what}: the evaluation does not relight without its panoramas")
    masks = find_masks(Files(folder), [photo for _, photo in photos])
    return [_view(view, photo, split, masks.get(photo)) for (view, split), photo in photos], warnings


def _folders(folder: Path, split: Split) -> list[tuple[Path, Split]]:
    return [(file.parent, split) for file in sorted(folder.glob(f"{split}_[0-9]*/metadata.json"))]


def light_folder(folder: Path) -> Path | None:
    """Return the folder of panoramas for the scene in `folder`, or None if missing."""
    tops = [top / "Environment_Maps" / size for top in folder.resolve().parents[:2] for size in _MAPS]
    return next((top for top in tops if any((top / f"{light}.hdr").is_file() for light in LIGHTS)), None)


def _photo(folder: Path) -> Path | None:
    return next((folder / name for name in PHOTOS if (folder / name).is_file()), None)


def _view(folder: Path, photo: Path, split: Split, mask: Path | None) -> View:
    file = folder / "metadata.json"
    found = read_metadata(file)
    frame = Frame(
        file_path=folder.name,
        transform_matrix=found.cam_transform_mat,
        camera_angle_x=found.cam_angle_x,
        w=found.imw,
        h=found.imh,
    )
    camera = frame_camera(frame, str(file), read_header(photo)[:2])
    return photo_view(photo, camera, split, mask, str(file))
