"""Measure how well photos can distinguish changes of light from changes of material, in float64.

Two changes may cancel: a brighter light and a darker base colour give almost the same pictures. For each such pair of changes, a table
shows the singular values of the pictures' Jacobian. If the smaller one is near zero, photos cannot distinguish the two.

Some loss terms also depend on the two changes. For each such term, the table shows the condition number of the loss with this term. It also
shows how far the term pulls the solution in the direction that photos determine least.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.scenes.analytic import sky, sunny
from benchmarks.stability.cases import Case, Outcome
from benchmarks.stability.material import RESOLUTION, SIDE, ball
from benchmarks.stability.training import ball as capture
from benchmarks.stability.training import train
from refgs.camera import Camera
from refgs.model import cubemap, prefilter
from refgs.render import reference
from refgs.settings import load_settings
from refgs.train.keep.ambiguity import ambiguities
from refgs.train.learn.losses import departure

STEP = 1e-4
ROUNDING = 1e-12  # share of the largest eigenvalue below which others count as zero
RESIDUAL = (
    0.02  # standard deviation of a trained picture's residuals; the curvature of an L1 loss is then 0.8 / RESIDUAL
)
TURNS = ((0, 0, 0), (0, 2.1, 0), (0, 4.2, 0.5))  # rotations of the views about the ball
WARM, MATTE = torch.tensor([0.9, 0.6, 0.3]).double(), torch.tensor([0.2, 0.4, 0.5]).double()
LIGHT, ALBEDO, LIGHT_TINT, TINT, ROUGHNESS, BLUR, METALLIC, EXPOSURE = range(8)
TRADES = {
    "light scale ↔ base colour": (LIGHT, ALBEDO),
    "light tint ↔ base colour's": (LIGHT_TINT, TINT),
    "roughness ↔ light's blur": (ROUGHNESS, BLUR),
    "metallic ↔ base colour": (METALLIC, ALBEDO),
    "light scale ↔ all exposures": (LIGHT, EXPOSURE),
}


class Scene(NamedTuple):
    """Describe a ball under a light. `light` is a function that maps directions to radiance.

    `materials` has one material for the whole ball, or two for its left and right half. A material is base colour, metallic and roughness.
    """

    light: Callable
    materials: tuple[tuple[Tensor, float, float], ...]

    def radiance(self) -> tuple[Tensor, Tensor, Tensor]:
        """Compute three cubemaps (6·R², 3): the light's radiance, its change by a tint, and its change by a blur.

        The tint adds red and removes blue. The blur averages 3×3 neighbouring texels.
        """
        base = torch.from_numpy(self.light(cubemap.texel_directions(RESOLUTION).numpy())).float()
        faces = torch.nn.functional.pad(
            base.view(6, RESOLUTION, RESOLUTION, 3).permute(0, 3, 1, 2), (1,) * 4, mode="replicate"
        )
        mean = torch.nn.functional.avg_pool2d(faces, 3, stride=1).permute(0, 2, 3, 1).reshape(-1, 3)
        return base, base * torch.tensor([1.0, 0.0, -1.0]), mean - base

    def pictures(self, change: Tensor) -> Tensor:
        """Apply eight changes to the scene, such as a brighter light or a higher roughness. Then render the ball from all views.

        Return the sRGB values as one vector (P,). `change` (8,) has the size of each change; its indices are LIGHT, ALBEDO … EXPOSURE.
        """
        normal, position, view = ball()
        base, tint, blur = (prefilter.prefilter(radiance, RESOLUTION).double() for radiance in self.radiance())
        levels = (1 + change[LIGHT]) * base + change[LIGHT_TINT] * tint + change[BLUR] * blur
        left = torch.arange(SIDE)[None, :, None] < SIDE / 2
        rows = []
        for albedo, metallic, roughness in self.materials:
            tinted = albedo * (1 + change[ALBEDO] + change[TINT] * torch.tensor([1.0, 0, -1]).double())
            others = metallic + change[METALLIC] * (1 - 2 * metallic), roughness + change[ROUGHNESS]
            rows.append(torch.cat([tinted, torch.stack(others)]))
        material = torch.where(left, rows[0], rows[-1]).expand(SIDE, SIDE, 5)
        alpha, found = torch.ones(SIDE, SIDE).double(), []
        inside = (normal[..., :2].norm(dim=-1) < 0.6).flatten()
        for turn in TURNS:
            rotation = reference.rotation_matrices(torch.tensor([[1.0, *turn]]).double())[0]
            pose = view.world_to_camera.copy()
            pose[:3, :3] = rotation.numpy()
            turned = Camera("view", SIDE, SIDE, view.fx, view.fy, view.cx, view.cy, pose)
            features = torch.cat([normal @ rotation, material, position @ rotation], dim=-1)
            light = levels, tuple(prefilter.level_sides(RESOLUTION))
            color = reference.shade(
                features, alpha, *light, turned, torch.zeros(3).double(), exposure=change[EXPOSURE].exp()
            )[0]
            found.append(color.reshape(-1, 3)[inside].flatten())
        return torch.cat(found)

    def jacobian(self) -> Tensor:
        """Compute the derivatives (P, 8) of all sRGB values with respect to the eight changes (see `pictures`), divided by √P.

        Central differences are used.
        """
        columns = [self.pictures(STEP * e) - self.pictures(-STEP * e) for e in torch.eye(8).double()]
        return torch.stack(columns, dim=1) / (2 * STEP) / len(columns[0]) ** 0.5

    def weights(self, change: Tensor) -> dict[str, Tensor]:
        """Apply eight changes (see `pictures`) to the scene. Then compute the loss terms of light, materials and exposure.

        Each term is multiplied by its weight in the preset `standard` at the end of a training.
        """
        loss = load_settings("standard").loss
        base, tint, blur = (radiance.double().mean(dim=0) for radiance in self.radiance())
        mean = (1 + change[LIGHT]) * base + change[LIGHT_TINT] * tint + change[BLUR] * blur
        metallic = [m + change[METALLIC] * (1 - 2 * m) for _, m, _ in self.materials]
        rough = [r + change[ROUGHNESS] for *_, r in self.materials]
        return {
            "loss.light": loss.light * ((mean / mean.mean() - 1) ** 2).mean(),
            "loss.metallic": loss.metallic * sum(m * (1 - m) for m in metallic) / len(metallic),
            "loss.exposure": loss.exposure * departure(change[EXPOSURE]),
            "loss.matte": loss.matte * sum((r - 0.3).clamp_min(0) for r in rough) / len(rough),
        }

    def derivatives(self, weight: str) -> tuple[Tensor, Tensor]:
        """Compute the gradient (8,) and the Hessian (8, 8) of one loss term with respect to the eight changes (see `pictures`).

        `weight` is the term's name in the settings, such as "loss.light".
        """
        at = torch.zeros(8).double()
        return tuple(
            derivative(lambda change: self.weights(change)[weight], at)
            for derivative in (torch.autograd.functional.jacobian, torch.autograd.functional.hessian)
        )


# Roughnesses between the prefilter's levels; at a level, derivatives have kinks.
METAL, DIELECTRIC = (
    (WARM, 0.95, 0.2),
    (MATTE, 0.05, 0.45),
)
SCENES = {
    "metal, smooth sky": Scene(sky, (METAL,)),
    "metal, suns": Scene(sunny, (METAL,)),
    "dielectric, smooth sky": Scene(sky, (DIELECTRIC,)),
    "dielectric, suns": Scene(sunny, (DIELECTRIC,)),
    "half metal, half dielectric, suns": Scene(sunny, (METAL, DIELECTRIC)),
}


def condition(hessian: Tensor) -> str:
    """Return the condition number of a 2×2 Hessian as text.

    The text is "no minimum" if an eigenvalue is negative, and "∞" if the smaller one is zero.
    """
    low, high = torch.linalg.eigvalsh(hessian).tolist()
    if abs(low) < ROUNDING * high:
        return "∞"
    return f"{high / low:.0f}" if low > 0 else "no minimum"


def tables() -> list[tuple[str, list[str], list[list[str]]]]:
    """Make a table with a line for each scene and each pair of changes that may cancel. Return its title, headings and lines in a list.

    It shows how well the scene's photos distinguish the two changes.
    """
    weights, rows = ("loss.light", "loss.metallic", "loss.matte", "loss.exposure"), []
    for name, scene in SCENES.items():
        jacobian = scene.jacobian()
        for trade, pair in TRADES.items():
            pair = list(pair)
            _, sigma, ways = torch.linalg.svd(jacobian[:, pair], full_matrices=False)
            data = 0.8 * 0.8 / RESIDUAL * jacobian[:, pair].T @ jacobian[:, pair]  # 0.8 of the loss is L1
            cells = []
            for weight in weights:
                slope, hessian = scene.derivatives(weight)
                slope, hessian = slope[pair], hessian[pair][:, pair]
                pull = (slope @ ways[1]).abs() / (ways[1] @ data @ ways[1])
                moves = bool(hessian.abs().max() > 1e-12 or slope.abs().max() > 1e-12)
                cells.append(f"{condition(data + hessian)}; {float(pull):.2f}" if moves else "–")
            rows.append([name, trade, *(f"{s:.4f}" for s in sigma), condition(data), *cells])
    headings = ["scene", "trade", "σ₁", "σ₂", "condition", *(f"with {name}; pull" for name in weights)]
    return [("Which trades are stiff", headings, rows)]


def by_autograd() -> Outcome:
    """Compare the Jacobian, which is computed by central differences, with torch's automatic differentiation."""
    scene = SCENES["half metal, half dielectric, suns"]
    upstream = torch.randn(
        len(scene.pictures(torch.zeros(8).double())), generator=torch.Generator().manual_seed(0)
    ).double()
    at = torch.zeros(8).double().requires_grad_()
    (exact,) = torch.autograd.grad(scene.pictures(at) @ upstream, at)
    found = scene.jacobian().T @ upstream * len(upstream) ** 0.5
    return Outcome(bool(exact.isfinite().all()), float(((found - exact).abs() / exact.abs().max()).max()))


def ambiguities_are_reported() -> Outcome:
    """Train on a metal ball. Its photos cannot tell a brighter or tinted light from a brighter or tinted base colour.

    Check that the training reports both as ambiguous, and does not report the metallic value.
    """
    trades = ambiguities(train(capture(), total=300).trainer.state)
    right = "what" in trades["light_scale"] and "what" in trades["white_balance"] and "what" not in trades["metal"]
    return Outcome(all(v["left"] <= v["alone"] for v in trades.values()), 0.0 if right else 1.0)


CASES = [
    Case("stiffness: the Jacobian", by_autograd, "autograd, float64", 1e-6, "differences of second order", ""),
    Case(
        "stiffness: a ball of metal",
        ambiguities_are_reported,
        "what is known of it",
        0.0,
        "it is said or not",
        "the report says what photos do not tell",
    ),
]
