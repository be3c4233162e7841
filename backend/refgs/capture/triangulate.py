"""Triangulate points of a scene from photos with known cameras, with COLMAP (pycolmap).

COLMAP runs in a child process, because it ends its process when there is nothing to match.
"""

import multiprocessing
import signal
import tempfile
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import cv2
import numpy as np

from refgs.camera import Camera
from refgs.capture.images import load_view
from refgs.capture.types import View

SIDE = 640  # pixels on the longer side
NEIGHBOURS = 6  # photos that each is matched with
ANGLE = 8.0  # degrees between the best neighbours: points are uncertain between nearer ones, and look different between farther ones
ERROR = 1.5  # pixels, the largest reprojection error of a point; it must be seen in three photos
SEED = 1


def triangulate(views: list[View], progress: Callable[[int, int], None]) -> np.ndarray:
    """Triangulate points (M, 3), in the coordinates of the cameras. There are few or none where photos show no texture.

    `progress(done, total)` is called with each photo that is read. Raises InputError if a photo cannot be read.
    """
    with tempfile.TemporaryDirectory() as folder:
        cameras = []
        for number, view in enumerate(views):
            loaded = load_view(view, SIDE)
            cv2.imwrite(f"{folder}/{number}.png", loaded.bytes[..., ::-1])
            cameras.append(loaded.camera)
            progress(number + 1, len(views))
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_child, args=(Path(folder), cameras, theirs), daemon=True)
        process.start()
        theirs.close()
        try:
            while not ours.poll(0.2):  # short, because an interrupt does not wake it
                pass
            return ours.recv()
        except EOFError:
            return np.empty((0, 3))  # COLMAP ended its process, as it does when there is nothing to match
        finally:
            process.kill()
            process.join()


def neighbours(cameras: list[Camera]) -> list[tuple[int, int]]:
    """Return index pairs of near cameras whose viewing directions differ by about ANGLE degrees."""
    position = np.array([camera.position for camera in cameras])
    forward = np.array([camera.world_to_camera[2, :3] for camera in cameras])
    angle = np.degrees(np.arccos(np.clip(forward @ forward.T, -1, 1)))
    apart = np.linalg.norm(position[:, None] - position, axis=2)
    cost = np.abs(angle - ANGLE) + 45 * apart / max(float(np.median(apart)), 1e-12)
    np.fill_diagonal(cost, np.inf)
    best = np.argsort(cost, axis=1)[:, : min(NEIGHBOURS, len(cameras) - 1)]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(best) for j in row})


def _child(folder: Path, cameras: list[Camera], out: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    pycolmap.set_random_seed(SEED)
    database, names = folder / "database.db", [f"{i}.png" for i in range(len(cameras))]
    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = "PINHOLE"
    pycolmap.extract_features(database, folder, names, pycolmap.CameraMode.PER_IMAGE, reading)
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as known:
        for image in known.read_all_images():
            ours = cameras[int(image.name.removesuffix(".png"))]
            camera = known.read_camera(image.camera_id)
            camera.params, camera.has_prior_focal_length = [ours.fx, ours.fy, ours.cx, ours.cy], True
            known.update_camera(camera)
            model.add_camera_with_trivial_rig(camera)
            pose = pycolmap.Rigid3d(ours.world_to_camera[:3].astype(float))
            made = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(made, pose)
    listed = folder / "pairs.txt"
    listed.write_text("\n".join(f"{a}.png {b}.png" for a, b in neighbours(cameras)), encoding="utf-8")
    pairing, verification = pycolmap.ImportedPairingOptions(), pycolmap.TwoViewGeometryOptions()
    pairing.match_list_path, verification.ransac.random_seed = str(listed), SEED
    pycolmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification)
    (folder / "model").mkdir()
    model = pycolmap.triangulate_points(model, database, folder, folder / "model")
    found = [p.xyz for p in model.points3D.values() if p.track.length() >= 3 and p.error <= ERROR]
    out.send(np.array(found).reshape(-1, 3))
