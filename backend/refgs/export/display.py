"""Make splats for viewers that compute no lighting: fit spherical harmonics of the view direction to the run's renderings."""

from collections.abc import Callable

import numpy as np
import torch

from refgs.camera import Camera
from refgs.formats.splats import Splats
from refgs.model.learned import Learned
from refgs.render.baselines import draw_colors
from refgs.run import Run

ITERATIONS = 600
VIEWS = 120  # training cameras at most
SIDE = 400  # longest side of a rendering, in pixels
RATE, RATE_OF_REST = 0.02, 2e-3  # initial learning rates of the constant and the other harmonics; they decay to a tenth
DEGREE = 3


def displayed(run: Run, progress: Callable[[int, int], None] = lambda done, total: None) -> Splats:
    """Return the run's splats with spherical harmonics that reproduce its renderings, for viewers that compute no lighting.

    The harmonics have degree 3 and give sRGB-encoded colours by view direction. Adam fits them to renderings from the training cameras
    under the run's light, by squared error. Mirror images become blurred, because degree 3 is low. Positions and shapes of splats stay.

    If the run has no light, the training itself has fitted such harmonics. Then the splats are returned unchanged. `progress` is called
    with the number of iterations done and their total.
    """
    splats = run.splats
    if run.environment is None:
        return splats
    cameras = run.training_cameras()
    cameras = [camera.fitted(SIDE) for camera in cameras[:: -(-len(cameras) // VIEWS)]]
    shown: dict[int, torch.Tensor] = {}
    learned = Learned()
    learned.learn("sh_dc", torch.from_numpy(splats.sh[:, :1].copy()))
    learned.learn("sh_rest", torch.zeros(len(splats), (DEGREE + 1) ** 2 - 1, 3))
    learned.rates |= {"sh_dc": RATE, "sh_rest": RATE_OF_REST}
    constant, rest = learned["sh_dc"], learned["sh_rest"]
    order, queue = np.random.default_rng(0), []
    for iteration in range(ITERATIONS):
        if not queue:
            queue = order.permutation(len(cameras)).tolist()
        number = queue.pop(0)
        if number not in shown:
            shown[number] = run.render(cameras[number]).color.detach().clamp(0, 1)
        loss = (_by_direction(run, constant, rest, cameras[number]) - shown[number]).square().mean()
        constant.grad, rest.grad = torch.autograd.grad(loss, (constant, rest))
        learned.step()
        learned.rates = {name: rate * 0.1 ** (1 / ITERATIONS) for name, rate in learned.rates.items()}
        progress(iteration + 1, ITERATIONS)
    sh = torch.cat([constant, rest], dim=1).detach().numpy()
    return Splats(**{**splats.__dict__, "sh": sh})


def _by_direction(run: Run, constant: torch.Tensor, rest: torch.Tensor, camera: Camera) -> torch.Tensor:
    surfels = run.surfels()._replace(sh_dc=constant, sh_rest=rest)
    background = torch.tensor(run.settings.image.background)
    return draw_colors(surfels, None, camera, background, run.settings.render, run.near).color
