"""Poses solved from posed vertices: exact for the body's own, near and with a residual for others."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from bodies import random_body

from avatar.body.model import BodyModel
from avatar.body.open import open_body
from avatar.body.solving import posed_vertices, solve_poses
from avatar.checks import AvatarError


def draw(joints: int, frames: int = 2, spread: float = 0.4) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(joints)
    return spread * torch.randn(frames, joints, 3, generator=generator), torch.randn(frames, 3, generator=generator)


def again(body: BodyModel, solved) -> np.ndarray:
    return np.stack([posed_vertices(body, *pair) for pair in zip(solved.poses, solved.translations)])


@pytest.fixture(scope="module")
def body():
    return open_body("female")


@pytest.mark.parametrize("blendshapes", [False, True])
def test_the_bodys_own_vertices_are_met(body, blendshapes):
    if blendshapes:
        bind = replace(body.template, vertices=body.bind_vertices, joints=body.bind_joints, canonical_from_bind=None)
        directions = torch.randn(len(bind.vertices), 3, 189, generator=torch.Generator().manual_seed(1)) * 2e-3
        body = BodyModel(bind, body.zero_from_bind, pose_directions=directions)
    pose, translation = draw(22)
    vertices = body(pose, translation).vertices.numpy()
    solved = solve_poses(body, vertices)
    assert np.abs(again(body, solved) - vertices).max() < 1e-5 and solved.residuals.max() < 1e-6
    np.testing.assert_allclose(solved.poses, pose.numpy(), atol=1e-3)
    np.testing.assert_allclose(solved.translations, translation.numpy(), atol=1e-4)


@pytest.mark.parametrize("options", [{}, {"canonical": True, "correctives": True}])
def test_any_tree_and_bind_pose(options):
    body = random_body(**options)
    pose, translation = (part.double() for part in draw(len(body.parents), 3))
    assert solve_poses(body, body(pose, translation).vertices.numpy()).residuals.max() < 1e-5


def test_noise_is_averaged_out(body):
    pose, translation = draw(22, 1)
    true = body(pose, translation).vertices.numpy()
    noisy = true + 0.005 * np.random.default_rng(0).standard_normal(true.shape)
    solved = solve_poses(body, noisy)
    assert solved.residuals[0] == pytest.approx(0.005 * np.sqrt(3), rel=0.02)
    assert np.sqrt(np.square(again(body, solved) - true).sum(axis=2).mean()) < 0.001


def test_another_shape_has_a_residual(body):
    pose, translation = draw(22, 1, 0.2)
    solved = solve_poses(body, open_body("male")(pose, translation).vertices.numpy())
    assert 0.01 < solved.residuals[0] < 0.03


def test_joints_beyond_the_body_and_joints_without(body):
    pose = 0.2 * np.random.default_rng(0).standard_normal((24, 3))
    np.testing.assert_array_equal(posed_vertices(body, pose), posed_vertices(body, pose[:22]))
    still = np.concatenate([pose[:20], np.zeros((2, 3))])
    np.testing.assert_array_equal(posed_vertices(body, pose[:20]), posed_vertices(body, still))


def test_refused(body):
    with pytest.raises(AvatarError, match=r"vertices: expected shape \(B, V, 3\)"):
        solve_poses(body, np.zeros((1, 100, 3)))
    with pytest.raises(AvatarError, match="finite"):
        solve_poses(body, np.full((1, len(body.bind_vertices), 3), np.nan))
