"""Body parameters of one scan under all their keys, in npz, pickle and JSON files; others are refused by name."""

import json
import pickle

import numpy as np
import pytest
import torch
from bodies import random_model

from avatar.body.model import SMPL_JOINTS
from avatar.body.smpl import convert_body_model, joint_tree, smpl_body
from avatar.checks import AvatarError, DataError
from avatar.sources.parameters import read_parameters

POSE = np.random.default_rng(0).normal(size=(55, 3)) * 0.3
SHIFT = np.array([0.1, 0.2, 0.3])
PARTS = {
    "global_orient": POSE[:1],
    "body_pose": POSE[1:22],
    "jaw_pose": POSE[22],
    "leye_pose": POSE[23],
    "reye_pose": POSE[24],
    "left_hand_pose": POSE[25:40].reshape(1, -1),
    "right_hand_pose": POSE[40:].reshape(1, 15, 3),
}
AMASS = {"root_orient": POSE[0], "pose_body": POSE[1:22], "pose_jaw": POSE[22], "pose_eye": POSE[23:25]}
AMASS |= {"pose_hand": POSE[25:].ravel()}


def write(path, stored):
    if path.suffix == ".npz":
        np.savez(path, **stored)
    elif path.suffix == ".pkl":
        path.write_bytes(pickle.dumps({**stored, "gender": "male", "model": None}, protocol=2))
    else:
        path.write_text(json.dumps({key: np.asarray(value).tolist() for key, value in stored.items()}))
    return read_parameters(path)


@pytest.mark.parametrize("suffix", [".npz", ".pkl", ".json"])
@pytest.mark.parametrize(
    ("stored", "count"),
    [
        ({"pose": POSE[:24].ravel(), "transl": SHIFT}, 24),
        ({"pose": POSE[:24].ravel(), "trans": SHIFT}, 24),
        ({"poses": POSE[None, :22], "trans": SHIFT[None]}, 22),
        ({"fullpose": POSE, "translation": SHIFT}, 55),
        ({"global_orient": POSE[0], "body_pose": POSE[1:24].ravel(), "transl": SHIFT}, 24),
        ({"body_pose": POSE[:22].ravel(), "transl": SHIFT}, 22),  # SkiRT's
        (PARTS | {"transl": SHIFT}, 55),
        (AMASS | {"trans": SHIFT}, 55),
    ],
)
def test_poses_are_read_under_their_keys(stored, count, suffix, tmp_path):
    found = write(tmp_path / f"fit{suffix}", stored | {"betas": np.ones((1, 10))})
    names = next(names for names, _ in map(joint_tree, ("smpl", "smplx")) if len(names) == max(count, 24))[:count]
    order = [found.names.index(name) for name in names]
    np.testing.assert_allclose(found.pose[order], POSE[:count], atol=1e-12)
    np.testing.assert_allclose(found.translation, SHIFT)
    assert len(found.names) == count and found.betas.tolist() == [1.0] * 10 and found.scale == 1


@pytest.mark.parametrize("scale", [2.0, np.float32(2), np.array(2.0), np.array([2.0], np.float32)])
def test_translation_is_added_behind_the_scale_and_transl_before(scale, tmp_path):
    for key in ("translation", "trans"):
        stored = {"pose": np.zeros(72), "transl": SHIFT, key: np.ones(3), "scale": scale}
        found = write(tmp_path / "fit.pkl", stored)
        np.testing.assert_allclose(found.translation, SHIFT + 0.5)
        assert found.scale == 2


def test_principal_components_of_hands_are_told_apart(tmp_path):
    components = {"left_hand_pose": np.arange(12.0), "right_hand_pose": np.ones((1, 12))}
    found = write(tmp_path / "fit.npz", PARTS | components | {"transl": SHIFT})
    assert len(found.names) == 25 and "left_index1" not in found.names
    joined = {"pose_hand": np.concatenate([np.arange(12.0), np.ones(12)])}
    for one in (found, write(tmp_path / "fit.npz", AMASS | joined)):
        np.testing.assert_array_equal(one.hands[0], np.arange(12))
        np.testing.assert_array_equal(one.hands[1], np.ones(12))


def test_components_of_hands_become_rotations_as_smplx_has_them(tmp_path):
    rng = np.random.default_rng(1)
    model = vars(random_model("smplx"))
    hands = {f"hands_mean{side}": rng.normal(size=45) for side in "lr"}
    hands |= {f"hands_components{side}": rng.normal(size=(45, 45)) for side in "lr"}
    np.savez(tmp_path / "model.npz", **model | hands)
    np.savez(tmp_path / "bare.npz", **model)
    for name in ("model", "bare"):
        convert_body_model(tmp_path / f"{name}.npz", tmp_path / f"{name}_plain.npz")
    values = {"left_hand_pose": rng.normal(size=12), "right_hand_pose": rng.normal(size=12)}
    found = write(tmp_path / "fit.npz", PARTS | values)
    whole = found.with_fingers(tmp_path / "model_plain.npz")
    expected = [
        hands[f"hands_mean{side}"] + values[f"{name}_hand_pose"] @ hands[f"hands_components{side}"][:12]
        for side, name in (("l", "left"), ("r", "right"))
    ]
    assert whole.names[25:] == joint_tree("smplx")[0][25:] and whole.hands is None
    np.testing.assert_allclose(whole.pose[25:].reshape(2, 45), expected, rtol=1e-5)
    with pytest.raises(DataError, match=r"bare_plain\.npz: expected principal components of hands, there are none"):
        found.with_fingers(tmp_path / "bare_plain.npz")


def test_components_of_one_hand_alone_are_refused(tmp_path):
    with pytest.raises(DataError, match="hands: expected as many principal components of both, at most 45, got 12"):
        write(tmp_path / "fit.npz", PARTS | {"left_hand_pose": np.zeros(12)})


def test_rotations_go_to_joints_of_their_names(tmp_path):
    found = write(tmp_path / "fit.npz", {"pose": POSE[:24], "transl": SHIFT})
    for kind in ("smpl", "smplx"):
        np.savez(tmp_path / "model.npz", **vars(random_model(kind)))
        convert_body_model(tmp_path / "model.npz", tmp_path / "plain.npz")
        body = smpl_body(tmp_path / "plain.npz", all_joints=True)
        if kind == "smpl":
            np.testing.assert_allclose(found.pose_of(body), POSE[:24], rtol=1e-6)
            continue
        np.testing.assert_allclose(found.pose_of(body, cut=True)[:22], POSE[:22], rtol=1e-6)
        with pytest.raises(AvatarError, match=r"it turns left_hand, which the body lacks"):
            found.pose_of(body)


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        ({"transl": SHIFT}, "expected pose, or global_orient and body_pose, found transl"),
        ({"pose": np.zeros((2, 72))}, "pose: expected 66 or 72 or 156 or 165 numbers of one frame, got 144"),
        ({"pose": np.full(72, 45.0)}, "expected radians, got turns of 78"),
        ({"pose": np.zeros((24, 3, 3))}, "expected axis-angles, got rotation matrices"),
        ({"body_pose": np.zeros((21, 3)), "global_orient": np.zeros(6)}, "global_orient: expected 3 numbers"),
        ({"pose": np.zeros(72), "transl": np.zeros(6)}, "transl: expected 3 numbers, got 6"),
        ({"pose": np.zeros(72), "scale": np.zeros(1)}, "scale: expected a number above 0"),
        ({"pose": np.full(72, np.nan)}, "pose: expected finite numbers"),
        ({"pose": np.array(["a"] * 72)}, r"pose: expected (an array of )?num"),
    ],
)
@pytest.mark.parametrize("suffix", [".npz", ".pkl", ".json"])
def test_what_is_no_pose_of_one_frame_is_refused(stored, message, suffix, tmp_path):
    with pytest.raises(DataError, match=message) as caught:
        write(tmp_path / f"fit{suffix}", stored)
    assert f"fit{suffix}" in str(caught.value)


def test_a_body_may_have_vertices_of_its_own(tmp_path):
    """A personal mesh with the file's weights: as the shape of the same betas."""
    np.savez(tmp_path / "model.npz", **vars(random_model("smpl")))
    convert_body_model(tmp_path / "model.npz", tmp_path / "plain.npz")
    shaped = smpl_body(tmp_path / "plain.npz", (0.5, -1), all_joints=True)
    own = smpl_body(tmp_path / "plain.npz", all_joints=True, vertices=shaped.bind_vertices.numpy())
    pose = torch.from_numpy(POSE[None, :24]).float()
    torch.testing.assert_close(own(pose).vertices, shaped(pose).vertices)
    torch.testing.assert_close(own(pose).joint_transforms, shaped(pose).joint_transforms)
    with pytest.raises(AvatarError, match=r"vertices: expected shape \(V, 3\) with V=40, got \(39, 3\)"):
        smpl_body(tmp_path / "plain.npz", vertices=np.zeros((39, 3)))
    assert list(own.joint_names[:22]) == SMPL_JOINTS
