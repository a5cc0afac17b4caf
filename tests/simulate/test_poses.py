"""Poses: within limits, clear of themselves, repeatable, and training poses apart from test poses."""

from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS
from avatar.body.open import open_body
from avatar.checks import AvatarError
from avatar.simulate.angles import (
    CENTRAL,
    EVERYDAY,
    LIMITS,
    SEQUENCES,
    authored_motion,
    everyday_angles,
    pose_from_angles,
)
from avatar.simulate.poses import (
    APART,
    KINDS,
    NamedPose,
    clear_of_itself,
    draw_poses,
    everyday_poses,
    random_angles,
    split_distances,
)


@cache
def female():
    return open_body("female").template


def joint_positions(pose):
    """Joint positions of the female body by explicit recursion over the tree."""
    template = female()
    rest, parents = template.joints.numpy(), template.parents
    turned, places = [], []
    for joint, parent in enumerate(parents):
        own = Rotation.from_rotvec(pose[joint])
        turned.append(own if parent < 0 else turned[parent] * own)
        places.append(rest[joint] if parent < 0 else places[parent] + turned[parent].apply(rest[joint] - rest[parent]))
    return dict(zip(SMPL_JOINTS, places))


def test_named_angles_move_what_they_name():
    at_ease = joint_positions(pose_from_angles({}, 1)[0])
    assert at_ease["left_wrist"][1] < at_ease["left_shoulder"][1] - 0.35  # arms hang
    for side, outward in (("left", 1), ("right", -1)):
        moved = joint_positions(pose_from_angles({f"{side}_hip_flexion": 60, f"{side}_arm_abduction": 130}, 1)[0])
        assert moved[f"{side}_knee"][2] > 0.25  # forward
        assert moved[f"{side}_knee"][1] > at_ease[f"{side}_knee"][1] + 0.1  # and up
        assert moved[f"{side}_wrist"][1] > at_ease[f"{side}_shoulder"][1] + 0.2
        moved = joint_positions(pose_from_angles({f"{side}_knee_flexion": 90}, 1)[0])
        assert moved[f"{side}_ankle"][2] < -0.3  # heel back
        moved = joint_positions(pose_from_angles({f"{side}_elbow_flexion": 90, f"{side}_arm_flexion": 40}, 1)[0])
        assert moved[f"{side}_wrist"][2] > 0.3
        moved = joint_positions(pose_from_angles({f"{side}_hip_abduction": 30}, 1)[0])
        assert outward * moved[f"{side}_ankle"][0] > outward * at_ease[f"{side}_ankle"][0] + 0.2
    bowed = joint_positions(pose_from_angles({"trunk_bend": 50, "trunk_twist": 30}, 1)[0])
    assert bowed["head"][2] > 0.2
    assert bowed["right_shoulder"][2] > bowed["left_shoulder"][2] + 0.1  # twisted to the left


def test_angles_are_held_within_limits():
    wild = {name if name in CENTRAL else f"left_{name}": 1000.0 for name in LIMITS}
    held = {key: LIMITS[key.removeprefix("left_")][2] for key in wild}
    np.testing.assert_array_equal(pose_from_angles(wild, 1), pose_from_angles(held, 1))
    with pytest.raises(AvatarError, match="got left_kne"):
        pose_from_angles({"left_kne": 3}, 1)


def test_the_same_seed_gives_the_same_poses_and_another_gives_others():
    for kind in KINDS:
        first, again, other = (draw_poses(16, seed, kind) for seed in (0, 0, 1))
        assert [pose.name for pose in first] == [pose.name for pose in again]
        assert all((a.pose == b.pose).all() for a, b in zip(first, again))
        assert any((a.pose != b.pose).any() for a, b in zip(first, other))
        assert len({pose.name for pose in first}) == len(first) == 16
        assert first[0].pose.shape == (22, 3)


def test_random_poses_cover_every_degree_of_freedom():
    angles = random_angles(64, 0)
    for key, values in angles.items():
        low, _, high = LIMITS[key.removeprefix("left_").removeprefix("right_")]
        assert np.ptp(np.clip(values, low, high)) > 0.4 * (high - low), key
    flexion = angles["left_hip_flexion"]
    assert np.corrcoef(flexion, angles["left_knee_flexion"])[0, 1] > 0.2
    assert np.corrcoef(flexion, angles["right_knee_flexion"])[0, 1] > 0.1  # a squat bends both


@pytest.mark.parametrize("seed", [0, 7])
def test_no_train_pose_is_near_a_frame_of_a_test_motion(seed):
    train = np.stack([pose.pose for pose in draw_poses(60, seed, "train")])
    for name, (period, _) in SEQUENCES.items():
        for pose in authored_motion(name, seconds=period).poses:
            assert np.linalg.norm(train - pose, axis=(1, 2)).min() > APART, name


def test_kinds_are_told_apart_by_their_names():
    names = {kind: {pose.name.split(".")[0] for pose in draw_poses(21, 0, kind)} for kind in KINDS}
    assert names == {"train": {"pose"}, "test": set(SEQUENCES), "interpolation": {"random"}}


def test_half_of_the_train_poses_are_everyday_ones_in_turn():
    train = [pose.pose for pose in draw_poses(16, 0, "train")]
    everyday = [everyday_poses(name, 2, 0) for name in EVERYDAY]
    for i, pose in enumerate(train[::2]):
        np.testing.assert_array_equal(pose, everyday[i % len(EVERYDAY)][i // len(EVERYDAY)])
    random = pose_from_angles(random_angles(32, 0), 32)
    for pose in train[1::2]:
        assert (random == pose).all(axis=(1, 2)).sum() == 1
    fresh = np.stack([pose.pose for pose in draw_poses(8, 0, "interpolation")])
    assert all(np.abs(fresh - pose).max(axis=(1, 2)).min() > 0.1 for pose in train)


@pytest.mark.parametrize("name", EVERYDAY)
def test_everyday_poses_keep_their_feet_under_a_tilted_pelvis(name):
    angles = everyday_angles(name, 32, 0)
    assert np.ptp(angles["pelvis_bend"]) > 10 and np.ptp(angles["pelvis_lean"]) > 5
    straight = np.stack([angles[f"{side}_knee_flexion"] for side in ("left", "right")]).max(axis=0) < 15
    assert straight.any() == (name != "sit")
    for pose in pose_from_angles(angles, 32)[straight][:6]:
        places = joint_positions(pose)
        for side in ("left", "right"):  # thighs hang, wherever the pelvis tilts to
            thigh = places[f"{side}_knee"] - places[f"{side}_hip"]
            assert -thigh[1] > 0.9 * np.linalg.norm(thigh)


@pytest.mark.parametrize("name", SEQUENCES)
def test_authored_motion_is_smooth_loops_and_is_clear_of_itself(name):
    period = SEQUENCES[name][0]
    motion = authored_motion(name, fps=30, seconds=2 * period)
    assert motion.poses.shape == (round(60 * period), 22, 3)
    np.testing.assert_allclose(motion.poses[: round(30 * period)], motion.poses[round(30 * period) :], atol=1e-5)
    speed = np.diff(motion.poses, axis=0) * 30
    assert np.abs(speed).max() < 6  # rad/s: a brisk knee, no jump
    assert np.abs(np.diff(speed, axis=0)).max() < 2
    assert clear_of_itself(motion.poses[:: max(1, round(30 * period) // 10)]).all()
    poses = motion.poses[:, [SMPL_JOINTS.index("left_shoulder"), SMPL_JOINTS.index("pelvis")]]
    assert not poses[:, 1, [0, 2]].any()  # the root only turns about the vertical


def test_walking_arms_swing_against_the_legs():
    poses = authored_motion("walk").poses
    places = [joint_positions(pose) for pose in poses]
    for side, other in (("left", "right"), ("right", "left")):
        arm = np.array([place[f"{side}_wrist"][2] for place in places])
        leg = np.array([place[f"{other}_ankle"][2] for place in places])
        assert np.corrcoef(arm, leg)[0, 1] > 0.7
        assert max(place[f"{side}_wrist"][1] - place[f"{side}_shoulder"][1] for place in places) < -0.25


def test_poses_that_touch_themselves_are_found():
    touching = [
        {"left_arm_abduction": 20, "left_arm_sweep": 60, "left_elbow_flexion": 110},  # hand in the belly
        {"left_arm_flexion": 95, "left_elbow_flexion": 125, "left_arm_sweep": 50},  # hand in the face
    ]
    poses = np.concatenate([pose_from_angles(angles, 1) for angles in touching])
    crossed = pose_from_angles({}, 1)
    crossed[0, [SMPL_JOINTS.index("left_hip"), SMPL_JOINTS.index("right_hip")], 2] = -0.25, 0.25
    poses = np.concatenate([poses, crossed])
    assert not clear_of_itself(poses, 0.0).any()
    assert clear_of_itself(pose_from_angles({}, 1)).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: draw_poses(3, 0, "val"), "kind: expected one of train, test"),
        (lambda: draw_poses(0, 0, "train"), "count: expected at least 1"),
        (lambda: draw_poses(10_000, 0, "test"), "count: expected at most"),
        (lambda: authored_motion("fly"), "name: expected one of walk"),
        (lambda: authored_motion("walk", 30, 0), "at least one frame"),
        (lambda: authored_motion("walk", 1e9), r"fps: expected 1 to 1000 frames per second, got 1000000000\.0"),
        (lambda: authored_motion("walk", float("nan")), "fps: expected 1 to 1000 frames per second, got nan"),
        (lambda: authored_motion("walk", 30, 1e9), r"seconds: expected 0 to 3600, got 1000000000\.0"),
        (lambda: authored_motion("walk", 30, float("nan")), "seconds: expected 0 to 3600, got nan"),
    ],
)
def test_bad_requests_are_refused(call, message):
    with pytest.raises(AvatarError, match=message):
        call()


def test_distances_of_splits_are_to_the_nearest_training_pose_and_count_straight_legs():
    rest, bent = np.zeros((22, 3), np.float32), np.zeros((22, 3), np.float32)
    bent[SMPL_JOINTS.index("left_knee"), 0] = 1.0
    turned = rest.copy()
    turned[0, 1] = 2.0  # the root's turn makes no difference
    poses = {"train": [NamedPose("a", rest)], "test": [NamedPose("b", bent), NamedPose("c", turned)]}
    body = open_body("female")
    moved, still = (body(torch.from_numpy(pose[None])).vertices[0] for pose in (bent, rest))
    apart = 100 * float((moved - still).norm(dim=-1).mean()) / 2  # the mean of two poses, of which one is not apart
    assert split_distances(poses) == [
        "train: 1 poses, 1 with straight legs",
        f"test: 2 poses, 1 with straight legs; {apart:.1f} cm to the nearest training pose",
    ]
    assert apart > 1
    with pytest.raises(AvatarError, match="train: expected poses to measure from, got those of test"):
        split_distances({"test": poses["test"]})
