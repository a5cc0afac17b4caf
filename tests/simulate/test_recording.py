"""Configuration, pose selection, gates and resuming, without the solver."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from motion_files import Z_FROM_Y, write_bvh

from avatar.body.open import open_body
from avatar.body.packed import write_body, write_template
from avatar.checks import AvatarError, DataError
from avatar.io.frames import OpenFrame, OpenGarment, read_open_frame, write_open_frame, write_open_garment
from avatar.records import Motion
from avatar.simulate import gates as gates_module
from avatar.simulate.angles import authored_motion
from avatar.simulate.dressing import Rest, bind_pose, pose_path, subject
from avatar.simulate.gates import (
    GateConfig,
    frames_of,
    history_error,
    missed_gates,
    pose_sensitivity,
    record_frame,
    record_motion,
)
from avatar.simulate.poses import KINDS, NamedPose, everyday_poses
from avatar.simulate.recording import (
    PRESETS,
    FrameLedger,
    SimulateConfig,
    dressed_outfits,
    is_valid,
    load_motion,
    settled_poses,
    spread_poses,
)

POSE = NamedPose("walk.00003", np.full((22, 3), 0.1, np.float32))


@pytest.mark.parametrize(
    ("changes", "lists"),
    [
        ({"preset": "fast"}, "quick, sample, full, motion"),
        ({"outfits": ["tee", "tuxedo"]}, "tee, shirt, skirt, dress, jacket, coat"),
        ({"shapes": ["neutral"]}, "female"),
        ({"train": -1}, "at least 0"),
        ({"fps": 0.0}, "fps: expected 1 to 1000"),
        ({"fps": float("nan")}, "fps: expected 1 to 1000"),
        ({"seconds": 0.0}, "seconds: expected above 0"),
        ({"seconds": 1e9}, "seconds: expected 0 to 3600"),
    ],
)
def test_wrong_settings_say_what_is_right(changes, lists):
    with pytest.raises(AvatarError, match=lists):
        SimulateConfig(**changes)


def test_presets_are_as_promised():
    assert len(PRESETS["quick"]["outfits"]) == 1
    assert [PRESETS["sample"][kind] for kind in KINDS] == [60, 20, 10]
    assert (PRESETS["full"]["train"], PRESETS["full"]["test"]) == (300, 100)
    assert not set(PRESETS["motion"]["train_motions"]) & set(PRESETS["motion"]["test_motions"])


def test_folders_tell_bodies_apart(tmp_path):
    both = dressed_outfits(SimulateConfig(outfits=["dress"], shapes=["female", "male"]))
    assert [(folder, clothes.shape) for folder, clothes in both] == [("dress", "female"), ("dress_male", "male")]
    tall = tmp_path / "tall.npz"
    write_body(tall, open_body("male"))
    made = dressed_outfits(SimulateConfig(outfits=["dress"], shapes=[str(tall)]))
    assert [(folder, clothes.shape) for folder, clothes in made] == [("dress_tall", str(tall))]
    with pytest.raises(AvatarError, match=r"shapes: .*none\.npz: expected a file of tools/make_body\.py"):
        SimulateConfig(shapes=[str(tmp_path / "none.npz")])


def test_bodies_from_files_are_of_the_open_topology(tmp_path):
    write_body(tmp_path / "tall.npz", open_body("male"))
    found = subject(str(tmp_path / "tall.npz")).template
    torch.testing.assert_close(found.vertices, open_body("male").template.vertices, atol=1e-6, rtol=0)
    few = open_body("male").template
    write_template(tmp_path / "cut.npz", replace(few, faces=few.faces[:-1], uv=None, uv_faces=None))
    with pytest.raises(DataError, match="make_body"):
        subject(str(tmp_path / "cut.npz"))


def test_settled_poses_follow_preset_and_overrides():
    poses = settled_poses(SimulateConfig(preset="quick", train=3, test=0, interpolation=0))
    assert list(poses) == ["train"] and len(poses["train"]) == 3
    given = settled_poses(
        SimulateConfig(train=4, test=2, interpolation=0, train_motions=["walk"], test_motions=["kick"], seconds=1.0)
    )
    assert [pose.name.split(".")[0] for pose in given["train"] + given["test"]] == ["walk"] * 4 + ["kick"] * 2


def test_spread_poses_take_first_and_last():
    motion = Motion(np.arange(10 * 66, dtype=np.float32).reshape(10, 22, 3), np.zeros((10, 3)), 30.0, "m")
    picked = spread_poses([motion, motion], 3)
    assert [pose.name for pose in picked] == ["m.00000", "m.00000", "m.00009"]
    np.testing.assert_array_equal(picked[-1].pose, motion.poses[-1])


def test_unknown_motion_lists_the_known():
    with pytest.raises(AvatarError, match="walk, squat"):
        load_motion("moonwalk", 30.0, 1.0)


@pytest.mark.parametrize("shape", ["female", "male"])
def test_bind_pose_gives_the_bind_shape(shape):
    body = open_body(shape)
    posed = body(torch.from_numpy(bind_pose(body))[None]).vertices[0]
    torch.testing.assert_close(posed, body.bind_vertices, atol=2e-5, rtol=0)


def test_pose_path_goes_evenly_to_its_end():
    start, end = np.zeros((22, 3), np.float32), np.zeros((22, 3), np.float32)
    end[5] = [0, 1.2, 0]
    path = pose_path(start, end, 9)
    np.testing.assert_allclose(path[-1], end, atol=1e-6)
    assert (np.diff(path[:, 5, 1]) > 0).all() and np.abs(path[:, 5, [0, 2]]).max() < 1e-6


def fake_dressed(speeds):
    """A dressed body whose cloth is one triangle and whose settling goes as listed."""
    triangle = np.array([[0, 0, 1.0], [1, 0, 1], [0, 1, 1]])
    calls = []

    def settle(pose, stride=None, via=()):
        calls.append((stride, len(via)))
        speed = speeds[len(calls) - 1]
        if speed is None:
            raise AvatarError("the solver diverged")
        return Rest(triangle + speed, speed)

    return SimpleNamespace(
        faces=np.array([[0, 1, 2]]),
        garments=[SimpleNamespace(vertices=triangle)],
        travel=SimpleNamespace(stride=0.01),
        outfit=SimpleNamespace(name="fake"),
        settle=settle,
        calls=calls,
    )


@pytest.fixture
def examined(monkeypatch):
    """Frames without a body: nothing inside it, everything seen."""
    monkeypatch.setattr(
        gates_module,
        "examine",
        lambda dressed, pose, cloth: OpenFrame(
            pose, np.zeros(3, np.float32), cloth, np.ones(4, bool), np.ones(1, bool), 0.0, 0.0
        ),
    )


def test_a_frame_that_fails_travels_more_slowly(tmp_path, examined):
    dressed = fake_dressed([None, 0.5, 0.0])
    report = record_frame(dressed, POSE, tmp_path / "train" / "f.npz", GateConfig())
    assert not report.failed and report.attempts == 3
    strides = [stride for stride, _ in dressed.calls]
    assert strides == sorted(strides, reverse=True) and len(set(strides)) == 3
    np.testing.assert_array_equal(read_open_frame(tmp_path / "train" / "f.npz").pose, POSE.pose)


def test_a_frame_that_never_passes_is_not_written(tmp_path, examined):
    report = record_frame(fake_dressed([0.5] * 3), POSE, tmp_path / "f.npz", GateConfig())
    assert report.attempts == 3 and report.failed == ("speed 0.5 > 0.001",)
    assert not (tmp_path / "f.npz").exists()


def test_stretch_is_measured_in_rest_lengths():
    dressed = fake_dressed([])
    frame = OpenFrame(POSE.pose, np.zeros(3), dressed.garments[0].vertices * 1.31, np.ones(4), np.ones(1), 0.0, 0.004)
    assert missed_gates(dressed, frame, 0.0, GateConfig()) == ("stretch 1.31 > 1.3",)
    assert missed_gates(dressed, replace(frame, penetration_depth=0.006), 0.0, GateConfig())[0] == "depth 0.006 > 0.005"


def test_history_error_compares_both_ways():
    dressed = fake_dressed([0.0, 0.003])
    shown = "5.20 mm mean, 5.20 mm at the 95th percentile, 1 poses reached two ways"  # 3 mm along each axis
    assert history_error(dressed, [POSE, POSE]) == f"history error {shown}"
    assert [via for _, via in dressed.calls] == [0, 1]
    with pytest.raises(AvatarError, match="at least 2"):
        history_error(dressed, [POSE])


def test_pose_sensitivity_compares_cloth_with_body():
    dressed = fake_dressed([0.0, 0.004])
    dressed.posed_body = lambda poses: poses
    cloth, body = re.findall(r"[0-9.]+(?= mm)", pose_sensitivity(dressed, [POSE], angle=0.01))
    assert cloth == "6.93"  # 4 mm along each axis
    assert 5 < float(body) < 30
    with pytest.raises(AvatarError, match="at least 1"):
        pose_sensitivity(dressed, [])


def test_only_sound_frames_are_kept(tmp_path):
    path = tmp_path / "f.npz"
    assert not is_valid(path, POSE.pose, 3)
    cloth = np.zeros((3, 3), np.float32)
    write_open_frame(path, OpenFrame(POSE.pose, np.zeros(3), cloth, np.ones(4, bool), np.ones(1, bool)))
    assert is_valid(path, POSE.pose, 3)
    assert not is_valid(path, POSE.pose + 0.1, 3) and not is_valid(path, POSE.pose, 4)
    path.write_bytes(path.read_bytes()[:-20])
    assert not is_valid(path, POSE.pose, 3)


def test_finished_frames_are_known_by_hash_and_those_of_older_versions_taken_over(tmp_path):
    garment = OpenGarment(np.array([[0, 1, 2]]), np.zeros((3, 3), np.float32), np.ones(3, np.uint8), ("tee",))
    write_open_garment(tmp_path / "garment.npz", garment)
    path, cloth = tmp_path / "train" / "f.npz", np.zeros((3, 3), np.float32)
    frame = OpenFrame(POSE.pose, np.zeros(3), cloth, np.ones(4, bool), np.ones(1, bool))
    assert not FrameLedger(tmp_path, 3).has(path, POSE.pose)
    write_open_frame(path, frame)
    assert FrameLedger(tmp_path, 3).has(path, POSE.pose)  # no ledger knew of it
    assert not FrameLedger(tmp_path, 3).has(path, POSE.pose + 0.1)
    write_open_frame(path, replace(frame, cloth=cloth + 0.01))  # valid, and not what was finished
    assert not FrameLedger(tmp_path, 3).has(path, POSE.pose)
    assert not FrameLedger(tmp_path, 3).has(path, POSE.pose, history=2)
    FrameLedger(tmp_path, 3).note(path, POSE.pose)
    FrameLedger(tmp_path, 3).note(path.with_name("refused.npz"), POSE.pose)
    assert FrameLedger(tmp_path, 3).has(path, POSE.pose)
    assert not FrameLedger(tmp_path, 3).has(path.with_name("refused.npz"), POSE.pose)


def test_frame_names_count_from_zero():
    motion = Motion(np.zeros((2, 22, 3)), np.zeros((2, 3)), 30.0, "kick")
    assert [frame.name for frame in frames_of(motion)] == ["kick.00000", "kick.00001"]


def test_frames_of_a_sequence_say_how_many_went_before(tmp_path, examined):
    dressed = fake_dressed([])
    dressed.play = lambda poses: np.stack([dressed.garments[0].vertices] * len(poses))
    motion = Motion(np.zeros((3, 22, 3), np.float32), np.zeros((3, 3)), 30.0, "kick")
    assert len(record_motion(dressed, motion, tmp_path, GateConfig())) == 3
    found = [read_open_frame(tmp_path / f"kick.{frame:05d}.npz").history for frame in range(3)]
    assert found == [0, 1, 2]
    assert is_valid(tmp_path / "kick.00002.npz", motion.poses[2], 3, history=2)
    assert not is_valid(tmp_path / "kick.00002.npz", motion.poses[2], 3)


def test_everyday_sequences_pass_their_poses_smoothly():
    motion = load_motion("stride", 10.0, 2.5, 3)
    assert motion.poses.shape == (25, 22, 3) and motion.name == "stride"
    stops = everyday_poses("stride", 3, 3)
    np.testing.assert_allclose(motion.poses[[0, 10, 20]], stops, atol=1e-5)
    assert np.abs(np.diff(motion.poses, axis=0)).max() < 0.3


def test_a_z_up_motion_file_is_recorded_upright(tmp_path):
    walk = authored_motion("walk", 30, 0.5)
    path = str(write_bvh(tmp_path / "walk.bvh", walk, basis=Z_FROM_Y))
    with pytest.raises(DataError, match="Give up=z"):
        load_motion(path, 30.0, 1.0)
    np.testing.assert_allclose(load_motion(path, 30.0, 1.0, up="z").poses, walk.poses, atol=1e-4)
    with pytest.raises(AvatarError, match="up: expected one of y, z"):
        SimulateConfig(up="north")
