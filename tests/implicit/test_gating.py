"""The local pose gate: the kinematic neighbourhood against a search, locality, invariance to global motion."""

import numpy as np
import pytest
import roma
import torch

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS
from avatar.body.open import open_body
from avatar.checks import AvatarError
from avatar.geometry.transforms import assemble_transform
from avatar.implicit.networks import Attention, PoseGate, attention_map, joint_quaternions

CHAIN = (-1, 0, 1, 2, 3, 4)  # a snake
FORK = (-1, 0, 1, 0, 3)  # two arms of two joints


def test_neighbours_attend_both_ways_and_ancestors_up_alone():
    near = attention_map(FORK, 1, Attention.neighbours, False)
    assert near.tolist() == [[1, 1, 0, 1, 0], [1, 1, 1, 0, 0], [0, 1, 1, 0, 0], [1, 0, 0, 1, 1], [0, 0, 0, 1, 1]]
    assert torch.equal(near, near.T)
    above = attention_map(CHAIN, 2, Attention.ancestors, False)
    for joint in range(6):  # a point skinned to a joint sees it and two above it
        assert above[:, joint].nonzero().flatten().tolist() == list(range(max(0, joint - 2), joint + 1))


def test_normalised_attention_sums_to_one_over_what_a_joint_sees():
    weights = attention_map(SMPL_PARENTS, 4, Attention.neighbours, True)
    torch.testing.assert_close(weights.sum(dim=0), torch.ones(22))
    assert torch.equal(weights > 0, attention_map(SMPL_PARENTS, 4, Attention.neighbours, False) > 0)


def test_quaternions_are_the_rotations_against_the_parent():
    body = open_body("female")
    torch.manual_seed(0)
    pose = 0.8 * torch.randn(3, 22, 3)
    found = joint_quaternions(body(pose).joint_transforms, body.parents)
    expected = roma.rotvec_to_unitquat(pose[:, 1:]).roll(1, dims=-1)
    expected = torch.where(expected[..., :1] < 0, -expected, expected)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)
    rest = joint_quaternions(body(torch.zeros(1, 22, 3)).joint_transforms, body.parents)
    torch.testing.assert_close(rest, torch.tensor([1.0, 0, 0, 0]).expand(1, 21, 4), atol=1e-6, rtol=0)


def test_turning_and_moving_the_whole_person_changes_nothing():
    body, gate = open_body("female"), PoseGate(SMPL_PARENTS)
    torch.manual_seed(0)
    transforms = body(0.5 * torch.randn(2, 22, 3)).joint_transforms
    everything = assemble_transform(roma.random_rotmat(2), torch.randn(2, 3))
    weights = torch.rand(2, 7, 22).softmax(dim=-1)
    moved = gate(weights, everything[:, None] @ transforms)
    torch.testing.assert_close(moved, gate(weights, transforms), atol=1e-5, rtol=1e-4)


def test_a_wrist_reaches_its_own_arm_and_no_leg():
    body, gate = open_body("female"), PoseGate(SMPL_PARENTS)
    pose = torch.zeros(2, 22, 3)
    pose[1, SMPL_JOINTS.index("left_wrist")] = torch.tensor([0.9, -0.4, 0.3])
    features = gate(body.weights[None].expand(2, -1, -1), body(pose).joint_transforms)
    told = (features[0] != features[1]).any(dim=-1).numpy()
    dominant = body.weights.argmax(dim=1).numpy()
    names = np.array(SMPL_JOINTS)[dominant]
    assert told[names == "left_elbow"].all() and told[names == "left_shoulder"].all()
    legs = np.isin(names, ["left_knee", "right_knee", "left_ankle", "right_ankle", "right_hip", "left_foot"])
    assert legs.sum() > 500 and not told[legs].any()


def test_features_are_quaternions_times_attention():
    weights = torch.tensor([[[0.0, 0.25, 0.75, 0.0, 0.0]]])
    quaternions = joint_quaternions(torch.eye(4).expand(1, 5, 4, 4), FORK)
    features = PoseGate(FORK, rings=1)(weights, torch.eye(4).expand(1, 5, 4, 4)).unflatten(-1, (4, 4))
    # joint 1 is seen from 0, 1 and 2; joint 2 from 1 and 2; joint 3 from 0, 3 and 4; joint 4 from 3 and 4
    torch.testing.assert_close(features, torch.tensor([1.0, 1.0, 0.0, 0.0])[None, None, :, None] * quaternions)


@pytest.mark.parametrize("attention", list(Attention))
def test_a_point_attends_as_the_joints_it_is_skinned_to_do(attention):
    """Skinned to one joint alone, the root among them, it sees what the column of that joint says (eq. 18)."""
    rest = torch.eye(4).expand(1, 5, 4, 4)
    gates = PoseGate(FORK, 1, attention)(torch.eye(5)[None], rest).unflatten(-1, (4, 4))[0, :, :, 0]
    torch.testing.assert_close(gates, attention_map(FORK, 1, attention, False)[1:].T)


def test_wrong_joints_are_refused():
    gate = PoseGate(FORK)
    with pytest.raises(AvatarError, match="weights"):
        gate(torch.rand(1, 3, 6), torch.eye(4).expand(1, 5, 4, 4))
    with pytest.raises(AvatarError, match="joint_transforms"):
        gate(torch.rand(1, 3, 5), torch.rand(1, 5, 3))  # poses as axis-angle
    with pytest.raises(AvatarError, match="rings"):
        attention_map(FORK, -1, Attention.neighbours, False)
