"""Cloth handles: how a garment's vertices hang on them, what poses they see, and the regression between frames."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from spheres import TEMPLATE

from avatar.geometry.surface import farthest_points
from avatar.nn.handles import (
    ClothHandles,
    HandleLayout,
    fold_members,
    fold_numbers,
    left_out_error,
    matern,
    pose_distances,
    pose_features,
)


def two_spheres() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two parts side by side, the first moved by one joint, the second by another."""
    vertices, faces = TEMPLATE.vertices, TEMPLATE.faces
    count = len(vertices)
    weights = torch.zeros(2 * count, 3)
    weights[:count, 1], weights[count:, 2] = 1, 1
    moved = vertices + torch.tensor([2.02, 0, 0])
    return torch.cat([vertices, moved]), torch.cat([faces, faces + count]), weights


VERTICES, FACES, WEIGHTS = two_spheres()
LAYOUT = HandleLayout.on_mesh(VERTICES, FACES, WEIGHTS, 40)
HALF = len(VERTICES) // 2


UPRIGHT = Rotation.identity()


def joint_transforms(turns: np.ndarray, root: Rotation = UPRIGHT) -> torch.Tensor:
    """Transforms ``(N, 3, 4, 4)`` of a root and two joints turned about x by the angles ``(N, 2)``."""
    transforms = torch.eye(4).repeat(len(turns), 3, 1, 1)
    angles = np.concatenate([np.zeros((len(turns), 1)), turns], axis=1)
    for joint in range(3):
        turned = root * Rotation.from_rotvec(angles[:, joint, None] * [1, 0, 0])
        transforms[:, joint, :3, :3] = torch.from_numpy(turned.as_matrix()).float()
    return transforms


def test_vertices_hang_on_the_handles_of_their_own_part():
    assert torch.allclose(LAYOUT.shares.sum(dim=1), torch.ones(len(VERTICES))) and LAYOUT.shares.min() > 0
    assert torch.all(LAYOUT.shares[:, :-1] >= LAYOUT.shares[:, 1:])
    at = farthest_points(VERTICES, 40)
    assert torch.equal(LAYOUT.ids[at, 0], torch.arange(40))  # a handle is the nearest one to its own vertex
    across = ((LAYOUT.ids < 40) & ((at[LAYOUT.ids] < HALF) != (torch.arange(len(VERTICES)) < HALF)[:, None])).float()
    assert float((across * LAYOUT.shares).max()) < 1e-6  # though the parts are 2 cm apart
    groups = LAYOUT.groups
    assert not set(groups[at < HALF].tolist()) & set(groups[at >= HALF].tolist())


def test_a_mesh_with_fewer_vertices_than_handles_has_one_at_each():
    faces = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]])
    vertices = torch.rand(6, 3, generator=torch.Generator().manual_seed(0))
    layout = HandleLayout.on_mesh(vertices, faces, torch.ones(6, 1), 600)
    handles = ClothHandles(layout, torch.zeros(1, 1, 9))
    assert handles.values.shape == (1, 6, 3) and layout.ids[:, 0].unique().tolist() == list(range(6))


def test_poses_are_seen_without_heading_and_with_gravity_where_it_is_asked_for():
    turns = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    plain, turned, tilted = (
        joint_transforms(turns, root)
        for root in (UPRIGHT, Rotation.from_euler("y", 70, degrees=True), Rotation.from_euler("z", 0.5))
    )
    turned = turned.clone()
    turned[..., :3, 3] = 7.0
    for gravity in (False, True):
        torch.testing.assert_close(pose_features(plain, gravity), pose_features(turned, gravity))
        assert torch.allclose(pose_features(plain, gravity), pose_features(tilted, gravity), atol=1e-6) != gravity
    up = pose_features(tilted, True)[0, 0, :3]
    expected = torch.from_numpy(Rotation.from_euler("z", -0.5).as_matrix()[:, 1]).float()
    torch.testing.assert_close(up, expected)


def test_frames_left_out_are_missed_as_by_a_regression_without_them():
    poses = pose_features(joint_transforms(np.random.default_rng(0).uniform(-1, 1, (9, 2))), True).double()
    targets = torch.randn(9, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    kernel = matern(pose_distances(poses, poses, torch.full((1, 3), 0.4, dtype=torch.float64)))[0]
    kernel = kernel + 0.05 * torch.eye(9)
    parts = [torch.tensor([0, 5]), torch.tensor([1, 2, 8]), torch.tensor([3, 4]), torch.tensor([6, 7])]
    folds = torch.tensor([0, 1, 1, 2, 2, 0, 3, 3, 1])
    expected = 0.0
    for part in parts:
        rest = torch.tensor([row for row in range(9) if row not in part.tolist()])
        found = kernel[part][:, rest] @ torch.linalg.solve(kernel[rest][:, rest], targets[rest])
        expected += float((targets[part] - found).square().sum())
    inverse, products = torch.linalg.inv(kernel), targets @ targets.T
    found = left_out_error(torch.stack([inverse, inverse]), torch.stack([products, 4 * products]), fold_members(folds))
    assert found.tolist() == pytest.approx([expected, 4 * expected], rel=1e-9)


def test_poses_are_as_far_apart_as_their_relevant_joints():
    one, other = (torch.randn(count, 3, 9, generator=torch.Generator().manual_seed(count)) for count in (4, 5))
    relevance = torch.tensor([[1.0, 0, 0], [0.5, 2, 1]])
    expected = torch.einsum("cj,bnj->cbn", relevance.square(), (one[:, None] - other).square().sum(dim=-1))
    torch.testing.assert_close(pose_distances(one, other, relevance), expected)


def test_neighbours_in_time_are_left_out_together():
    folds = fold_numbers(100)
    assert folds.tolist() == sorted(folds.tolist()) and torch.bincount(folds).tolist() == [5] * 20
    assert fold_numbers(3).tolist() == [0, 1, 2]


def moved_by(turns: np.ndarray) -> torch.Tensor:
    """Offsets ``(N, V, 3)``: the first part swings with the first joint, the second with the second, metres."""
    swing = torch.from_numpy(0.1 * np.sin(turns)).float()
    offsets = torch.zeros(len(turns), len(VERTICES), 3)
    offsets[:, :HALF, 1], offsets[:, HALF:, 2] = swing[:, :1], swing[:, 1:]
    return offsets


def fitted(turns: np.ndarray, noise: float = 0.0) -> ClothHandles:
    """Handles whose parameters are the true offsets of training poses, fitted."""
    handles = ClothHandles(LAYOUT, pose_features(joint_transforms(turns), True))
    with torch.no_grad():
        handles.values.copy_(moved_by(turns)[:, farthest_points(VERTICES, 40)])
        handles.values.add_(noise * torch.randn(handles.values.shape, generator=torch.Generator().manual_seed(0)))
    handles.fit(mirrored=False)
    return handles


def test_unseen_poses_are_predicted_and_each_part_sees_its_own_joint():
    rng = np.random.default_rng(0)
    seen, unseen = rng.uniform(-1, 1, (40, 2)), rng.uniform(-0.9, 0.9, (20, 2))
    handles = fitted(seen)
    found = handles.predict(pose_features(joint_transforms(unseen), True))
    error = (found - moved_by(unseen)).norm(dim=-1).mean() / moved_by(unseen).norm(dim=-1).mean()
    assert float(error) < 0.1  # measured: 0.01
    first, second = (handles.relevance[groups].mean(dim=0) for groups in groups_of_parts())
    assert first[1] > 2 * first[2] and second[2] > 2 * second[1] and max(first[0], second[0]) < 0.3


def groups_of_parts() -> tuple[torch.Tensor, torch.Tensor]:
    first = farthest_points(VERTICES, 40) < HALF
    return LAYOUT.groups[first].unique(), LAYOUT.groups[~first].unique()


def test_noise_is_smoothed_away():
    seen = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    handles = fitted(seen, noise=0.02)
    found, true = handles.predict(handles.poses), moved_by(seen)
    given = handles(torch.arange(40)).detach()
    assert float((found - true).norm(dim=-1).mean()) < 0.6 * float((given - true).norm(dim=-1).mean())


def test_a_training_frame_has_parameters_of_its_own():
    handles = ClothHandles(LAYOUT, torch.zeros(6, 3, 9))
    handles(torch.tensor([4, 1])).sum().backward()
    moved = handles.values.grad.abs().sum(dim=(1, 2)) > 0
    assert moved.tolist() == [False, True, False, False, True, False]


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_few_frames_are_fitted_too(frames):
    handles = fitted(np.linspace(-1, 1, frames)[:, None].repeat(2, axis=1))
    assert torch.isfinite(handles.predict(handles.poses)).all()


def test_mirror_images_are_left_out_with_their_frames():
    """Offsets that follow no pose, and copies as images: left out alone, each frame would be predicted by its copy."""
    turns = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    handles = ClothHandles(LAYOUT, pose_features(joint_transforms(np.concatenate([turns, turns])), True))
    noise = 0.1 * torch.randn(20, *handles.values.shape[1:], generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        handles.values.copy_(torch.cat([noise, noise]))
    spread = {}
    for mirrored in (False, True):
        handles.fit(mirrored)
        found = handles.predict(handles.poses)
        spread[mirrored] = float((found - found.mean(dim=0)).norm())
    assert spread[True] < 0.5 * spread[False]


def test_the_fit_repeats():
    handles = fitted(np.random.default_rng(0).uniform(-1, 1, (10, 2)))
    first = handles.duals.clone()
    handles.fit(mirrored=False)
    assert torch.equal(first, handles.duals) and float(first.abs().max()) > 0
