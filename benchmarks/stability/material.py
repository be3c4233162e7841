"""Test shading, prefilter, D-SSIM, activations, Adam and ray tracing with extreme materials, lights and images."""

from functools import partial

import numpy as np
import torch
import trimesh
from torch import Tensor

from benchmarks.stability import compare
from benchmarks.stability.cases import Case, Outcome
from refgs.camera import Camera
from refgs.formats.mesh import Mesh
from refgs.geometry.visibility import Occluder
from refgs.model import cubemap
from refgs.model.learned import Learned
from refgs.model.prefilter import prefilter
from refgs.model.surfels import activate
from refgs.render import reference
from refgs.render.ssim import dssim
from tests.makers import scenes

SIDE, RESOLUTION = 32, 16


def ball(grazing: float | None = None) -> tuple[Tensor, Tensor, Camera]:
    """Make a picture in which a ball covers every pixel. Return maps of normals and positions (H, W, 3), float64, and the camera.

    The camera is far away. If `grazing` is given, normals are replaced so that the cosine between normal and view direction is `grazing` in
    every pixel.
    """
    view = Camera("far", SIDE, SIDE, 1e3, 1e3, SIDE / 2 + 0.13, SIDE / 2 - 0.17, np.eye(4))
    y, x = torch.meshgrid(*[(torch.arange(SIDE, dtype=torch.float64) + 0.5) / SIDE * 1.2 - 0.6] * 2, indexing="ij")
    normal = torch.stack([x, y, -torch.sqrt(1 - x**2 - y**2)], dim=-1)
    ray = scenes.camera_rays(view).double()
    if grazing is not None:
        ray_unit = reference.unit(ray)
        across = reference.unit(normal - (normal * ray_unit).sum(dim=-1, keepdim=True) * ray_unit)
        normal = across - grazing * ray_unit
    # Positions are displaced, so that normals are read a third of a pixel away.
    return (
        normal,
        ray + torch.tensor([0.31e-3, -0.27e-3, 0]).double(),
        view,
    )


def light(sun: float = 0.0, scale: float = 1.0) -> Tensor:
    """Make a cubemap (6·R², 3) of smooth radiance times `scale`. Add the radiance `sun` to one texel that the ball reflects."""
    way = cubemap.texel_directions(RESOLUTION)
    radiance = scale * torch.exp(0.7 * way + 0.2 * torch.sin(5 * way[:, [1, 2, 0]]))
    radiance[int((way @ torch.tensor([0.3, 0.4, -0.87], dtype=torch.float64)).argmax())] += sun
    return radiance.float()


def lit(
    metallic: float | None = None,
    roughness: float | None = None,
    albedo: float | None = None,
    grazing: float | None = None,
    sun: float = 0.0,
    scale: float = 1.0,
    kink: bool = False,
) -> Outcome:
    """Compare the shading of a ball with the float64 reference. Material values that are not given are random.

    `grazing` is the cosine between normal and view direction. `scale` multiplies the light, and `sun` is the extra radiance of one texel.
    Set `kink` if gradients cannot be compared, because the derivative jumps in every pixel.
    """
    normal, position, view = ball(grazing)
    generator = torch.Generator().manual_seed(0)
    material = 0.05 + 0.9 * torch.rand(SIDE, SIDE, 5, generator=generator, dtype=torch.float64)
    for place, value in ((slice(0, 3), albedo), (slice(3, 4), metallic), (slice(4, 5), roughness)):
        if value is not None:
            material[..., place] = value
    alpha = 0.3 + 0.69 * torch.rand(SIDE, SIDE, generator=generator, dtype=torch.float64)
    features = torch.cat([normal, material, position], dim=-1) * alpha[..., None]
    return compare.shading(features.float(), alpha.float(), light(sun, scale), view, kink)


def one_sun(radiance: float) -> Outcome:
    """Check that the prefilter and its gradient are linear, with a light that has one very bright texel of this `radiance`.

    Prefiltering the whole light must give the same as prefiltering the smooth light and the bright texel separately, and adding both.
    """
    smooth, texel = light(), light(sun=1.0) - light()
    both = (smooth + radiance * texel).requires_grad_()
    found = prefilter(both, RESOLUTION)
    exact = prefilter(smooth, RESOLUTION).double() + radiance * prefilter(texel, RESOLUTION).double()
    upstream = [torch.randn(found.shape, generator=torch.Generator().manual_seed(i)) for i in (0, 1)]
    (by,) = torch.autograd.grad(found, both, upstream[0] + radiance * upstream[1])
    by_each = [torch.autograd.grad(prefilter(both, RESOLUTION), both, u)[0].double() for u in upstream]
    error = max(
        compare.worst([found.detach()], [exact]), 0.1 * compare.worst([by], [by_each[0] + radiance * by_each[1]])
    )
    dim = exact < 1e-3 * radiance  # texels out of the sun's reach: its size must not hide their error
    error = max(error, float(((found.detach() - exact).abs() / exact)[dim].max()) / 10)
    return Outcome(bool(found.isfinite().all() and by.isfinite().all()), error)


def likeness(kind: str) -> Outcome:
    """Compare D-SSIM of two images, and its gradient, with float64.

    `kind` names the images: "constant", "black and white", "noise" or "over-exposed".
    """
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 30, 40, 3, generator=generator)
    if kind == "constant":
        image, target = torch.full((2, 30, 40, 3), 0.9)
        image = image - 0.1
    if kind == "black and white":
        image, target = torch.zeros(30, 40, 3), torch.ones(30, 40, 3)
    if kind == "over-exposed":
        image = 1e4 * image
    exact = image.double().requires_grad_()
    expected = reference.dssim(exact, target.double())
    (exact_by,) = torch.autograd.grad(expected, exact)
    found, by = dssim(image, target)
    finite = bool(found.isfinite() and by.isfinite().all())
    return Outcome(finite, max(abs(float(found - expected.detach())), compare.worst([by], [exact_by]) / 50))


def activations() -> Outcome:
    """Compare activations, such as the sigmoid for opacity, with float64, for inputs from -1e4 to 1e4.

    Check also that derivatives are positive for all inputs that training allows.
    """
    raw = torch.tensor([-1e4, -87, -12, -6, -1, 0, 1, 6, 12, 87, 1e4])
    names = ("scale", "opacity", "albedo", "metallic", "roughness")
    empty = {
        n: torch.zeros(11, 1, 3)
        for n in ("position", "rotation", "sh_dc", "sh_rest", "received", "indirect_dc", "indirect_rest")
    }
    leaves = {
        name: (raw[:, None].expand(11, 3) if name == "albedo" else raw).clone().requires_grad_() for name in names
    }
    values = activate(empty | leaves)
    found = [values.scales, values.opacities, values.albedo, values.metallic, values.roughness]
    by = torch.autograd.grad([v.sum() for v in found], list(leaves.values()))
    exact = {n: v.detach().double().clamp(-87, 87) for n, v in leaves.items()}
    slopes = {n: torch.sigmoid(v) * torch.sigmoid(-v) for n, v in exact.items()}
    expected = [exact["scale"].exp(), *(torch.sigmoid(exact[n]) for n in names[1:])]
    expected[3] = 3 * expected[3] ** 2 - 2 * expected[3] ** 3
    exact_by = [expected[0], slopes["opacity"], slopes["albedo"], 6 * slopes["metallic"] ** 2, slopes["roughness"]]
    finite = all(bool(v.isfinite().all()) for v in (*found, *by))
    within = [(0, raw.abs() <= 87), *((i, raw.abs() <= 12) for i in (1, 2, 4)), (3, raw.abs() <= 6)]
    alive = all(bool((by[i][rows] > 0).all()) for i, rows in within)
    error = max(
        float(((f - e).abs() / e)[2:-2].max()) for f, e in zip((v.detach() for v in found), expected, strict=True)
    )
    error = max(error, *(float(((by[i] - exact_by[i]).abs() / exact_by[i])[rows].max()) / 1e3 for i, rows in within))
    return Outcome(finite and alive, error)


def steps(size: float) -> Outcome:
    """Compare a hundred steps of Adam with torch's Adam in float64. The gradients are random; `size` is their standard deviation."""
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(1000, generator=generator)
    gradients = size * torch.randn(100, 1000, generator=generator)
    ours, exact = Learned(), start.double().requires_grad_()
    ours.learn("value", start.clone())
    value, ours.rates["value"] = ours["value"], 1e-2
    torchs = torch.optim.Adam([exact], lr=1e-2, eps=Learned.EPSILON)
    for gradient in gradients:
        value.grad, exact.grad = gradient, gradient.double()
        ours.step(), torchs.step()
    return Outcome(bool(value.isfinite().all()), compare.worst([value.detach()], [exact.detach()]))


def rays(scale: float, offset: float) -> Outcome:
    """Trace random rays from inside a hollow ball with an opening. The error is the fraction of rays whose visibility is wrong.

    Ball and rays are multiplied by `scale` and moved by `offset`.
    """
    shape = trimesh.creation.icosphere(4)
    open_side = shape.triangles_center[:, 2] < 0.3
    mesh = Mesh(shape.vertices * scale + offset, np.asarray(shape.faces)[open_side][:, ::-1])
    rng = np.random.default_rng(0)
    inner = shape.vertices[rng.choice(np.flatnonzero(shape.vertices[:, 2] < 0), 2000)] * 0.9
    way = rng.normal(size=inner.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    found = Occluder(mesh).visible(inner * scale + offset, -inner / 0.9, way)
    # A ray is free where it leaves the ball of radius 1 through its opening.
    b = (inner * way).sum(axis=1)
    leaves = inner + (-b + np.sqrt(b * b - (inner**2).sum(axis=1) + 1))[:, None] * way
    clear = np.abs(leaves[:, 2] - 0.3) > 0.06  # leave out the rim, which is jagged by its triangles
    return Outcome(True, float((found != (leaves[:, 2] > 0.3))[clear].mean()))


SHADE = "float64, same input"
LOOKED_UP = "look-ups stay in the table and in the cubemap"
GRAZING = "half-vectors of no length are bounded; N·V is at least 1e-4 in the table"


def _case(name: str, guard: str, most: float = 1e-5, because: str = compare.FLOAT32, **how) -> Case:
    return Case(f"shade: {name}", partial(lit, **how), SHADE, most, because, guard)


CASES = [
    *(_case(f"roughness {value:g}", LOOKED_UP, roughness=value, kink=value > 0) for value in (0.0, 1e-4, 1.0)),
    *(_case(f"metallic {value:g}", "linear in it", metallic=value) for value in (0.0, 1.0)),
    _case("black albedo", "linear in it", albedo=0.0),
    *(
        _case(f"grazing, N·V = {value:g}", GRAZING, grazing=value, kink=value == 1e-4)
        for value in (1e-2, 1e-4, 1e-6, 0.0)
    ),
    _case("a sun of 1e6 in one texel", "radiance is linear, unclamped", sun=1e6),
    _case("total darkness", "the curve is straight below 0.0031", scale=0.0),
    _case("a light of 1e-30", "the curve is straight below 0.0031", scale=1e-30),
    _case("a light of 1e6", "radiance is linear, unclamped", scale=1e6),
    Case(
        "prefilter: a sun of 1e6 in one texel",
        partial(one_sun, 1e6),
        "sum of parts, float64",
        1e-5,
        compare.FLOAT32,
        "weights are positive and sum to one",
    ),
    *(
        Case(
            f"D-SSIM: {kind}",
            partial(likeness, kind),
            SHADE,
            1e-4,
            "variances are differences of squares",
            "the constants C1 and C2",
        )
        for kind in ("constant", "black and white", "noise", "over-exposed")
    ),
    Case(
        "activations: raw values to ±1e4",
        activations,
        "float64",
        1e-5,
        "1 − s near its end",
        "raw values are kept where slopes count",
    ),
    *(
        Case(
            f"Adam: gradients of {size:g}",
            partial(steps, size),
            "torch, float64",
            1e-5,
            "rounding of a hundred steps",
            guard,
        )
        for size, guard in ((1e-12, "ε = 1e-15"), (1.0, ""), (1e15, "steps whose squares overflow are not taken"))
    ),
    *(
        Case(
            f"rays: scaled by {scale:g}, moved by {offset:g}",
            partial(rays, scale, offset),
            "a ball's geometry",
            0.01,
            "facets",
            guard,
        )
        for scale, offset, guard in ((1e-6, 0.0, "traced at the mesh's own size"), (1e6, 0.0, ""), (1.0, 1e5, ""))
    ),
]
