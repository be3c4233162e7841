"""Each surfel's mean gradient on the screen, by which densification divides surfels."""

import ctypes

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels.load import Shared, Work, check, run


class _Work(Work):
    """`struct Motion` of motion.cpp."""

    _fields_ = (
        ("count", ctypes.c_int64),
        *((n, ctypes.c_void_p) for n in ("positions", "gradients")),
        ("view", ctypes.c_double * 12),
        ("accepted", ctypes.c_void_p),
        ("scale", ctypes.c_double),
        *((n, ctypes.c_void_p) for n in ("total", "views", "scratch")),
        ("shared", Shared),
    )


class ScreenGradient:
    """Mean gradient of the loss by a surfel's motion on the screen, in half image widths, as in 3D Gaussian splatting."""

    def __init__(self, count: int, device: torch.device):
        self.total = torch.zeros(count, device=device)
        self.views = torch.zeros(count, device=device)

    @timed("densification")
    @torch.no_grad()
    def add(self, position: Tensor, gradient: Tensor, camera: Camera, accepted: Tensor | None = None) -> None:
        """Add one view's gradient (N, 3) by the world position (N, 3), unless `accepted`, a float32 scalar, is zero."""
        surfels = len(self.total)
        check(total=(self.total, (surfels,)), position=(position, (surfels, 3)), gradient=(gradient, (surfels, 3)))
        position, gradient, work = position.contiguous(), gradient.contiguous(), _Work(count=len(position))
        work.view[:], work.scale = camera.world_to_camera[:3].reshape(-1).tolist(), camera.width / 2 / camera.fx
        work.attach(positions=position, gradients=gradient, total=self.total, views=self.views)
        if accepted is not None:
            work.attach(accepted=accepted)
        run("refgs_motion", work, position, items=work.count)

    def mean(self) -> Tensor:
        """Average over the views (N,); zero where a surfel was never seen."""
        return self.total / self.views.clamp_min(1)
