"""Array files of motions under the keys, shapes, axes and units that trackers and tools write."""

import json
import logging
import pickle

import numpy as np
import pytest
from motion_files import Z_FROM_Y, planted, smpl_arrays
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS
from avatar.body.open import open_body
from avatar.checks import AvatarError, DataError
from avatar.io.amass import read_betas, read_smpl_arrays
from avatar.io.motions import MotionConfig, read_body_motion, read_motion, write_motion
from avatar.records import Motion
from avatar.simulate.angles import authored_motion

DOWN = np.diag([1.0, -1.0, -1.0])  # camera frames: y down
LEFT = [joint for joint, name in enumerate(SMPL_JOINTS) if name.startswith("left")]
RIGHT = [joint for joint, name in enumerate(SMPL_JOINTS) if name.startswith("right")]


@pytest.fixture(scope="module")
def walk():
    return planted(authored_motion("walk", fps=30, seconds=1.5))


def wide(arrays, width):
    """Root and body beside each other, as ``(T, width)``; numbers of hands and face are 0.3."""
    flat = np.concatenate([arrays["root"], arrays["body"]], axis=1)
    return np.concatenate([flat, np.full((len(flat), width - 66), 0.3)], axis=1)


def assert_same(read, walk, degrees=0.05):
    turned = Rotation.from_rotvec(read.poses.reshape(-1, 3)).inv() * Rotation.from_rotvec(walk.poses.reshape(-1, 3))
    assert np.degrees(turned.magnitude()).max() < degrees
    np.testing.assert_allclose(read.translations, walk.translations, atol=2e-3)
    assert read.fps == walk.fps


def spellings(arrays):
    """Keys and values of one motion as different programs write it."""
    root, body, trans = arrays["root"], arrays["body"], arrays["trans"]
    rate, count = np.array(30.0), len(root)
    texts = {"gender": np.array("neutral"), "surface_model_type": np.array("smplx"), "betas": np.zeros(16)}
    hands = {"pose_hand": np.zeros((count, 90)), "pose_jaw": np.zeros((count, 3)), "mocap_frame_rate": rate}
    smplx = {"global_orient": root, "body_pose": body, "transl": trans, "fps": rate}
    for width in (66, 72, 156, 165):
        yield f"poses {width}", {"poses": wide(arrays, width), "trans": trans, "mocap_framerate": rate, **texts}
    for joints in (22, 24, 52, 55):
        poses = wide(arrays, 3 * joints).reshape(count, joints, 3)
        yield f"poses {joints} 3", {"poses": poses, "trans": trans, "mocap_frame_rate": rate}
    yield "SMPL-X", {"root_orient": root, "pose_body": body, "trans": trans, **hands, **texts}
    yield (
        "SMPL-X beside poses",
        {"root_orient": root, "pose_body": body, "trans": trans, "poses": wide(arrays, 165), **hands},
    )
    yield "smplx", smplx | {"left_hand_pose": np.zeros((count, 45)), "right_hand_pose": np.zeros((count, 45))}
    yield "smplx by joints", smplx | {"global_orient": root[:, None], "body_pose": body.reshape(count, 21, 3)}
    yield "smpl of smplx", smplx | {"body_pose": np.concatenate([body, np.zeros((count, 6))], axis=1)}
    yield "float32 and int", {"poses": wide(arrays, 156).astype(np.float32), "trans": trans, "fps": np.array(30)}
    yield "rate as text", {"poses": wide(arrays, 156), "trans": trans, "fps": np.array("30.0")}
    yield "rate as bytes", {"poses": wide(arrays, 156), "trans": trans, "fps": np.array([b"30"])}
    yield "rate (1, 1)", {"poses": wide(arrays, 156), "trans": trans, "fps": np.array([[30]])}


NAMES = [
    name for name, _ in spellings({"root": np.zeros((1, 3)), "body": np.zeros((1, 63)), "trans": np.zeros((1, 3))})
]


@pytest.mark.parametrize("name", NAMES)
def test_one_motion_in_every_spelling(tmp_path, walk, name):
    np.savez(tmp_path / "a.npz", **dict(spellings(smpl_arrays(walk)))[name])
    assert_same(read_motion(tmp_path / "a.npz"), walk)


def test_half_precision_is_read(tmp_path, walk):
    arrays = smpl_arrays(walk)
    half = {"poses": wide(arrays, 156).astype(np.float16), "trans": arrays["trans"].astype(np.float16)}
    np.savez(tmp_path / "a.npz", **half, fps=np.float16(30))
    assert_same(read_motion(tmp_path / "a.npz"), walk, degrees=0.3)


@pytest.mark.parametrize("shape", [(66,), (1, 66), (1, 22, 3)])
def test_a_single_frame(tmp_path, walk, shape):
    arrays = {key: value[:1] for key, value in smpl_arrays(walk).items()}
    trans = arrays["trans"].reshape((3,) if len(shape) == 1 else (1, 3))
    np.savez(tmp_path / "a.npz", poses=wide(arrays, 66).reshape(shape), trans=trans, fps=30)
    one = Motion(walk.poses[:1], walk.translations[:1], 30.0, "a")
    assert_same(read_motion(tmp_path / "a.npz"), one)


@pytest.mark.parametrize("width", [63, 69, 66, 72])
def test_easymocap_turns_about_the_origin(tmp_path, walk, width):
    """Joints of our reading are where ``Rh x + Th`` puts those of the unturned body."""
    arrays, pelvis = smpl_arrays(walk, np.eye(3)), open_body("mean").template.joints[0].double().numpy()
    turned = Rotation.from_rotvec(arrays["root"])
    shift = arrays["trans"] - (turned.apply(pelvis) - pelvis)
    zeros = np.zeros((len(shift), 78))
    poses = np.concatenate([*([] if width in (63, 69) else [zeros[:, :3]]), arrays["body"], zeros], axis=1)[:, :width]
    np.savez(tmp_path / "a.npz", Rh=arrays["root"], Th=shift, poses=poses, fps=30)
    assert_same(read_motion(tmp_path / "a.npz"), walk)


def test_a_file_without_a_rate_takes_the_one_that_is_given(tmp_path, walk, caplog):
    arrays = smpl_arrays(walk)
    bare = {"poses": wide(arrays, 156), "trans": arrays["trans"]}
    np.savez(tmp_path / "a.npz", **bare)
    with pytest.raises(DataError, match=r"a\.npz: expected mocap_framerate or .* Give fps="):
        read_motion(tmp_path / "a.npz")
    read = read_motion(tmp_path / "a.npz", fps=60)
    assert read.fps == 60 and len(read.poses) == len(walk.poses)
    assert "says no frame rate" in caplog.text
    fourth = read_motion(tmp_path / "a.npz", fps=30, frames=slice(None, None, 4))
    assert fourth.fps == 30 and len(fourth.poses) == -(-len(walk.poses) // 4)
    np.savez(tmp_path / "a.npz", **bare, mocap_framerate=np.array(30.0, dtype=object))
    with pytest.raises(
        DataError, match=r"mocap_framerate: expected scalar, found Python objects .*: not read.*Give fps="
    ):
        read_motion(tmp_path / "a.npz")
    assert read_motion(tmp_path / "a.npz", fps=30).fps == 30


def test_frames_are_chosen_before_resampling(tmp_path, walk):
    write_motion(tmp_path / "a.npz", walk)
    read = read_motion(tmp_path / "a.npz", frames=slice(3, 20, 2))
    np.testing.assert_array_equal(read.poses, walk.poses[3:20:2])
    assert read.fps == 15
    assert len(read_motion(tmp_path / "a.npz", fps=30, frames=slice(3, 20, 2)).poses) == 17
    with pytest.raises(DataError, match=r"start, stop: expected frames of the 45 there, got 60:None"):
        read_motion(tmp_path / "a.npz", frames=slice(60, None))
    for wrong in ({"start": -1}, {"start": 4, "stop": 4}, {"step": 0}):
        with pytest.raises(AvatarError, match="start, stop, step: expected"):
            MotionConfig(tmp_path / "a.npz", **wrong)


@pytest.mark.parametrize(
    ("basis", "up", "named"), [(np.eye(3), "y", "y"), (DOWN, "-y", "-y"), (Z_FROM_Y.T, "-z", "-z")]
)
def test_another_up_axis_under_amass_s_keys_is_noticed_and_named(tmp_path, walk, basis, up, named, caplog):
    arrays = smpl_arrays(walk, basis)
    np.savez(tmp_path / "a.npz", poses=wide(arrays, 156), trans=arrays["trans"], mocap_framerate=30)
    problem = rf"upright along z, they are upright along {named} \(1\.00 of 1.*Give up={up}, or up=z if people really"
    with pytest.raises(DataError, match=problem):
        read_motion(tmp_path / "a.npz")
    assert_same(read_motion(tmp_path / "a.npz", up=up), walk)
    assert not caplog.records
    assert_same(read_motion(tmp_path / "a.npz", up="auto"), walk)
    assert f"people stand along {named} (1.00" in caplog.text
    read_motion(tmp_path / "a.npz", up="z")
    assert "people do not stand along z, as up=z says" in caplog.text


@pytest.mark.parametrize("basis", [np.eye(3), DOWN, Z_FROM_Y])
def test_keys_without_a_usual_axis_take_the_one_people_stand_along(tmp_path, walk, basis, caplog):
    arrays = smpl_arrays(walk, basis)
    np.savez(tmp_path / "a.npz", global_orient=arrays["root"], body_pose=arrays["body"], transl=arrays["trans"], fps=30)
    assert_same(read_motion(tmp_path / "a.npz"), walk)
    assert "which is taken for up" in caplog.text


def test_people_who_lie_along_x_are_warned_about(tmp_path, walk, caplog):
    lying = smpl_arrays(walk, Rotation.from_rotvec([0, 0, -np.pi / 2]).as_matrix())
    np.savez(tmp_path / "a.npz", poses=wide(lying, 66), trans=lying["trans"], fps=30)
    read_motion(tmp_path / "a.npz")
    assert "of 1 along z, which is taken for up; give up= if it is not" in caplog.text


@pytest.mark.parametrize(("unit", "metres"), [("cm", 0.01), ("mm", 0.001), ("in", 0.0254)])
@pytest.mark.parametrize("fps", [30, 120])
def test_translations_in_other_units_are_noticed_by_the_feet(tmp_path, unit, metres, fps):
    walk = planted(authored_motion("walk", fps=fps, seconds=1.5), noise=0.002)
    arrays = smpl_arrays(walk)
    np.savez(tmp_path / "a.npz", poses=wide(arrays, 156), trans=arrays["trans"] / metres, mocap_framerate=fps)
    with pytest.raises(
        DataError, match=rf"in metres, feet stand still if their unit is .* which is {unit}\. Give units="
    ):
        read_motion(tmp_path / "a.npz")
    np.testing.assert_allclose(read_motion(tmp_path / "a.npz", units=unit).translations, walk.translations, atol=1e-4)
    assert np.ptp(read_motion(tmp_path / "a.npz", units="m").translations) > 10


@pytest.mark.parametrize("name", ["walk", "squat", "twist", "reach", "kick", "bend", "dance"])
def test_right_motions_are_read_without_a_word(tmp_path, name, caplog):
    """Planted or in place, at 30 or 120 frames a second."""
    for number, fps in enumerate((30, 120)):
        motion = authored_motion(name, fps=fps, seconds=2)
        for moved in (motion, planted(motion, noise=0.003)):
            arrays = smpl_arrays(moved)
            np.savez(tmp_path / f"{number}.npz", poses=wide(arrays, 156), trans=arrays["trans"], mocap_framerate=fps)
            read_motion(tmp_path / f"{number}.npz")
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_a_statue_that_is_moved_tells_no_unit(tmp_path, walk):
    still = Motion(np.repeat(walk.poses[:1], 45, axis=0), np.linspace([0, 0, 0], [0, 0, 2], 45), 30.0, "a")
    arrays = smpl_arrays(still)
    np.savez(tmp_path / "a.npz", poses=wide(arrays, 156), trans=arrays["trans"], mocap_framerate=30)
    assert_same(read_motion(tmp_path / "a.npz"), still)


def test_speeds_and_heights_of_no_person_are_noticed(tmp_path, walk, caplog):
    arrays = smpl_arrays(Motion(walk.poses, np.linspace([0, 0, 0], [0, 0, 60], len(walk.poses)), 30.0, "a"))
    np.savez(tmp_path / "a.npz", poses=wide(arrays, 156), trans=arrays["trans"], mocap_framerate=30)
    with pytest.raises(DataError, match=r"slower than 15 m/s, it moves at 40\.9 m/s\. Give units="):
        read_motion(tmp_path / "a.npz")
    arrays = smpl_arrays(Motion(walk.poses, np.linspace([0, 0, 0], [0, 6, 0], len(walk.poses)), 30.0, "a"))
    np.savez(tmp_path / "a.npz", poses=wide(arrays, 156), trans=arrays["trans"], mocap_framerate=30)
    read_motion(tmp_path / "a.npz")
    assert "rises and falls by 6.0 m; give up= or units=" in caplog.text


def test_translations_of_another_axis_than_poses_are_noticed(tmp_path, walk, caplog):
    arrays = smpl_arrays(walk)
    np.savez(tmp_path / "a.npz", poses=wide(arrays, 156), trans=walk.translations, mocap_framerate=30)
    read_motion(tmp_path / "a.npz")
    assert "if they are turned up without the poses: correct the file" in caplog.text


def test_joints_in_another_order_are_noticed(tmp_path, caplog):
    motion = authored_motion("dance", fps=30, seconds=2)
    swapped, openpose = motion.poses.copy(), np.zeros_like(motion.poses)
    swapped[:, LEFT], swapped[:, RIGHT] = motion.poses[:, RIGHT], motion.poses[:, LEFT]
    names = "pelvis neck right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist spine1 right_hip "
    names += "right_knee right_ankle left_hip left_knee left_ankle"
    for joint, name in enumerate(names.split()):
        openpose[:, joint] = motion.poses[:, SMPL_JOINTS.index(name)]
    for poses, fault in ((swapped, "left_elbow bends backwards by"), (openpose, "spine2 is turned by")):
        caplog.clear()
        write_motion(tmp_path / "a.npz", Motion(poses, motion.translations, 30.0, "a"))
        read_motion(tmp_path / "a.npz")
        assert fault in caplog.text and "SMPL's order" in caplog.text
    arrays = smpl_arrays(motion)
    np.savez(tmp_path / "b.npz", poses=wide(arrays, 81), trans=arrays["trans"], fps=30)
    read_motion(tmp_path / "b.npz")
    assert "poses has 81 numbers a frame, which none of SMPL's bodies has" in caplog.text


Z4 = np.zeros((4, 3))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"global_orient": Z4, "body_pose": np.zeros((4, 32)), "transl": Z4}, "body_pose .T, 63"),
        ({"global_orient": Z4, "body_pose": np.zeros((3, 63)), "transl": Z4}, "with T=4 as glo"),
        ({"global_orient": Z4, "body_pose": np.zeros((4, 21, 3, 3)), "transl": Z4}, "Convert rotation matrices"),
        ({"poses": np.zeros((4, 66)), "trans": np.zeros((4, 4))}, r"trans: expected shape \(T, 3\), got \(4, 4\)"),
        ({"poses": np.zeros((4, 66)), "Rh": np.zeros((5, 3)), "Th": Z4}, "Rh: expected shape .* with T=4"),
        ({"poses": np.array([["a"] * 66]), "trans": np.zeros((1, 3))}, "poses: expected number"),
    ],
)
def test_wrong_arrays_are_one_error(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", fps=30, **arrays)
    with pytest.raises(DataError, match=message):
        read_motion(tmp_path / "a.npz")


def test_options_that_a_format_has_no_use_for_are_refused(tmp_path, walk):
    write_motion(tmp_path / "a.npz", walk)
    with pytest.raises(AvatarError, match="joints: expected none"):
        read_motion(tmp_path / "a.npz", joints=tmp_path / "map.yaml")
    with pytest.raises(AvatarError, match="units: expected one of m, cm, mm, in, got 'km'"):
        read_body_motion(tmp_path / "a.npz", open_body("mean"), units="km")
    for ending, hint in ((".amc", "Blender"), (".fbx", "Blender"), (".pkl", "numpy.savez")):
        with pytest.raises(DataError, match=rf"ending in \.npz or \.bvh, got '{ending}'\. .*{hint}"):
            read_motion(tmp_path / f"a{ending}")


def test_body_parameters_of_json_and_pickles(walk, tmp_path):
    """EasyMocap's and smplx's records of one frame, and SMPLify-X's pickles; several people are refused."""
    arrays, pelvis = smpl_arrays(walk), np.zeros(3)
    record = {"global_orient": arrays["root"][:1], "body_pose": arrays["body"][:1], "transl": arrays["trans"][:1]}
    record["betas"] = np.arange(10.0)[None]
    plain = {key: value.tolist() for key, value in record.items()}
    texts = {"a.json": plain, "b.json": [plain], "c.json": {"annots": [plain | {"id": 0}]}}
    for name, content in texts.items():
        (tmp_path / name).write_text(json.dumps(content))
    (tmp_path / "d.pkl").write_bytes(pickle.dumps(record))
    for name in (*texts, "d.pkl"):
        read = read_smpl_arrays(tmp_path / name, pelvis)
        np.testing.assert_allclose(read.poses[0, 0], arrays["root"][0], atol=1e-6)
        np.testing.assert_array_equal(read_betas(tmp_path / name), record["betas"])
    (tmp_path / "a.json").write_text(json.dumps([plain, plain]))
    with pytest.raises(DataError, match="expected one person, got 2"):
        read_smpl_arrays(tmp_path / "a.json", pelvis)
    for wrong in ([["x"]], [[1.0], [1.0, 2.0]], [[None]], [[float("nan")] * 3]):
        (tmp_path / "a.json").write_text(json.dumps(plain | {"transl": wrong}))
        with pytest.raises(DataError, match=r"a\.json: transl"):
            read_smpl_arrays(tmp_path / "a.json", pelvis)


def test_hands_are_kept_for_a_body_of_just_those_joints(walk, tmp_path):
    arrays = smpl_arrays(walk)
    np.savez(tmp_path / "hands.npz", poses=wide(arrays, 156), trans=arrays["trans"])
    assert read_smpl_arrays(tmp_path / "hands.npz", np.zeros(3), 52).poses[0, 22:] == pytest.approx(0.3)
    for joints in (22, 55):
        assert read_smpl_arrays(tmp_path / "hands.npz", np.zeros(3), joints).poses.shape[1] == 22
