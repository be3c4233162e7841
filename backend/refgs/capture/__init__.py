"""Read the cameras and photos of a capture: a folder in one of several file layouts (COLMAP, nerfstudio …), each with its own module."""

from refgs.capture.box import Box
from refgs.capture.cached import load_views, reduced_views, release_memory, remove_cached
from refgs.capture.cameras import read_cameras, read_run_cameras, write_cameras
from refgs.capture.images import LoadedView, load_view
from refgs.capture.nerf_blender import published_normals
from refgs.capture.priors import load_depth, load_normals
from refgs.capture.read import find_layout, read_capture, read_files, to_run_frame
from refgs.capture.types import Capture, CaptureFiles, View

__all__ = [
    "Box",
    "Capture",
    "CaptureFiles",
    "LoadedView",
    "View",
    "find_layout",
    "load_depth",
    "load_normals",
    "load_view",
    "load_views",
    "published_normals",
    "read_cameras",
    "read_capture",
    "read_files",
    "read_run_cameras",
    "reduced_views",
    "release_memory",
    "remove_cached",
    "to_run_frame",
    "write_cameras",
]
