"""Average each surfel's gradient on the screen. Densification divides the surfels whose mean gradient is large."""

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels.layout import struct
from refgs.kernels.load import check, run

_Work = struct("Motion", "motion.cpp")


class ScreenGradient:
    """Average each surfel's screen gradient over views: how strongly the loss depends on the surfel's position on the screen.

    Positions on the screen are in units of half the image's width, as in 3D Gaussian splatting.
    """

    def __init__(self, count: int, device: torch.device):
        self.total = torch.zeros(count, device=device)
        self.views = torch.zeros(count, device=device)

    @timed("densification")
    @torch.no_grad()
    def add(self, position: Tensor, gradient: Tensor, camera: Camera, accepted: Tensor | None = None) -> None:
        """Add one view's gradient of the loss by position, unless the scalar `accepted` is 0."""
        surfels = len(self.total)
        check(total=(self.total, (surfels,)), position=(position, (surfels, 3)), gradient=(gradient, (surfels, 3)))
        position, gradient, work = position.contiguous(), gradient.contiguous(), _Work(count=len(position))
        work.view[:], work.scale = camera.world_to_camera[:3].reshape(-1).tolist(), camera.width / 2 / camera.fx
        work.attach(positions=position, gradients=gradient, total=self.total, views=self.views)
        if accepted is not None:
            work.attach(accepted=accepted)
        run("refgs_motion", work, position, items=work.count)

    def mean(self) -> Tensor:
        """Return the mean length (N,) of surfels' screen gradients, 0 where no view saw them."""
        return self.total / self.views.clamp_min(1)
