"""Transforms against scipy's Rotation, closed forms and their own inverses."""

import math

import numpy as np
import pytest
import torch
from reference import rotation_loop
from scipy.spatial.transform import Rotation

from avatar.checks import AvatarError
from avatar.geometry.transforms import (
    assemble_transform,
    axis_angle_from_rotation,
    invert_affine,
    invert_rigid,
    rotation_between,
    rotation_from_axis_angle,
    tilt_rotations,
    transform_directions,
    transform_points,
)


def random_vectors(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_rigid(count: int, seed: int = 0) -> torch.Tensor:
    return assemble_transform(rotation_from_axis_angle(random_vectors(count, seed=seed)), random_vectors(count, seed=9))


def test_rotation_agrees_with_scipy_and_rodrigues():
    vectors = random_vectors(50) * 2
    rotations = rotation_from_axis_angle(vectors).numpy()
    np.testing.assert_allclose(rotations, Rotation.from_rotvec(vectors.numpy()).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotations[0], rotation_loop(vectors[0].numpy()), atol=1e-12)


def test_quarter_turn_about_y_carries_z_to_x():
    quarter = rotation_from_axis_angle(torch.tensor([0, math.pi / 2, 0], dtype=torch.float64))
    z, x = torch.eye(3, dtype=torch.float64)[[2, 0]]
    torch.testing.assert_close(quarter @ z, x)


def test_rotation_gradient_at_zero_and_elsewhere():
    for vectors in (torch.zeros(1, 3, dtype=torch.float64), random_vectors(2)):
        assert torch.autograd.gradcheck(rotation_from_axis_angle, vectors.requires_grad_())


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.5, math.pi - 1e-4, math.pi])
def test_axis_angle_round_trip_up_to_half_turns(angle):
    axis = torch.nn.functional.normalize(random_vectors(20), dim=-1)
    rotation = rotation_from_axis_angle(axis * angle)
    back = axis_angle_from_rotation(rotation)
    torch.testing.assert_close(rotation_from_axis_angle(back), rotation, atol=1e-7, rtol=0)
    torch.testing.assert_close(back.norm(dim=-1), torch.full((20,), angle, dtype=torch.float64), atol=1e-6, rtol=0)


def test_transform_points_is_matrix_times_homogeneous_point():
    transforms, points = random_rigid(7), random_vectors(7)
    homogeneous = torch.cat([points, torch.ones(7, 1, dtype=torch.float64)], dim=-1)
    expected = torch.stack([t @ p for t, p in zip(transforms, homogeneous)])[:, :3]
    torch.testing.assert_close(transform_points(transforms, points), expected)
    difference = transform_points(transforms, points) - transform_points(transforms, torch.zeros_like(points))
    torch.testing.assert_close(transform_directions(transforms, points), difference)


def test_inverses_undo_and_agree_on_rigid_transforms():
    rigid = random_rigid(10)
    identity = torch.eye(4, dtype=torch.float64).expand(10, 4, 4)
    torch.testing.assert_close(invert_rigid(rigid) @ rigid, identity, atol=1e-12, rtol=0)
    torch.testing.assert_close(invert_affine(rigid), invert_rigid(rigid), atol=1e-12, rtol=0)
    blend = 0.3 * rigid + 0.7 * random_rigid(10, seed=5)
    torch.testing.assert_close(invert_affine(blend) @ blend, identity, atol=1e-9, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotation_between_turns_source_onto_target_by_the_smallest_angle(dtype):
    for source, target in zip(random_vectors(30).to(dtype), random_vectors(30, seed=1).to(dtype)):
        rotation = rotation_between(source, target)
        assert rotation.dtype == dtype
        torch.testing.assert_close(rotation @ source / source.norm(), target / target.norm(), atol=2e-6, rtol=0)
        angle = torch.acos(source @ target / source.norm() / target.norm())
        assert float(axis_angle_from_rotation(rotation).norm()) == pytest.approx(float(angle), abs=1e-4)


@pytest.mark.parametrize("bend", [0.0, 1e-12, 1e-9, 1e-7, 1e-4])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -2, 0), (0, 0, 1), (1, 2, -3)])
def test_rotation_between_parallel_and_opposite_directions(direction, sign, bend):
    source = torch.tensor(direction, dtype=torch.float64)
    aside = torch.linalg.cross(source, torch.tensor([0.3, 0.5, 0.7], dtype=torch.float64))
    target = sign * source + bend * aside
    rotation = rotation_between(source, target)
    torch.testing.assert_close(rotation @ source / source.norm(), target / target.norm(), atol=1e-7, rtol=0)
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1)


def test_rotation_between_refuses_a_zero_vector():
    with pytest.raises(AvatarError, match="zero vector"):
        rotation_between(torch.zeros(3), torch.ones(3))


def test_shapes_are_checked():
    with pytest.raises(AvatarError, match="axis_angle: expected shape"):
        rotation_from_axis_angle(torch.zeros(4))
    with pytest.raises(AvatarError, match="linear: expected shape"):
        assemble_transform(torch.zeros(3, 4), torch.zeros(3))


def test_tilt_is_what_no_turn_about_the_vertical_gives():
    lean = rotation_from_axis_angle(torch.tensor([0.5, 0.0, 0.3]))
    for yaw in (-3.0, -0.4, 0.0, 2.0):
        turn = rotation_from_axis_angle(torch.tensor([0.0, yaw, 0.0]))
        torch.testing.assert_close(tilt_rotations(turn @ lean), tilt_rotations(lean))
        torch.testing.assert_close(tilt_rotations(turn), torch.eye(3))
    tilt = tilt_rotations(lean)
    back = lean @ tilt.T  # the turn that was taken away
    torch.testing.assert_close(back[1], torch.tensor([0.0, 1.0, 0.0]))
    others = [rotation_from_axis_angle(torch.tensor([0.0, yaw, 0.0])) for yaw in torch.linspace(-3, 3, 61)]
    assert all((lean - back).norm() <= (lean - other).norm() + 1e-6 for other in others)
