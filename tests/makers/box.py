import json

import numpy as np
import trimesh

from refgs.export.unwrap import unwrap
from refgs.formats.mesh import SmoothMesh
from refgs.formats.textures import Textures
from refgs.geometry.mesh import smooth_normals

SIZE = 64


def textured_box():
    """Make a box of 2 × 4 × 6 units that stands on the ground, and its textures. Base colour is a ramp; the others are constant."""
    box = trimesh.creation.box((2, 4, 6)).subdivide()
    vertices = np.array(box.vertices) + np.array([0, 0, 3])
    mesh = unwrap(SmoothMesh(vertices, np.array(box.faces), smooth_normals(vertices, box.faces)))

    def full(*value):
        return np.full((SIZE, SIZE, *([len(value)] if len(value) > 1 else [])), value, np.float32)

    ramp = np.broadcast_to(np.linspace(0, 1, SIZE, dtype=np.float32), (SIZE, SIZE))
    colour = np.dstack([ramp, full(0.2), ramp.T])
    return mesh, Textures(colour, full(0.75), full(0.3), full(0.9), full(0.6, 0, 0.8), np.ones((SIZE, SIZE), bool))


def glb_chunks(file):
    """Read a binary glTF file. Return its JSON as a mapping, and the bytes of its buffer."""
    data = file.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def rewrite_glb(file, edit):
    """Call `edit` on the JSON of a binary glTF file, as a mapping, and write the file again."""
    tree, buffer = glb_chunks(file)
    edit(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = [len(text).to_bytes(4, "little"), b"JSON", text, len(buffer).to_bytes(4, "little"), b"BIN\0", buffer]
    size = 12 + sum(map(len, chunks))
    file.write_bytes(b"".join([b"glTF", (2).to_bytes(4, "little"), size.to_bytes(4, "little"), *chunks]))
