"""Motion files: AMASS, our own, BVH; conventions, resampling and broken files."""

import logging
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from motion_files import MIXAMO, assert_same_poses, travelling_walk, write_bvh
from scipy.spatial.transform import Rotation, Slerp

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS, BodyModel
from avatar.body.open import open_body
from avatar.checks import AvatarError, DataError, check_name
from avatar.cli import make_motion
from avatar.io.motions import move_body, read_body_motion, read_motion, resample_motion, write_motion
from avatar.io.npz import write_arrays
from avatar.records import Motion, Template
from avatar.simulate.angles import authored_motion


@pytest.fixture(scope="module")
def walk():
    return travelling_walk(1.5, 0.8)


@pytest.mark.parametrize("name", ["../../up", "/etc/up", "a b", "..", "", "\0", "x" * 200])
def test_a_motion_s_name_can_only_be_a_file_s(tmp_path, walk, name):
    write_motion(tmp_path / "a.npz", replace(walk, name=name))
    found = read_motion(tmp_path / "a.npz").name
    assert check_name("name", found) == found and (tmp_path / found).parent == tmp_path


def test_our_own_file_round_trips(tmp_path, walk):
    write_motion(tmp_path / "walk.npz", walk)
    read = read_motion(tmp_path / "walk.npz")
    np.testing.assert_array_equal(read.poses, walk.poses)
    np.testing.assert_array_equal(read.translations, walk.translations)
    assert (read.fps, read.name, read.source) == (30.0, "walk", tmp_path / "walk.npz")


@pytest.mark.parametrize("kind", ["smplh", "smplx", "smpl"])
def test_amass_files_stand_up_and_objects_in_them_are_not_touched(tmp_path, walk, kind):
    """A y-up motion is laid down as AMASS stores it; reading must give it back."""
    z_from_y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    poses = walk.poses.astype(np.float64).copy()
    poses[:, 0] = Rotation.from_matrix(z_from_y @ Rotation.from_rotvec(poses[:, 0]).as_matrix()).as_rotvec()
    flat = poses.reshape(len(poses), 66)
    trans = walk.translations @ z_from_y.T
    if kind == "smplx":
        arrays = {"root_orient": flat[:, :3], "pose_body": flat[:, 3:], "mocap_frame_rate": np.array(30.0)}
    else:
        width = {"smplh": 90, "smpl": 6}[kind]
        full = np.concatenate([flat, np.full((len(flat), width), 0.3)], axis=1)
        arrays = {"poses": full, "mocap_framerate": np.array(30)}
    labels = np.array([{"marker": 1}], dtype=object)
    np.savez(tmp_path / "amass.npz", trans=trans, gender=np.array("female"), labels=labels, **arrays)
    read = read_motion(tmp_path / "amass.npz")
    assert_same_poses(read.poses, walk.poses)
    np.testing.assert_allclose(read.translations, walk.translations, atol=1e-6)
    assert read.fps == 30.0
    lying = read_motion(tmp_path / "amass.npz", up="y")
    np.testing.assert_allclose(lying.translations, trans, atol=1e-6)


@pytest.mark.parametrize(("order", "scale"), [("ZXY", 100.0), ("XYZ", 1.0), ("YZX", 39.37)])
def test_bvh_in_any_order_and_unit_gives_the_motion_back(tmp_path, walk, order, scale, caplog):
    path = write_bvh(tmp_path / "walk.bvh", walk, order=order, scale=scale)
    with caplog.at_level(logging.INFO):
        read = read_motion(path)
    assert_same_poses(read.poses, walk.poses)
    np.testing.assert_allclose(read.translations, walk.translations, atol=1e-5)
    assert read.fps == pytest.approx(30, abs=1e-4)
    assert "22 joints of 22 mapped" in caplog.text


def test_an_a_pose_at_rest_is_taken_off(tmp_path, walk):
    """Joint frames turned with the arms of an A-pose: the same motion must come out."""
    frames = np.tile(np.eye(3), (22, 1, 1))
    for side, sign in (("left", -1), ("right", 1)):
        for joint in ("shoulder", "elbow", "wrist"):
            frames[SMPL_JOINTS.index(f"{side}_{joint}")] = Rotation.from_rotvec([0, 0, -sign * 0.8]).as_matrix()
    read = read_motion(write_bvh(tmp_path / "walk.bvh", walk, frames=frames))
    assert_same_poses(read.poses, walk.poses)


def test_a_skeleton_with_frames_of_its_own_is_calibrated_from_where_its_joints_are(tmp_path):
    """LAFAN files have no T-pose at zero; directions must come out right, twist on average."""
    motion = authored_motion("dance", fps=30, seconds=6)
    frames = Rotation.random(22, rng=np.random.default_rng(0)).as_matrix()
    read = read_motion(write_bvh(tmp_path / "dance.bvh", motion, frames=frames, prefix=""))
    body = open_body("mean")
    place = [np.asarray(body_joints(m.poses, body)) for m in (read, motion)]
    assert np.linalg.norm(place[0] - place[1], axis=-1).mean() < 0.06
    assert np.linalg.norm(place[0] - place[1], axis=-1).max() < 0.25


def body_joints(poses, body):
    """Posed joint positions ``(T, 22, 3)``."""
    rest = body.template.joints.numpy()
    turned, places = [], []
    for joint, parent in enumerate(SMPL_PARENTS):
        own = Rotation.from_rotvec(poses[:, joint])
        turned.append(own if parent < 0 else turned[parent] * own)
        here = np.tile(rest[joint], (len(poses), 1))
        places.append(here if parent < 0 else places[parent] + turned[parent].apply(rest[joint] - rest[parent]))
    return np.stack(places, axis=1)


def test_other_proportions_change_no_rotation(tmp_path, walk):
    """CMU hips sit low and forward of the pelvis, collars and neck at the spine, legs are spread."""
    rest = open_body("mean").template.joints.double().numpy()
    rest = rest.copy()
    legs = [SMPL_JOINTS.index(f"left_{j}") for j in ("hip", "knee", "ankle", "foot")]
    legs += [SMPL_JOINTS.index(f"right_{j}") for j in ("hip", "knee", "ankle", "foot")]
    rest[legs] += [0, -0.08, 0.05]
    for joint in ("neck", "left_collar", "right_collar"):
        rest[SMPL_JOINTS.index(joint)] = rest[SMPL_JOINTS.index("spine3")]
    assert_same_poses(read_motion(write_bvh(tmp_path / "a.bvh", walk, rest=rest)).poses, walk.poses)


def test_skeletons_that_face_elsewhere_are_turned(tmp_path, walk):
    """A rest pose looking along x: the same person in the world, so the same motion."""
    turned = Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix()
    frames = np.tile(turned.T, (22, 1, 1))
    assert_same_poses(read_motion(write_bvh(tmp_path / "a.bvh", walk, frames=frames)).poses, walk.poses)


def test_z_up_bvh_is_refused_until_named_and_then_stands(tmp_path, walk):
    basis = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    path = write_bvh(tmp_path / "walk.bvh", walk, basis=basis)
    with pytest.raises(DataError, match=r"upright along z.*Give up=z"):
        read_motion(path)
    read = read_motion(path, up="z")
    assert_same_poses(read.poses, walk.poses)
    np.testing.assert_allclose(read.translations, walk.translations, atol=1e-5)


def test_common_skeletons_are_mapped(tmp_path, walk):
    cmu = {**MIXAMO, "spine1": "LowerBack", "spine2": "Spine", "spine3": "Spine1"}
    lafan = {**MIXAMO, "left_foot": "LeftToe", "right_foot": "RightToe"}
    for names in (cmu, lafan):
        read = read_motion(write_bvh(tmp_path / "a.bvh", walk, names=names, prefix=""))
        assert_same_poses(read.poses, walk.poses)
    names = {**MIXAMO, "left_elbow": "Tentacle"}
    with pytest.raises(DataError, match=r"a\.bvh: joints: expected the names of a SMPL, Mixamo.*none for left_elbow"):
        read_motion(write_bvh(tmp_path / "a.bvh", walk, names=names))


def test_resampling_agrees_with_scipy_and_keeps_the_ends(walk):
    read = resample_motion(walk, 72.5)
    times = np.arange(len(read.poses)) / 72.5
    assert times[-1] <= (len(walk.poses) - 1) / 30 < times[-1] + 1 / 72.5
    for joint in (0, 4, 16):
        known = Slerp(np.arange(len(walk.poses)) / 30, Rotation.from_rotvec(walk.poses[:, joint]))(times)
        assert np.degrees((known.inv() * Rotation.from_rotvec(read.poses[:, joint])).magnitude()).max() < 1e-3
    known = np.interp(times, np.arange(len(walk.poses)) / 30, walk.translations[:, 2])
    np.testing.assert_allclose(read.translations[:, 2], known, atol=1e-6)
    again = resample_motion(walk, 30)
    np.testing.assert_allclose(again.poses, walk.poses, atol=1e-6)
    single = resample_motion(Motion(walk.poses[:1], walk.translations[:1], 30.0, "one"), 60)
    np.testing.assert_allclose(single.poses, walk.poses[:1], atol=1e-6)


def test_slerp_takes_the_short_way_across_half_a_turn():
    poses = np.zeros((2, 22, 3), np.float32)
    poses[:, 0, 1] = np.radians([170, -170])
    middle = resample_motion(Motion(poses, np.zeros((2, 3), np.float32), 1.0, "turn"), 2).poses[1, 0]
    assert abs(np.degrees(middle[1])) == pytest.approx(180, abs=0.01)


def smplh(**changes):
    arrays = {"poses": np.zeros((4, 156)), "trans": np.zeros((4, 3)), "mocap_framerate": np.array(60.0)}
    return {key: value for key, value in {**arrays, **changes}.items() if value is not None}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (smplh(poses=np.zeros((4, 22, 3, 3))), r"poses: expected shape \(T, P\)"),
        (smplh(poses=np.zeros((4, 63))), "expected poses .T, 66 or more"),
        (smplh(poses=np.zeros((3, 156))), r"poses: expected shape \(T, P\) with T=4"),
        (smplh(poses=np.full((4, 156), 90.0)), "expected radians"),
        (smplh(poses=np.full((4, 156), np.nan)), "poses: expected finite"),
        (smplh(poses=None), "got neither"),
        (smplh(trans=None), "expected the keys trans"),
        (smplh(mocap_framerate=None), "expected mocap_framerate"),
        (smplh(mocap_framerate=np.array(0.0)), "1 to 1000 frames per second"),
        (smplh(poses=np.zeros((0, 156)), trans=np.zeros((0, 3))), "at least one frame"),
        ({"format": np.array("motion/9")}, "expected the keys"),
    ],
)
def test_unsound_npz_files_are_one_error(tmp_path, arrays, message):
    write_arrays(tmp_path / "a.npz", arrays)
    with pytest.raises(DataError, match=message) as caught:
        read_motion(tmp_path / "a.npz")
    assert "a.npz" in str(caught.value)


def test_damaged_bvh_files_are_one_error(tmp_path, walk):
    text = write_bvh(tmp_path / "walk.bvh", walk).read_text()
    rng = np.random.default_rng(0)
    broken = [text[: rng.integers(len(text))] for _ in range(40)]
    broken += [text.replace("Frames: 45", "Frames: 46"), text.replace("OFFSET", "OFSET", 1), "", "\0\1", "HIERARCHY"]
    broken += [text.replace("Xrotation", "Wrotation", 1), text.replace("Frame Time: 0.0", "Frame Time: nan ")]
    broken += [text.replace("OFFSET", f"OFFSET {wild}", 1) for wild in ("nan", "inf", "1e300")]
    broken += [text.replace("CHANNELS 3", "CHANNELS 99999999", 1), text.replace("}", "", 1)]
    for number, content in enumerate(broken):
        (tmp_path / "b.bvh").write_text(content)
        with pytest.raises(DataError):
            read_motion(tmp_path / "b.bvh")
            pytest.fail(f"accepted damage {number}")
    (tmp_path / "b.bvh").write_bytes(b"HIERARCHY \xff\xfe")
    with pytest.raises(DataError, match="not text"):
        read_motion(tmp_path / "b.bvh")


def test_bad_requests_are_refused(tmp_path, walk):
    write_motion(tmp_path / "walk.npz", walk)
    for call, message in (
        (lambda: read_motion(tmp_path / "none.npz"), "there is none"),
        (lambda: read_motion(tmp_path / "none.bvh"), "there is no such file"),
        (lambda: read_motion(tmp_path / "walk.fbx"), "ending in .npz or .bvh"),
        (lambda: read_motion(tmp_path / "walk.npz", up="x"), "up: expected one of y, z, -y"),
        (lambda: read_motion(tmp_path / "walk.npz", fps=0), "fps: expected 1 to 1000"),
        (
            lambda: write_motion(tmp_path / "a.npz", Motion(walk.poses, walk.translations[:3], 30.0, "x")),
            "translations",
        ),
    ):
        with pytest.raises(AvatarError, match=message):
            call()


def other_body(names, order):
    """The open body with its joints called and ordered otherwise; parents come first still."""
    bind = open_body("female")
    parents = [-1 if SMPL_PARENTS[j] < 0 else order.index(SMPL_PARENTS[j]) for j in order]
    template = replace(
        bind.template,
        vertices=bind.bind_vertices,
        weights=bind.weights[:, order],
        joints=bind.bind_joints[order],
        parents=tuple(parents),
        joint_names=tuple(names[SMPL_JOINTS[j]] for j in order),
        canonical_from_bind=None,
    )
    return BodyModel(template, bind.zero_from_bind[order])


@pytest.mark.parametrize("names", [{j: f"mixamorig:{MIXAMO[j]}" for j in SMPL_JOINTS}, {j: j for j in SMPL_JOINTS}])
def test_bodies_with_joints_of_other_names_and_order_move_alike(tmp_path, walk, names):
    depth_first = [0, 1, 4, 7, 10, 2, 5, 8, 11, 3, 6, 9, 12, 15, 13, 16, 18, 20, 14, 17, 19, 21]
    body, motion = other_body(names, depth_first), replace(walk, poses=walk.poses[::15])
    write_motion(tmp_path / "a.npz", replace(motion, translations=walk.translations[::15]))
    read = read_body_motion(tmp_path / "a.npz", body)
    moved = body(torch.from_numpy(read.poses), torch.from_numpy(read.translations)).vertices
    expected = open_body("female")(torch.from_numpy(motion.poses), torch.from_numpy(read.translations)).vertices
    torch.testing.assert_close(moved, expected, atol=1e-4, rtol=0)
    strange = other_body({joint: f"bone{i}" for i, joint in enumerate(SMPL_JOINTS)}, depth_first)
    with pytest.raises(AvatarError, match="found none for left_hip"):
        read_body_motion(tmp_path / "a.npz", strange)


def test_joints_a_body_has_beyond_ours_stay_at_rest(walk):
    """Its collar is missing as well: the shoulder takes the collar's turn with its own."""
    kept = [joint for joint in range(22) if SMPL_JOINTS[joint] != "left_collar"]
    parents = [-1, *(kept.index(p if p in kept else SMPL_PARENTS[p]) for p in (SMPL_PARENTS[j] for j in kept[1:]))]
    names = [SMPL_JOINTS[joint] for joint in kept]
    places = open_body("female").template.joints[kept]
    joints = torch.cat([places, places[-1:] + 0.1])
    weights = torch.nn.functional.one_hot(torch.arange(22), 22).float()
    bind = Template(joints, torch.tensor([[0, 1, 2]]), weights, joints, (*parents, 20), (*names, "right_thumb"))
    moved = move_body(walk, BodyModel(bind))
    assert moved.poses.shape == (len(walk.poses), 22, 3) and not moved.poses[:, 21].any()
    collar, shoulder = (walk.poses[:, SMPL_JOINTS.index(f"left_{joint}")] for joint in ("collar", "shoulder"))
    both = Rotation.from_rotvec(collar) * Rotation.from_rotvec(shoulder)
    assert_same_poses(both.as_rotvec(), moved.poses[:, names.index("left_shoulder")])


def test_bvh_on_smpl_s_own_names_takes_ankles_for_ankles(tmp_path, walk):
    """``left_foot`` and ``left_shoulder`` are other joints to Mixamo."""
    names = {joint: joint for joint in SMPL_JOINTS}
    read = read_motion(write_bvh(tmp_path / "a.bvh", walk, names=names, prefix=""))
    assert_same_poses(read.poses, walk.poses)


def test_bvh_is_fitted_to_the_body_that_moves(tmp_path, walk):
    """Another size and another origin: its pelvis goes where the skeleton's goes, in proportion to the legs."""
    rest = open_body("mean").template.joints.double().numpy()
    path = write_bvh(tmp_path / "a.bvh", walk)
    read = read_motion(path, rest=1.5 * rest + [0, 0.4, 0])
    pelvis = 1.5 * (walk.translations + rest[0])
    np.testing.assert_allclose(read.translations + 1.5 * rest[0] + [0, 0.4, 0], pelvis, atol=1e-5)


def test_the_open_motions_come_from_a_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["make_motion", "squat", str(tmp_path / "squat.npz"), "--seconds", "0.5"])
    make_motion()
    assert "15 frames" in capsys.readouterr().out
    np.testing.assert_array_equal(read_motion(tmp_path / "squat.npz").poses, authored_motion("squat", 30, 0.5).poses)
    monkeypatch.setattr(sys, "argv", ["make_motion", "fly", str(tmp_path / "fly.npz")])
    with pytest.raises(AvatarError, match="expected one of walk"):
        make_motion()
