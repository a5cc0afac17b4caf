"""Packed outfits whose parts contradict each other: refused with what was measured and the likely cause."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from smpl_person import frame_arrays

from avatar.body.model import SMPL_JOINTS
from avatar.body.open import open_body
from avatar.body.packed import write_body
from avatar.checks import DataError
from avatar.data.layouts import find_outfit
from avatar.data.packed_layout import PackedOutfit
from avatar.data.validation import check_joints


@pytest.fixture(scope="module")
def folder(person_folder, tmp_path_factory):
    """A copy of the person's outfit that a test may spoil."""
    return shutil.copytree(person_folder, tmp_path_factory.mktemp("mine") / "coat")


def load(folder, arrays):
    np.savez(folder / "train" / "rise.00001.npz", **arrays)
    return PackedOutfit(folder).load("train", "rise.00001").body


def turn_root(pose):
    return np.concatenate([0 * pose[:1], pose[1:]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pose": lambda a: 0 * a}, r"pose: expected it to put the template on .* 0\.\d{3} m or more away.*zeros"),
        ({"pose": lambda a: -a}, r"pose: .*Vertices of \w+ are off most.*negated"),
        ({"pose": turn_root}, r"Turning the whole body by 23 degrees"),
        ({"translation": lambda a: 0 * a}, r"pose: .*A move of \(0\.30, 0\.10, 0\.70\) m"),
        (
            {"vtransf": lambda a: np.swapaxes(a, 1, 2)},
            r"vtransf: .*errs by \d\d+% of .* Transposed it does",
        ),
        ({"vtransf": np.linalg.inv}, "Transposed it does: store posed_from_rest, not its inverse"),
        ({"vtransf": lambda a: np.tile(np.eye(4, dtype=np.float32), (len(a), 1, 1))}, "It is the identity"),
        ({"vtransf": lambda a: a[::-1].copy()}, "the template's order of vertices"),
        ({"vtransf": lambda a: a @ turned(0.9)}, r"vtransf: .*Is it this frame's"),
        ({"vtransf": lambda a: turned(0.9) @ a}, r"vtransf: .*Turned by 52 degrees as a whole it does"),
    ],
)
def test_frames_that_contradict_their_bodies_are_refused(folder, person, change, message):
    arrays = frame_arrays(person, 0.5)
    for key, how in change.items():
        arrays[key] = how(arrays[key])
    with pytest.raises(DataError, match=message) as caught:
        load(folder, arrays)
    assert "rise.00001.npz" in str(caught.value)


def turned(radians):
    """A turn about a slanted axis, ``(4, 4)``."""
    whole = np.eye(4, dtype=np.float32)
    whole[:3, :3] = Rotation.from_rotvec(radians * np.array([0.6, 0.0, 0.8])).as_matrix()
    return whole


def test_joint_transforms_of_another_frame_are_refused(folder, person):
    right = load(folder, frame_arrays(person, 0.5)).joint_transforms
    wrong = load(folder, frame_arrays(person, 0.0)).joint_transforms
    arrays = {key: value for key, value in frame_arrays(person, 0.5).items() if key not in ("pose", "translation")}
    np.testing.assert_array_equal(load(folder, arrays | {"joint_transforms": right}).joint_transforms, right)
    with pytest.raises(DataError, match="joint_transforms: expected it to put the template on the frame's body"):
        load(folder, arrays | {"joint_transforms": wrong})


@pytest.mark.parametrize(
    "kept", [{"vtransf"}, {"pose", "translation"}, {"pose", "body_verts"}, {"vtransf", "body_verts"}]
)
def test_sound_frames_pass_with_any_of_their_keys(folder, person, kept):
    """Poses without a translation take it from the vertices; POP's translations leave out the place in the world."""
    arrays = frame_arrays(person, 0.5)
    known = load(folder, arrays)
    if "body_verts" not in kept:
        arrays["vtransf"][:, :3, 3] += arrays["translation"]
    body = load(folder, {key: value for key, value in arrays.items() if key in kept | {"scan_pc", "scan_n"}})
    exact = "pose" in kept
    found, right = body.joint_transforms, known.joint_transforms
    np.testing.assert_allclose(found[:, :3, :3], right[:, :3, :3], atol=1e-5 if exact else 2e-4)
    np.testing.assert_allclose(found[:, :3, 3], right[:, :3, 3], atol=1e-5 if exact else 0.01)  # blendshapes
    if kept != {"vtransf"}:
        np.testing.assert_allclose(body.vertices, known.vertices, atol=1e-5)
    if exact:
        np.testing.assert_allclose(body.translation, known.translation, atol=1e-5)


def test_frames_of_the_sample_pass(tmp_path):
    sample = find_outfit(tmp_path, "sample", "dress")
    write_body(tmp_path / "template.npz", sample.body)
    for split in ("train", "test"):
        for name in sample.frames(split)[:1]:
            frame = sample.load(split, name)
            body, scan = frame.body, frame.scan
            keys = {"body_verts": body.vertices, "vtransf": body.vertex_transforms, "pose": body.pose}
            keys |= {"joint_transforms": body.joint_transforms, "translation": body.translation}
            (tmp_path / split).mkdir(exist_ok=True)
            np.savez(tmp_path / split / f"{name}.npz", scan_pc=scan.points, scan_n=scan.normals, **keys)
            PackedOutfit(tmp_path).load(split, name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: replace(t, joints=t.joints * 100), r"joints: .* lies \d+\.\d\d m from there.*centimetres: divide"),
        (lambda t: replace(t, joints=t.joints * 1000), "millimetres"),
        (
            lambda t: replace(t, joints=t.joints + t.joints.new_tensor([0, 0.3, 0])),
            r"Moving all joints by \(.*-0\.\d\d,",
        ),
        (lambda t: replace(t, joints=one_moved(t.joints)), "left_elbow lies 0.[23]"),
        (lambda t: replace(t, weights=t.weights[:, other_side(t.joint_names)]), "left and right look swapped"),
        (lambda t: replace(t, weights=t.weights.roll(1, dims=1)), "in the order of the weights' columns"),
    ],
)
def test_joints_away_from_their_weights_are_refused(change, message, tmp_path):
    template = open_body("female").template
    check_joints(template, tmp_path)
    with pytest.raises(DataError, match=message):
        check_joints(change(template), tmp_path)


def one_moved(joints):
    """Joints of which one lies 30 cm off, across its bone."""
    moved = joints.clone()
    moved[SMPL_JOINTS.index("left_elbow"), 1] += 0.3
    return moved


def other_side(names):
    """The index of each joint's partner on the other side."""
    swapped = [n.replace("left", "*").replace("right", "left").replace("*", "right") for n in names]
    return [names.index(name) for name in swapped]
