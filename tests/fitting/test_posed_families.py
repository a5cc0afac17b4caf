"""Posed families: points are those of the posed body, Jacobians those of finite differences."""

from dataclasses import replace

import pytest
import torch

from avatar.body.families import fixed_family, smpl_family
from avatar.body.open import open_body
from avatar.fitting.posing import Fit, PosedFamily, left_jacobian
from avatar.geometry.transforms import rotation_from_axis_angle


@pytest.fixture(scope="module", params=["smpl", "fixed"])
def family(request, person_folder):
    if request.param == "smpl":
        return smpl_family(person_folder / "template.npz", 3)
    return fixed_family(open_body())


def drawn_fit(family, count=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    drawn = (torch.randn(count, *size, generator=generator) for size in ((22, 3), (3,), (len(family.names),)))
    pose, translation, shape = drawn
    return Fit(0.4 * pose, translation, 0.5 * shape)


def test_points_are_those_of_the_posed_body(family):
    fit = drawn_fit(family)
    posed = PosedFamily(family, fit)
    expected = family.body(fit.shape[1])(fit.pose[1:], fit.translation[1:]).vertices[0]
    torch.testing.assert_close(posed.points()[1], expected, atol=1e-5, rtol=0)
    ids = torch.tensor([[4, 1], [7, 100]])
    torch.testing.assert_close(posed.points_of(ids)[1], expected[ids[1]], atol=1e-5, rtol=0)


def test_jacobians_are_those_of_finite_differences(person_folder):
    """Without pose blendshapes, whose part the Jacobian leaves out."""
    family = replace(smpl_family(person_folder / "template.npz", 3), pose_directions=None)
    fit, step = drawn_fit(family, 1), 2e-3
    ids = torch.arange(0, len(family.bind.vertices), 37)[None]
    exact = PosedFamily(family, fit).jacobian(ids)
    assert exact.shape == (1, ids.shape[1], 3, 66 + 3 + 3)
    flat = torch.cat([fit.pose.flatten(1), fit.translation, fit.shape], dim=1)
    for number in range(flat.shape[1]):
        moved = []
        for sign in (1, -1):
            values = flat.clone()
            values[:, number] += sign * step
            parts = values.split([66, 3, 3], dim=1)
            moved.append(PosedFamily(family, Fit(parts[0].unflatten(1, (22, 3)), *parts[1:])).points_of(ids))
        torch.testing.assert_close((moved[0] - moved[1]) / (2 * step), exact[..., number], atol=1e-3, rtol=0)


def test_the_left_jacobian_turns_rotations_in_the_world():
    generator = torch.Generator().manual_seed(1)
    vectors = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    vectors[0] = 0
    change = 1e-6 * torch.randn(20, 3, generator=generator, dtype=torch.float64)
    turned = rotation_from_axis_angle((left_jacobian(vectors) @ change.unsqueeze(-1))[..., 0])
    expected = rotation_from_axis_angle(vectors + change)
    torch.testing.assert_close(turned @ rotation_from_axis_angle(vectors), expected, atol=1e-10, rtol=0)
