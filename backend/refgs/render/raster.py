"""The part that the CPU's and CUDA's rasterisers share."""

import ctypes

from torch import Tensor

from refgs.camera import Camera
from refgs.kernels.load import Work


class Scene(Work):
    """`struct Scene` of raster.h. A rasteriser adds what it works with, and has `project` to find the splats of each tile,
    `blend` to draw them, and `differentiate` to fill the derivatives by the splats."""

    _fields_ = (
        [(n, ctypes.c_int64) for n in ("splats", "channels", "width", "height")]
        + [(n, ctypes.c_void_p) for n in ("positions", "rotations", "scales", "opacities", "features")]
        + [("view", ctypes.c_double * 12)]
        + [(n, ctypes.c_double) for n in ("fx", "fy", "cx", "cy", "near", "upper", "lower")]
        + [(n, ctypes.c_void_p) for n in ("projected", "out_features", "out_depth", "out_alpha")]
        + [(n, ctypes.c_void_p) for n in ("by_features", "by_depth", "by_alpha")]
        + [(n, ctypes.c_void_p) for n in ("by_positions", "by_rotations", "by_scales", "by_opacities")]
        + [("by_splat_features", ctypes.c_void_p)]
    )

    def look(self, camera: Camera, near: float, upper: float = 1.0, lower: float = 0.0) -> None:
        self.width, self.height = camera.width, camera.height
        self.view[:] = camera.world_to_camera[:3].reshape(-1).tolist()
        self.fx, self.fy, self.cx, self.cy, self.near = camera.fx, camera.fy, camera.cx, camera.cy, near
        self.upper, self.lower = upper, lower

    def keep(self, **tensors: Tensor) -> None:
        """Attach tensors, and keep them alive as long as this object."""
        self.attach(**tensors)
        self.kept = getattr(self, "kept", {}) | tensors
