"""Families of bodies: their rest shape is their bodies' own, and its derivatives are those of finite differences."""

import pytest
import torch

from avatar.body.families import anny_family, fixed_family, smpl_family
from avatar.body.open import open_body
from avatar.body.smpl import smpl_body
from avatar.checks import AvatarError


@pytest.fixture(scope="module")
def smpl_file(person_folder):
    return person_folder / "template.npz"


@pytest.fixture(scope="module", params=["anny", "smpl", "fixed"])
def family(request, smpl_file):
    kinds = {"anny": anny_family, "smpl": lambda: smpl_family(smpl_file, 4)}
    return kinds.get(request.param, lambda: fixed_family(open_body()))()


def drawn_shape(family):
    """A shape away from the bounds, where derivatives have two sides."""
    drawn = torch.randn(len(family.names), generator=torch.Generator().manual_seed(3))
    return (family.mean + 0.4 * family.std * drawn).clamp(family.low + 0.05, family.high - 0.05)


def test_the_rest_is_that_of_the_posable_body(family):
    shape = drawn_shape(family)
    (vertices,), joints = family.rest(shape[None])
    body = family.body(shape)
    torch.testing.assert_close(vertices, body.bind_vertices, atol=2e-6, rtol=0)
    torch.testing.assert_close(joints[0], body.bind_joints, atol=2e-6, rtol=0)
    torch.testing.assert_close(family.turns(joints)[0], body.zero_from_bind[:, :3, :3], atol=2e-6, rtol=0)


def test_gradients_are_those_of_finite_differences(family):
    shape, step = drawn_shape(family), 4e-3
    for number in range(len(family.names)):
        direction = torch.zeros_like(shape)
        direction[number] = 1.0
        forward, backward = (family.rest((shape + sign * step * direction)[None]) for sign in (1, -1))
        _, exact = torch.autograd.functional.jvp(lambda s: family.rest(s[None]), shape, direction)
        for high, low, derivative in zip(forward, backward, exact):
            torch.testing.assert_close((high - low) / (2 * step), derivative, atol=1e-4, rtol=1e-3)


def test_some_vertices_of_a_family_are_those_of_the_whole(family):
    ids = torch.tensor([5, 3, 700])
    shape = drawn_shape(family)[None]
    torch.testing.assert_close(family.at(ids).rest(shape)[0], family.rest(shape)[0][:, ids], atol=1e-6, rtol=0)


def test_the_open_bodies_are_among_annys():
    shape = torch.tensor([1.0, 2 / 3, 0.5, 0.45, 0.5, 0.5])
    body = open_body("female")
    torch.testing.assert_close(anny_family().body(shape).bind_vertices, body.bind_vertices, atol=2e-5, rtol=0)


def test_a_body_of_other_joints_or_parameters_is_refused(smpl_file):
    with pytest.raises(AvatarError, match="expected the 22 joints of SMPL's body, got 24"):
        fixed_family(smpl_body(smpl_file, all_joints=True))
    with pytest.raises(AvatarError, match=r"shape: expected shape \(B, K\) with K=4, got \(1, 7\)"):
        smpl_family(smpl_file, 4).rest(torch.zeros(1, 7))
