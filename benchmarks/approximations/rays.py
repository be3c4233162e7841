"""One mirror ray a pixel against more rays of its lobe: whether the object itself is what is mirrored (paper Eq. 9)."""

from collections.abc import Iterator

import numpy as np
import torch
import trimesh

from benchmarks.approximations import Row, rms, timed
from benchmarks.scenes.analytic import sunny
from benchmarks.splitsum import environment, half_vectors
from refgs.formats.mesh import Mesh
from refgs.geometry.visibility import Occluder
from refgs.model import cubemap, prefilter

APART = 1.2  # of two balls' middles, whose radius is 0.5
SIDE = 128


def balls() -> Mesh:
    one, other = (trimesh.creation.icosphere(4, radius=0.5) for _ in range(2))
    for ball, x in ((one, -APART / 2), (other, APART / 2)):
        ball.apply_translation([x, 0, 0])
    both = trimesh.util.concatenate([one, other])
    return Mesh(np.array(both.vertices), np.array(both.faces))


def of_the_object(normals: np.ndarray) -> np.ndarray:
    """What the balls send out (P,), striped, whatever the direction."""
    return 0.4 + 0.3 * np.sin(5 * normals @ [0.0, 0.6, 0.8])


def sky(directions: np.ndarray) -> np.ndarray:
    """Radiance of soft suns: what is left of the error is what they are hidden by."""
    return sunny(directions)[..., 1]


class Surface:
    """Points of the balls, towards each other half of the time, and where they are seen from. Lobes are sampled about each."""

    def __init__(self, count: int):
        rng = np.random.default_rng(3)
        self.mesh = balls()
        self.occluder = Occluder(self.mesh)
        self.normals = rng.normal(size=(count, 3))
        self.normals /= np.linalg.norm(self.normals, axis=1, keepdims=True)
        side = np.where(self.normals[:, 0] < 0, 1.0, -1.0) * np.where(rng.random(count) < 0.5, 1, -1)
        self.points = 0.5 * self.normals + side[:, None] * [APART / 2, 0, 0]
        cosine, azimuth = rng.uniform(0.25, 1, count), 2 * np.pi * rng.random(count)
        helper = np.where(np.abs(self.normals[:, 2:]) < 0.9, [0, 0, 1], [1, 0, 0])
        x = np.cross(helper, self.normals)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        y = np.cross(self.normals, x)
        x = np.cos(azimuth)[:, None] * x + np.sin(azimuth)[:, None] * y
        self.frame = np.stack(
            [x, np.cross(self.normals, x), self.normals], axis=1
        )  # the view is in the first and the third
        self.sine, self.cosine = np.sqrt(1 - cosine**2), cosine
        self.view = self.sine[:, None] * x + cosine[:, None] * self.normals
        self.mirrored = 2 * cosine[:, None] * self.normals - self.view

    def trace(self, which: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of rays (P, 3) from points `which` (P,): whether they are free, and what the object sends along those that are not."""
        face, _ = self.occluder.meet(self.points[which], self.normals[which], ways)
        normals = self.mesh.vertices[self.mesh.faces[face]].mean(axis=1)
        normals -= np.where(normals[:, :1] > 0, 1, -1) * [APART / 2, 0, 0]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return face < 0, np.where(face < 0, 0, of_the_object(normals))

    def lobe(self, roughness: float, rays: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        """Of `rays` directions a point, by the density of visible normals: whether free (P, rays), what the object sends, weights that
        have a sum of one, and the directions (P, rays, 3)."""
        count, alpha = len(self.points), roughness**2
        u, phi = rng.random((count, rays)), 2 * np.pi * rng.random((count, rays))
        # In strata of one variable: as even as a renderer's samples are.
        u = (np.argsort(rng.random((count, rays)), axis=1) + u) / rays
        half = half_vectors(self.sine[:, None], self.cosine[:, None], alpha, u, phi)
        view = np.stack([self.sine, 0 * self.sine, self.cosine], axis=1)[:, None]
        local = 2 * (half * view).sum(-1, keepdims=True) * half - view
        n_l = np.maximum(local[..., 2], 1e-6)
        tails = [np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) for c in (self.cosine[:, None], n_l)]
        weight = np.where(local[..., 2] > 0, (1 + tails[0]) / (tails[0] + tails[1]), 0)
        ways = np.einsum("pra,pab->prb", local, self.frame)
        which = np.repeat(np.arange(count), rays)
        free, sent = self.trace(which, ways.reshape(-1, 3))
        weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
        return free.reshape(count, rays), sent.reshape(count, rays), weight, ways


def mirror_rays(
    rays: tuple[int, ...] = (1, 4, 16, 64),
    points: int = 4096,
    truth: int = 2048,
    roughnesses: tuple[float, ...] = (0.1, 0.3),
) -> Iterator[Row]:
    """A white metal's lobe, by its weighted mean radiance; RMS error by the mean. The light's part is prefiltered and what is free of it
    is told by one mirror ray, or by rays of the lobe; or all is Monte Carlo."""
    surface, light = Surface(points), environment(sky, SIDE)
    levels = cubemap.in_texel_order(light.levels, light.sides)
    rng, unit = np.random.default_rng(0), "error by mean"

    def looked_up(ways: np.ndarray, roughness: float) -> np.ndarray:
        level = torch.full((len(ways),), float(prefilter.level_of(roughness)))
        return cubemap.sample(levels, light.sides, torch.from_numpy(ways).float(), level)[:, 0].double().numpy()

    for roughness in roughnesses:
        name, total, squares, parts = f"mirror rays, roughness {roughness:g}", 0.0, 0.0, max(truth // 256, 2)
        for _ in range(parts):  # at a time what memory holds
            free, sent, weight, ways = surface.lobe(roughness, truth // parts, rng)
            seen = np.where(free, sky(ways), sent)
            part = (weight * seen).sum(axis=1)
            total, squares = total + part, squares + part**2
        exact = total / parts
        own = np.sqrt(np.maximum(squares / parts - exact**2, 0) / (parts - 1))
        mean = exact.mean()

        def one_ray(roughness=roughness) -> np.ndarray:
            free, sent = surface.trace(np.arange(points), surface.mirrored)
            return np.where(free, looked_up(surface.mirrored, roughness), sent)

        def visibility(count: int, roughness=roughness) -> np.ndarray:
            free, sent, weight, _ = surface.lobe(roughness, count, rng)
            reaching = (weight * free).sum(axis=1)
            return reaching * looked_up(surface.mirrored, roughness) + (weight * sent).sum(axis=1)

        def monte_carlo(count: int, roughness=roughness) -> np.ndarray:
            free, sent, weight, ways = surface.lobe(roughness, count, rng)
            seen = sent.copy()
            seen[free] = looked_up(ways[free], 0.0)
            return (weight * seen).sum(axis=1)

        found, spent = timed(one_ray)
        given = unit, spent, True, rms(own) / mean
        yield Row(name, "mirror ray, prefiltered light", "1", rms(found - exact) / mean, *given)
        for method, step in (("rays of the lobe, prefiltered light", visibility), ("Monte Carlo", monte_carlo)):
            for count in rays:
                found, spent = timed(step, count)
                yield Row(name, method, count, rms(found - exact) / mean, unit, spent, False, rms(own) / mean)
