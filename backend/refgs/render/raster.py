"""Share code between the rasterisers of the CPU and of CUDA cards."""

from torch import Tensor

from refgs.camera import Camera


class Scene:
    """Arguments of a rasteriser's kernels; a mixin for the rasteriser's `struct Raster`.

    A rasteriser adds three methods: `project` finds the splats of each tile, `blend` draws them, `differentiate` fills in the derivatives.
    """

    def look(self, camera: Camera, near: float, upper: float = 1.0, lower: float = 0.0) -> None:
        self.width, self.height = camera.width, camera.height
        self.view[:] = camera.world_to_camera[:3].reshape(-1).tolist()
        self.fx, self.fy, self.cx, self.cy, self.near = camera.fx, camera.fy, camera.cx, camera.cy, near
        self.upper, self.lower = upper, lower

    def keep(self, **tensors: Tensor) -> None:
        """Attach tensors, and keep them alive as long as this object."""
        self.attach(**tensors)
        self.kept = getattr(self, "kept", {}) | tensors
