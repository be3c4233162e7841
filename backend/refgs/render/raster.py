"""Hold what the rasterisers for the CPU and for CUDA cards have in common."""

import ctypes
from collections.abc import Callable

from torch import Tensor

from refgs.camera import Camera


class Scene:
    """Set the arguments that the CPU and CUDA rasterisers have in common.

    This is a mixin. Each rasteriser has a class `Raster`, which derives from `Scene` and from the C struct of the kernels' arguments.
    `Raster` adds three methods, called in this order: `project` finds the splats of each tile, `blend` draws them, `differentiate` computes
    the gradients.
    """

    view: ctypes.Array
    attach: Callable[..., None]  # as `Work` has it

    def look(self, camera: Camera, near: float, upper: float = 1.0, lower: float = 0.0) -> None:
        self.width, self.height = camera.width, camera.height
        self.view[:] = camera.world_to_camera[:3].reshape(-1).tolist()
        self.fx, self.fy, self.cx, self.cy, self.near = camera.fx, camera.fy, camera.cx, camera.cy, near
        self.upper, self.lower = upper, lower

    def keep(self, **tensors: Tensor) -> None:
        """Point fields of the C struct to tensors, and keep these alive in `kept`."""
        self.attach(**tensors)
        self.kept = getattr(self, "kept", {}) | tensors
