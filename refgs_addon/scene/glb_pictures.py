"""Read and replace the pictures inside a run's mesh.glb."""

import json
from pathlib import Path
from typing import NamedTuple

from ..errors import InputError
from ..ordinary import open_file

BASE_COLOR, PACKED, NORMAL = "baseColorTexture", "metallicRoughnessTexture", "normalTexture"
_CHANNELS = {"occlusion": 0, "roughness": 1, "metallic": 2}  # of the packed picture


class _Glb(NamedTuple):
    """Hold a binary glTF file: its JSON, the bytes of each buffer view, and its images (parts of the JSON) by the texture they are."""

    tree: dict
    parts: list[bytes]
    images: dict[str, dict]


def has_pictures(mesh: Path) -> bool:
    """Check whether a mesh.glb has all pictures that a run's mesh has."""
    try:
        _read(mesh)
    except (OSError, InputError):
        return False
    return True


def unpack_pictures(mesh: Path, folder: Path) -> dict[str, Path]:
    """Write the pictures inside a run's mesh.glb into a new folder, as the PNG textures that the trainer writes beside the mesh.

    Returns the files by the textures' names. Raises InputError if RefGS did not write the mesh, and OSError if a file cannot be read or
    written.
    """
    from .pictures import read_png, write_png  # needs numpy, which Debian's Blender may lack

    glb = _read(mesh)
    folder.mkdir(parents=True)
    pictures = {}
    for key, image in glb.images.items():
        file = folder / key
        file.write_bytes(glb.parts[image["bufferView"]])
        pictures[key] = read_png(file)[..., :3]
        file.unlink()
    textures = {"base_color": pictures[BASE_COLOR], "normal": pictures[NORMAL]}
    textures |= {name: pictures[PACKED][..., [channel] * 3] for name, channel in _CHANNELS.items()}
    files = {name: folder / f"{name}.png" for name in textures}
    for name, file in files.items():
        write_png(file, textures[name])
    return files


def replace_pictures(mesh: Path, base_color: Path, packed: Path) -> bytes:
    """Return the bytes of a mesh.glb with other PNG pictures for base colour and for occlusion, roughness and metallic.

    Raises InputError if RefGS did not write the mesh.
    """
    tree, parts, images = _read(mesh)
    for key, file in ((BASE_COLOR, base_color), (PACKED, packed)):
        place = images[key]["bufferView"]
        parts[place] = file.read_bytes()
        for image in tree["images"]:  # occlusion may be an image of its own, of the same bytes
            if image.get("bufferView") == place:
                image["mimeType"] = "image/png"
    whole = bytearray()
    for view, part in zip(tree["bufferViews"], parts, strict=True):
        view["byteOffset"], view["byteLength"] = len(whole), len(part)
        whole += part + bytes(-len(part) % 4)
    tree["buffers"][0]["byteLength"] = len(whole)
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = [len(text).to_bytes(4, "little"), b"JSON", text, len(whole).to_bytes(4, "little"), b"BIN\0", bytes(whole)]
    size = 12 + sum(map(len, chunks))
    return b"".join([b"glTF", (2).to_bytes(4, "little"), size.to_bytes(4, "little"), *chunks])


def _read(mesh: Path) -> _Glb:
    """Read a run's mesh.glb. Raises InputError if it lacks pictures that each run's mesh has."""
    with open_file(mesh) as file:
        data = file.read()
    try:
        length = int.from_bytes(data[12:16], "little")
        tree, buffer = json.loads(data[20 : 20 + length]), data[28 + length :]
        views = [(view.get("byteOffset", 0), view["byteLength"]) for view in tree["bufferViews"]]
        parts = [buffer[start : start + size] for start, size in views]
        material = tree["materials"][0]
        slots = material | material["pbrMetallicRoughness"]
        sources = {key: tree["textures"][slots[key]["index"]]["source"] for key in (BASE_COLOR, PACKED, NORMAL)}
        images = {key: tree["images"][source] for key, source in sources.items()}
        for image in images.values():
            parts[image["bufferView"]]
    except (ValueError, KeyError, IndexError, TypeError):
        raise InputError(f"{mesh} is not a mesh that RefGS wrote: make the run's mesh again") from None
    return _Glb(tree, parts, images)
