"""Relight surfels under another environment, with shadows on the object and light that the object reflects onto itself.

All surfels trace rays in the same directions, spread evenly over the sphere. Each direction stands for a small part of the sphere, and a
small sun falls into exactly one part. Rays are traced once. After that, each new light only takes a few matrix products.

A point that a ray hits reflects two kinds of light, by the split sum. It reflects the environment where the object does not occlude the
point's mirror direction. It also reflects the light that other points reflected in the previous bounce.

What a smooth surface mirrors of the object is too sharp for that. So each pixel also traces its mirror ray, from point to point (`Relit`).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs
from torch import Tensor

from refgs.geometry.mesh import smooth_normals
from refgs.geometry.visibility import Occluder, mirror
from refgs.model import cubemap, harmonics, prefilter
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.brdf import look_up, reflectance

DIRECTIONS = 1024  # over the whole sphere
BOUNCES = 4  # between the object's parts
DEGREE = 3  # of harmonics
PRIOR = 2.0  # weight, in rays, of the object's mean radiance, for surfels that see little of the object
CONE = 0.3  # roughness whose lobe is as wide as a direction's cell
WHITE = 1.0  # radiance is clamped here: harmonics would smear brighter light over the whole hemisphere
ROUGHNESSES = 64  # entries of the table of a coat's transmission by angle
NEIGHBOURS = 8  # surfels blended at a point of the mesh
CHUNK = 512  # surfels at a time
PROBES = 6000  # surfels that are traced where only irradiance is needed; the others interpolate
PROBE_DIRECTIONS = 256  # rays of each of these
MOST_RECEIVED = 4.0  # upper bound of `received`, where the unoccluded irradiance is close to zero

Progress = Callable[[int, int], None]


def sphere(count: int) -> np.ndarray:
    """Spread `count` unit directions (count, 3) evenly over the sphere (Swinbank and Purser 2006)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    azimuth = np.pi * (3 - math.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30)


def _split_sum(albedo: Tensor, metallic: Tensor, roughness: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """Return the reflectances (P, 3) of prefiltered mirrored radiance, and of irradiance / π."""
    metal, dielectric = reflectance(cosine, roughness, albedo)
    metallic = metallic[:, None]
    return metallic * metal + (1 - metallic) * dielectric, (1 - metallic) * (1 - dielectric) * albedo


def _prefiltered(levels: Tensor, sides: tuple[int, ...], directions: Tensor, roughness: Tensor) -> Tensor:
    """Look up prefiltered light (P, 3) from `levels`, with texels in face, row, column order."""
    return cubemap.sample(levels, sides, directions, torch.from_numpy(prefilter.level_of(roughness.numpy())).float())


class Transport:
    """Trace rays from all surfels to the object's mesh, and keep the hits. They do not depend on the light, so any light can use them.

    The surfels' normals must point outward, and their tensors must be on the CPU. `directions` is the number of directions on the sphere.
    `progress` is called with the number of surfels that are done and their total number.
    """

    def __init__(
        self,
        surfels: Surfels,
        occluder: Occluder,
        directions: int = DIRECTIONS,
        progress: Progress = lambda done, total: None,
    ):
        self.surfels, self.occluder = surfels, occluder
        ways, points = sphere(directions), surfels.positions.double().numpy()
        normals, mesh = surfels.normals().double().numpy(), occluder.mesh
        material = [surfels.albedo, surfels.metallic[:, None], surfels.roughness[:, None]]
        self._to_mesh = blend(surfels, normals, mesh.vertices, smooth_normals(mesh.vertices, mesh.faces))
        self.material = self.at_vertices(torch.cat(material, dim=1))  # (V, 5)
        self.vertex_normals = _unit(self._to_mesh @ normals)
        self.directions, self.normals = torch.from_numpy(ways).float(), torch.from_numpy(normals).float()

        basis = harmonics.basis(torch.from_numpy(ways), DEGREE)
        squares = (basis[:, :, None] * basis[:, None]).flatten(1).float()
        degrees = torch.arange(DEGREE + 1)
        prior = torch.diag((degrees + 1.0).repeat_interleave(2 * degrees + 1) ** 2) * PRIOR * harmonics.DC**2

        # H rays hit the mesh. They are kept in the surfels' order: `starts` says where each surfel's begin. Of each ray: its direction, the
        # vertex nearest to the hit, and whether that vertex's mirror direction is free. Of each surfel: the matrix `fit` from sums of
        # radiance times harmonics over its rays to the least-squares harmonics.
        counts, parts, fits = [torch.zeros(1, dtype=torch.int64)], [], []
        for start in range(0, len(points), CHUNK):
            at = slice(start, start + CHUNK)
            surfel, way = np.nonzero(normals[at] @ ways.T > 0)
            face, weights = occluder.meet(points[at][surfel], normals[at][surfel], ways[way])
            met = face >= 0
            surfel, way = surfel[met], way[met]
            vertex = mesh.faces[face[met], weights[met].argmax(axis=1)]
            there = self.vertex_normals[vertex]
            free = occluder.visible(mesh.vertices[vertex], there, mirror(ways[way], there))
            parts.append([torch.from_numpy(part) for part in (way.astype(np.int32), vertex.astype(np.int32), free)])
            seen = torch.zeros(len(points[at]), directions)
            seen[surfel, way] = 1
            counts.append(seen.sum(dim=1).long())
            fits.append(torch.linalg.inv((seen @ squares).unflatten(1, prior.shape) + prior))
            progress(min(start + CHUNK, len(points)), len(points))
        self.starts, self.fit = torch.cat(counts).cumsum(dim=0), torch.cat(fits)
        self.direction, self.vertex, self.free = (torch.cat(part) for part in zip(*parts, strict=True))

    def at_vertices(self, values: Tensor) -> Tensor:
        """Interpolate values (N, C) of the surfels to the mesh's vertices: (V, C)."""
        return torch.from_numpy(self._to_mesh @ values.numpy())

    def chunks(self):
        """Split the surfels into chunks, so that large arrays are needed for only one chunk at a time.

        Yields three values for each chunk:

        - a slice that selects the chunk's surfels
        - a slice that selects the rays from these surfels that hit the mesh
        - for each of these rays, the index of its surfel in the chunk
        """
        for start in range(0, len(self.normals), CHUNK):
            end = min(start + CHUNK, len(self.normals))
            count = self.starts[start + 1 : end + 1] - self.starts[start:end]
            rays = slice(int(self.starts[start]), int(self.starts[end]))
            yield slice(start, end), rays, torch.arange(end - start).repeat_interleave(count)


def blend(surfels: Surfels, normals: np.ndarray, points: np.ndarray, outward: np.ndarray) -> sparse.csr_matrix:
    """Compute the weights (P, N) by which values of the surfels are interpolated to `points` (P, 3). Each row sums to one.

    The points lie on a surface with normals `outward` (P, 3). Near surfels that face the same way have the largest weights.
    """
    positions = surfels.positions.double().numpy()
    near = min(NEIGHBOURS, len(positions))
    distance, at = cKDTree(positions).query(points, k=np.arange(1, near + 1))
    apart = distance / (surfels.scales.double().numpy().mean(axis=1)[at] + 1e-12)
    facing = np.einsum("pka,pa->pk", normals[at], outward).clip(0)
    weight = facing * surfels.opacities.numpy()[at] * np.exp(-0.5 * apart**2)
    weight += 1e-5 / (1 + apart**2)  # for points that no surfel covers
    weight /= weight.sum(axis=1, keepdims=True)
    rows = near * np.arange(len(points) + 1)
    return sparse.csr_matrix((weight.ravel().astype(np.float32), at.ravel(), rows), (len(points), len(positions)))


class Relit(NamedTuple):
    """Hold an object under a light. Render its `surfels` with the setting diffuse = "sh" and with the occluder of `transport`.

    `received` (V, 3) is irradiance / π at the mesh's vertices, and `around` (V, 3) the mean radiance that they see of the object.
    """

    surfels: Surfels
    transport: Transport
    light: Environment
    received: Tensor
    around: Tensor

    def mirrored(self, face: np.ndarray, weights: np.ndarray, directions: np.ndarray) -> Tensor:
        """Compute the radiance (P, 3) that comes back along P rays with unit `directions` (P, 3).

        The rays hit the faces `face` (P,) at barycentric `weights` (P, 3). From there, each follows its mirror direction until it leaves
        the object, at most BOUNCES times.
        """
        transport, mesh = self.transport, self.transport.occluder.mesh
        levels = cubemap.in_texel_order(self.light.levels, self.light.sides)
        radiance, share = torch.zeros(len(face), 3), torch.ones(len(face), 3)
        at_vertices = torch.cat([transport.material, self.received, self.around], dim=1).numpy()
        rays = torch.arange(len(face))
        for bounce in range(BOUNCES):
            corners = mesh.faces[face]
            values = torch.from_numpy(np.einsum("pkc,pk->pc", at_vertices[corners], weights.astype(np.float32)))
            albedo, metallic, roughness, received, around = values.split((3, 1, 1, 3, 3), dim=1)
            normals = _unit(np.einsum("pka,pk->pa", transport.vertex_normals[corners], weights))
            cosine = torch.from_numpy(-np.einsum("pa,pa->p", directions, normals)).float().clamp(0, 1)
            specular, diffuse = _split_sum(albedo, metallic[:, 0], roughness[:, 0], cosine)
            radiance[rays] += share[rays] * diffuse * received
            share[rays] *= specular
            points, directions = np.einsum("pka,pk->pa", mesh.vertices[corners], weights), mirror(directions, normals)
            face, weights = transport.occluder.meet(points, normals, directions)
            brought = _prefiltered(levels, self.light.sides, torch.from_numpy(directions).float(), roughness[:, 0])
            met = torch.from_numpy(face >= 0)
            # What a ray meets adds its light in the next round.
            brought[met] = around[met] if bounce == BOUNCES - 1 else 0.0
            radiance[rays] += share[rays] * brought
            rays, face, weights, directions = rays[met], face[face >= 0], weights[face >= 0], directions[face >= 0]
            if not met.any():
                break
        return radiance


def relit(transport: Transport, light: Environment, bounces: int = BOUNCES) -> Relit:
    """Relight surfels by `light`: with new `sh_*` (diffuse colour) and `indirect_*` (radiance from the object itself).

    `transport` holds the surfels' traced rays. `bounces` counts the reflections between parts of the object.
    """
    received, around, indirect = _gather(transport, light, bounces)
    sh = _diffuse_harmonics(transport.surfels, transport.normals, received)
    surfels = transport.surfels._replace(
        sh_dc=sh[:, :1], sh_rest=sh[:, 1:], indirect_dc=indirect[:, :1], indirect_rest=indirect[:, 1:]
    )
    return Relit(surfels, transport, light, transport.at_vertices(received), transport.at_vertices(around))


def received(surfels: Surfels, occluder: Occluder, light: Environment) -> Tensor:
    """Compute each surfel's irradiance divided by the irradiance of an unoccluded surface: (N, 3).

    The irradiance includes the object's shadows and the light that the object reflects onto itself. The surfels' normals may point inward
    or outward. For speed, rays are traced from a random subset of the surfels, and the result is interpolated to all surfels.
    """
    mesh, positions = occluder.mesh, surfels.positions.double().numpy()
    near = cKDTree(mesh.vertices).query(positions)[1]
    outward = smooth_normals(mesh.vertices, mesh.faces)[near]
    inward = np.einsum("na,na->n", surfels.normals().numpy(), outward) < 0
    surfels = surfels.turned(torch.from_numpy(inward))
    chosen = torch.randperm(len(positions), generator=torch.Generator().manual_seed(0))[:PROBES]
    probes = surfels.chosen(chosen)
    traced = Transport(probes, occluder, PROBE_DIRECTIONS)
    found, _, _ = _gather(traced, light, BOUNCES)
    part = (found / light.diffuse(traced.normals).clamp_min(1e-6)).clamp_max(MOST_RECEIVED)
    wide = probes._replace(scales=probes.scales * math.sqrt(len(positions) / len(chosen)))
    weights = blend(wide, traced.normals.double().numpy(), positions, surfels.normals().double().numpy())
    return torch.from_numpy(weights @ part.numpy())


def _gather(transport: Transport, light: Environment, bounces: int) -> tuple[Tensor, Tensor, Tensor]:
    """Compute irradiance / π (N, 3), the object's mean radiance (N, 3) and its harmonics (N, 16, 3)."""
    past = _past_the_object(transport, light)
    levels = cubemap.in_texel_order(light.levels, light.sides)
    firsts = [_first(transport, rays, levels, light.sides) for _, rays, _ in transport.chunks()]
    basis, count = (
        harmonics.basis(transport.directions, DEGREE),
        (transport.starts[1:] - transport.starts[:-1]).clamp_min(1)[:, None],
    )

    # Of the previous bounce: `received` (N, 3), irradiance / π at the surfels, and `mean` (N, 3), the mean radiance over their rays.
    # The radiance of each ray is clamped at `most`.
    def harmonic_sums(received: Tensor, mean: Tensor, most: float) -> Tensor:
        there = transport.at_vertices(torch.cat([received, mean], dim=1))
        of_surfels = []
        for (surfels, rays, surfel), (first, share, matte) in zip(transport.chunks(), firsts, strict=True):
            scattered, mirrored = there[transport.vertex[rays]].split(3, dim=1)
            brought = torch.zeros(surfels.stop - surfels.start, len(transport.directions), 3)
            brought[surfel, transport.direction[rays]] = (first + matte * scattered + share * mirrored).clamp_max(most)
            of_surfels.append((brought.transpose(1, 2) @ basis).transpose(1, 2))
        return torch.cat(of_surfels)

    received, mean = past, torch.zeros_like(past)
    for _ in range(bounces):
        found = harmonic_sums(received, mean, math.inf)
        mean = found[:, 0] / harmonics.DC / count
        # Harmonics of degree 1 are the direction's coordinates: these are sums of radiance · cosine, 4π / D steradians a ray.
        about = torch.stack([-found[:, 3], -found[:, 1], found[:, 2]], dim=1) / harmonics.C1
        received = past + 4 / len(transport.directions) * torch.einsum(
            "nac,na->nc", about, transport.normals
        ).clamp_min(0)
    found = harmonic_sums(received, mean, WHITE)
    found[:, 0] += PRIOR * found[:, 0].sum(dim=0) / max(len(transport.vertex), 1)
    return received, mean, transport.fit @ found


def _first(transport: Transport, rays: slice, levels: Tensor, sides: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Shade the points where `rays` (a slice of all rays) hit the mesh, by the environment alone.

    Returns three arrays (P, 3) for the P points:

    - environment light that the point mirrors back along the ray; zero where the object occludes the point's mirror direction
    - specular reflectance for light that comes from the object; zero where the object does not occlude the point's mirror direction
    - diffuse reflectance; multiply it by irradiance / π
    """
    vertex, ray, free = transport.vertex[rays], transport.directions[transport.direction[rays]], transport.free[rays]
    albedo, metallic, roughness = transport.material[vertex].split((3, 1, 1), dim=1)
    normals = torch.from_numpy(transport.vertex_normals[vertex.numpy()]).float()
    share, matte = _split_sum(albedo, metallic[:, 0], roughness[:, 0], -(ray * normals).sum(dim=1))
    first = torch.zeros_like(share)
    # Widths of successive lobes add as Gaussians' do: by their squares. A lobe's width is roughness².
    blurred = (roughness[free, 0] ** 4 + CONE**4) ** 0.25
    first[free] = share[free] * _prefiltered(levels, sides, mirror(ray, normals)[free], blurred)
    share[free] = 0
    return first, share, matte


def _past_the_object(transport: Transport, light: Environment) -> Tensor:
    """Compute the surfels' irradiance / π (N, 3) from the environment, shadowed by the object."""
    texels, area = cubemap.texel_directions(light.resolution), cubemap.texel_solid_angles(light.resolution)
    cell = torch.from_numpy(cKDTree(transport.directions.numpy()).query(texels.numpy())[1])
    power = torch.zeros(len(transport.directions), 3).index_add_(0, cell, light.radiance * area[:, None].float())
    free = torch.empty_like(transport.normals)
    for surfels, rays, surfel in transport.chunks():
        cosine = (transport.normals[surfels] @ transport.directions.T).clamp_min(0)
        whole = cosine @ power
        cosine[surfel, transport.direction[rays]] = 0
        free[surfels] = torch.where(whole > 0, cosine @ power / whole, 1)
    return light.diffuse(transport.normals) * free


def _diffuse_harmonics(surfels: Surfels, normals: Tensor, received: Tensor) -> Tensor:
    """Compute the diffuse colour as spherical harmonics (N, 16, 3) of the viewing direction, for colour = 0.5 + SH.

    `received` (N, 3) is irradiance / π. The colour gets darker at grazing viewing angles. There, a dielectric reflects more light at its
    surface, so less comes from its diffuse base. The colour depends only on the angle between normal n and direction d, so its harmonics
    follow from Σ_m Y_lm(n) Y_lm(d) = (2l + 1) / 4π P_l(n·d).
    """
    size, degrees = ROUGHNESSES, torch.arange(4)
    middle = (torch.arange(size).double() + 0.5) / size  # centres of the table's cells, in cosine and roughness
    # d points from the camera to the surfel.
    legendre = torch.from_numpy(np.polynomial.legendre.legvander(-middle.numpy(), 3))
    coat = 1 - look_up(middle.repeat(size), middle.repeat_interleave(size))[:, 3].view(size, size)
    zonal = torch.linalg.lstsq(legendre, coat.T).solution.T * 4 * math.pi / (2 * degrees + 1)
    zonal = zonal.repeat_interleave(2 * degrees + 1, dim=1).float()
    row = (surfels.roughness * size).long().clamp(0, size - 1)
    sh = (zonal[row] * harmonics.basis(normals, 3))[..., None] * (surfels.albedo * received)[:, None]
    sh[:, 0] -= 0.5 / harmonics.DC
    return sh
