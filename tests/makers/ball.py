import json

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.scenes.analytic import sky
from refgs.formats.exr import write_exr
from refgs.formats.panorama import directions
from refgs.formats.splats import write_splats
from refgs.model.surfels import activate, initial_parameters, to_splats
from refgs.run import create_run
from refgs.settings import load_settings
from tests.makers.distances import spread

TURN = Rotation.from_euler("zyx", [40, 25, -70], degrees=True).as_matrix()
SCALE, MOVE = 3.0, np.array([5.0, -2.0, 1.0])
BOX = trimesh.creation.box((1.0, 1.4, 0.8)).subdivide().subdivide()


def dusk(direction):
    """Compute the radiance of another light in the unit directions (…, 3): redder than the sky, and from elsewhere."""
    return sky(direction[..., [1, 2, 0]]) * [1.0, 0.6, 0.3]


def write_run(folder, capture):
    """Write the output folder of a training on the data set `capture`, and return it. The learned object is a metal ball.

    The ball's upper half is rough, its lower half smooth. The mesh in the folder is a box.
    """
    create_run(folder, capture, load_settings("quick", ["environment.resolution=16"]), "quick", "cpu")
    points = spread(3000)
    look = {"opacity": 0.95, "sh_degree": 0, "albedo": 0.7, "metallic": 0.9, "roughness": 0.3}
    surfels = activate(initial_parameters(points, points, np.full(3000, 0.04), None, **look))
    roughness = torch.where(torch.from_numpy(points[:, 2]) > 0, 0.6, 0.2).float()
    splats = to_splats(surfels._replace(roughness=roughness, indirect_dc=surfels.indirect_dc[:, :0]))
    write_splats(folder / "splats.ply", splats)
    write_exr(folder / "environment.exr", sky(directions(64, 128)))
    box = BOX.copy()
    box.vertices = box.vertices[:, [0, 2, 1]] * [1, 1, -1]  # glTF's up axis is +Y
    box.export(folder / "mesh.glb")
    cameras = json.loads((folder / "cameras.json").read_text())
    cameras["to_capture"] = [*np.hstack([SCALE * TURN, MOVE[:, None]]).tolist(), [0, 0, 0, 1]]
    (folder / "cameras.json").write_text(json.dumps(cameras))
    return folder
