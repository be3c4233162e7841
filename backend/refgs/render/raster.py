"""The part that the CPU's and CUDA's rasterisers share."""

from torch import Tensor

from refgs.camera import Camera


class Scene:
    """Arguments of either rasteriser's kernels: a mixin of its `struct Raster`. A rasteriser has `project` to find the splats
    of each tile, `blend` to draw them, and `differentiate` to fill in the derivatives."""

    def look(self, camera: Camera, near: float, upper: float = 1.0, lower: float = 0.0) -> None:
        self.width, self.height = camera.width, camera.height
        self.view[:] = camera.world_to_camera[:3].reshape(-1).tolist()
        self.fx, self.fy, self.cx, self.cy, self.near = camera.fx, camera.fy, camera.cx, camera.cy, near
        self.upper, self.lower = upper, lower

    def keep(self, **tensors: Tensor) -> None:
        """Attach tensors, and keep them alive as long as this object."""
        self.attach(**tensors)
        self.kept = getattr(self, "kept", {}) | tensors
