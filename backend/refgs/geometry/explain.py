"""Measure how well a shape explains photos, by light that its surface scatters and mirrors.

The surface stays as it is. Its colours and the distant light are learned from some photos, and compared with the others.
"""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, softplus

from refgs.color import srgb_encode
from refgs.formats.mesh import SmoothMesh
from refgs.geometry.field import Field, sample
from refgs.geometry.rays import Rays
from refgs.geometry.visibility import Occluder, mirror

ITERATIONS = 150
RAYS = 6144  # an iteration
RATES = 0.05, 0.03  # of the surface's colours and of the light; they fall to a tenth in the second half
LIGHTS = 8, 16, 32  # texels along a side of the light's octahedral maps, which are added
CELL = 1.5  # voxels along a side of the surface's colours
HELD = 4  # one photo in so many is not learned from
WORST = 0.5  # largest error of a ray, and that of a ray that misses the shape though its pixel shows the object
_SOFT = 0.03  # sRGB code, from which on errors count linearly


class Explained:
    """Hold what a shape tells of N rays.

    `hit` (N,) is true for rays that meet the shape; `distance` (N,) is how far away, in voxels, 0 if they miss it. `error` (N,) is the
    difference of sRGB codes, NaN except for rays of photos that were held out; `mean` is its mean.
    """

    def __init__(self, shape: Field, rays: Rays, seed: int):
        self.rays, self.size = rays, torch.tensor(shape.values.shape)
        self._trace(shape.mesh())
        mean = rays.color.clamp(0.02, 1).mean(dim=0) ** 2.2
        cells = [max(2, round(n / CELL)) for n in shape.values.shape]
        # per cell: scattered radiance (3), tint of the mirrored radiance (3), and roughness
        start = torch.cat([torch.log(torch.expm1(0.8 * mean)), torch.tensor([-2.0, -2.0, -2.0, 0.0])])
        self.surface = start[:, None, None, None].expand(7, *cells).clone().requires_grad_()
        self.light = [torch.full((1, 3, side, side), -0.5, requires_grad=True) for side in LIGHTS]
        hit, held = torch.from_numpy(self.hit), rays.photo % HELD == 0
        self._learn(torch.nonzero(hit & rays.solid & ~held)[:, 0], torch.Generator().manual_seed(seed))
        self.error = torch.where(rays.solid & held, WORST, torch.nan).numpy()
        with torch.no_grad():
            for ids in torch.nonzero(hit & rays.solid & held)[:, 0].split(32768):
                self.error[ids.numpy()] = self._errors(ids).clamp(max=WORST).numpy()
        self.mean = float(np.nanmean(self.error))

    def _trace(self, mesh: SmoothMesh) -> None:
        """Find where rays meet the shape, and where their mirrored rays meet it again."""
        occluder = Occluder(mesh)

        def meet(origin, normal, direction):
            face, weights = occluder.meet(origin, normal, direction)
            corners = mesh.faces[np.maximum(face, 0)]
            point, normal = (
                (weights[..., None] * values[corners]).sum(axis=1) for values in (mesh.vertices, mesh.normals)
            )
            # A smooth normal may point away from the ray where the face does not.
            normal -= direction * np.maximum((normal * direction).sum(axis=1, keepdims=True) + 0.02, 0)
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
            return face >= 0, point, normal, mirror(direction, normal)

        origin, direction = self.rays.origin.numpy(), self.rays.direction.numpy()
        hit, point, normal, mirrored = meet(origin, np.zeros_like(origin), direction)
        again, second, _, on = meet(point + 0.5 * mirrored, normal, mirrored)
        again &= hit
        self.hit, self.again = hit, torch.from_numpy(again)
        self.distance = np.where(hit, ((point - origin) * direction).sum(axis=1), 0)
        values = (
            np.where(met[:, None], v, 0) for met, v in ((hit, point), (hit, mirrored), (again, second), (again, on))
        )
        self.point, self.mirrored, self.second, self.onward = (torch.from_numpy(v.astype(np.float32)) for v in values)

    def _learn(self, ids: Tensor, random: torch.Generator) -> None:
        rates = [
            {"params": values, "lr": rate} for values, rate in zip(([self.surface], self.light), RATES, strict=True)
        ]
        adam = torch.optim.Adam(rates, betas=(0.9, 0.98), eps=1e-10, fused=True)
        decay = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: 0.1 ** max(0, 2 * step / ITERATIONS - 1))
        for _ in range(ITERATIONS if len(ids) else 0):
            adam.zero_grad(set_to_none=True)
            self._errors(ids[torch.randint(len(ids), (RAYS,), generator=random)]).mean().backward()
            adam.step()
            decay.step()

    def _errors(self, ids: Tensor) -> Tensor:
        """Return the errors (M,) of rays."""
        found, wanted = srgb_encode(self._radiance(ids).clamp(min=1e-5)), self.rays.color[ids]
        off = torch.where(self.rays.clipped[ids] & (found > wanted), 0, found - wanted)
        return torch.sqrt(off.square().sum(dim=1) + _SOFT**2) - _SOFT

    def _radiance(self, ids: Tensor) -> Tensor:
        """Return the linear radiance (M, 3) that comes along rays."""
        scattered, tint, rough = self._look(self.point[ids])
        light = self._shine(self.mirrored[ids], rough)
        again = torch.nonzero(self.again[ids])[:, 0]
        more, tint_again, rough = self._look(self.second[ids[again]])
        light = light.index_copy(0, again, more + tint_again * self._shine(self.onward[ids[again]], rough))
        return scattered + tint * light

    def _look(self, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the scattered radiance (M, 3), the tint (M, 3) and the roughness (M, 1) at positions (M, 3)."""
        cells = torch.tensor(self.surface.shape[1:])
        values = sample(self.surface, at * ((cells - 1) / (self.size - 1)))
        return softplus(values[:, :3]), torch.sigmoid(values[:, 3:6]), torch.sigmoid(values[:, 6:])

    def _shine(self, direction: Tensor, rough: Tensor) -> Tensor:
        """Return the light's radiance (M, 3) from directions (M, 3); rough surfaces see the coarse maps."""
        x, y, z = (direction / direction.abs().sum(dim=1, keepdim=True).clamp(min=1e-6)).unbind(1)
        u = torch.where(z >= 0, x, (1 - y.abs()) * torch.where(x >= 0, 1.0, -1.0))
        v = torch.where(z >= 0, y, (1 - x.abs()) * torch.where(y >= 0, 1.0, -1.0))
        at = torch.stack([u, v], dim=1)[None, None]
        maps = (grid_sample(map_, at, align_corners=False, padding_mode="border")[0, :, 0].T for map_ in self.light)
        coarse, middle, fine = maps
        return softplus(coarse + (1 - rough / 2) * middle + (1 - rough) * fine, beta=2)
