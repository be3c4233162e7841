import math

import numpy as np
import pytest
import torch

from refgs.model import cubemap


@pytest.mark.parametrize("side", [1, 4, 7, 32])
def test_solid_angles_cover_the_sphere(side):
    assert cubemap.texel_solid_angles(side).sum() == pytest.approx(4 * math.pi, rel=1e-12)


def test_symmetries_take_orbits_to_themselves():
    side = 8
    orbits, directions = cubemap.orbits(side), cubemap.texel_directions(side)
    assert orbits.flatten().sort().values.equal(torch.arange(6 * side * side))
    for symmetry in range(cubemap.SYMMETRIES):
        signs = torch.tensor([-1.0 if symmetry & bit else 1.0 for bit in (1, 2, 4)])
        expected = (directions[orbits] * signs).roll(symmetry // 8, dims=-1)
        found = directions[orbits[:, cubemap.compositions()[:, symmetry]]]
        torch.testing.assert_close(found, expected, check_dtype=False)


def test_a_texels_own_direction_reads_that_texel():
    side = 8
    table = torch.rand(6 * side * side, 3, dtype=torch.float64)
    read = cubemap.sample(table, (side,), cubemap.texel_directions(side), torch.zeros(len(table), dtype=torch.float64))
    torch.testing.assert_close(read, table)


def test_no_seam_between_faces():
    """Check that a cubemap has no seam at the edges between its faces.

    The cubemap stores a smooth function and is sampled at the edges. With smaller texels, the error must shrink. At a seam it would not.
    """
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(4000, 3))
    direction[:, 1] = direction[:, 0] * rng.choice([-1, 1], 4000)  # half way between x and y faces
    errors = []
    for side in (16, 32, 64):
        table = torch.sin(3 * cubemap.texel_directions(side) + 1)
        d = torch.nn.functional.normalize(torch.from_numpy(direction), dim=-1)
        read = cubemap.sample(table, (side,), d, torch.zeros(len(d), dtype=torch.float64))
        errors.append(float((read - torch.sin(3 * d + 1)).abs().max()))
    assert errors[0] < 0.2 and errors[1] < 0.62 * errors[0] and errors[2] < 0.62 * errors[1], errors


def test_gradients_match_differences():
    torch.manual_seed(0)
    inputs = torch.rand(6 * (16 + 4), 3), torch.randn(20, 3), torch.rand(20)
    leaves = [v.double().requires_grad_() for v in inputs]
    assert torch.autograd.gradcheck(lambda table, *where: cubemap.sample(table, (4, 2), *where), leaves)
