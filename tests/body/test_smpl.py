"""The SMPL family from converted files: against smplx.lbs, with and without hands and face, and bad files."""

import numpy as np
import pytest
import torch
from bodies import RandomModel, random_model, random_pose
from smplx.lbs import lbs

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS
from avatar.body.smpl import convert_body_model, joint_tree, smpl_body
from avatar.checks import AvatarError, DataError

KINDS = {"smpl": 24, "smplh": 52, "smplx": 55}
BETAS = [1.0, -2.0, 0.5]


def converted(folder, kind: str = "smpl", **changes):
    """A converted file of random parameters."""
    model = {**vars(random_model(kind)), **changes}
    np.savez(folder / "model.npz", **{key: value for key, value in model.items() if value is not None})
    convert_body_model(folder / "model.npz", folder / "plain.npz")
    return folder / "plain.npz"


def oracle(model: RandomModel, kind: str, pose: torch.Tensor) -> torch.Tensor:
    """Vertices by smplx's own skinning."""
    tensors = {name: torch.tensor(value) for name, value in vars(model).items() if value.dtype == np.float64}
    return lbs(
        torch.tensor([BETAS], dtype=torch.float64),
        pose.flatten(1),
        tensors["v_template"][None],
        tensors["shapedirs"][..., :3],
        tensors["posedirs"].flatten(0, 1).T,
        tensors["J_regressor"],
        torch.tensor(joint_tree(kind)[1]),
        tensors["weights"],
    )[0]


@pytest.mark.parametrize("kind", KINDS)
def test_all_joints_agree_with_smplx(kind, tmp_path):
    body = smpl_body(converted(tmp_path, kind), BETAS, all_joints=True, kind=kind)
    pose = random_pose(1, KINDS[kind], spread=0.3)
    assert len(body.joint_names) == KINDS[kind] and body.joint_names[:22] == tuple(SMPL_JOINTS)
    expected = oracle(random_model(kind), kind, pose).float()
    torch.testing.assert_close(body(pose.float()).vertices, expected, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_body_joints_alone_are_the_model_with_still_hands_and_face(kind, tmp_path):
    body = smpl_body(converted(tmp_path, kind), BETAS)
    assert (list(body.joint_names), body.parents) == (SMPL_JOINTS, SMPL_PARENTS)
    pose = random_pose(2, KINDS[kind], spread=0.3)
    pose[:, 22:] = 0
    expected = torch.cat([oracle(random_model(kind), kind, one[None]) for one in pose]).float()
    torch.testing.assert_close(body(pose[:, :22].float()).vertices, expected, atol=2e-5, rtol=1e-4)


def test_joint_trees_hang_fingers_on_wrists_and_the_face_on_the_head():
    for kind, count in KINDS.items():
        names, parents = joint_tree(kind)
        assert len(names) == len(parents) == len(set(names)) == count
    names, parents = joint_tree("smplx")
    above = {name: names[parent] for name, parent in zip(names[1:], parents[1:])}
    assert above["jaw"] == above["left_eye"] == above["right_eye"] == "head"
    assert above["left_thumb1"] == above["left_index1"] == "left_wrist"
    assert above["right_pinky3"] == "right_pinky2" and above["right_middle1"] == "right_wrist"
    assert (names.index("left_index1"), names.index("right_index1"), names[-1]) == (25, 40, "right_thumb3")


def test_betas_change_the_shape_linearly_and_posedirs_may_be_missing(tmp_path):
    path = converted(tmp_path, posedirs=None)
    mean, once, twice = (smpl_body(path, betas).template for betas in ((), (0, 1.0), (0, 2.0)))
    torch.testing.assert_close(
        twice.vertices - mean.vertices, 2 * (once.vertices - mean.vertices), atol=1e-6, rtol=1e-4
    )
    assert (once.vertices - mean.vertices).abs().max() > 0.1
    assert not torch.allclose(once.joints, mean.joints)


def test_bad_requests_are_refused(tmp_path):
    path = converted(tmp_path)
    with pytest.raises(AvatarError, match="betas: expected at most 10"):
        smpl_body(path, [0.0] * 11)
    with pytest.raises(DataError, match=r"expected a smplx body model, got smpl\. Download the smplx model"):
        smpl_body(path, kind="smplx")
    with pytest.raises(AvatarError, match="canonical_pose"):
        smpl_body(path, canonical_pose=torch.zeros(24, 3))
    with pytest.raises(DataError, match="no such file"):
        smpl_body(tmp_path / "none.npz")


def test_an_unconverted_or_truncated_file_says_how_to_convert(tmp_path):
    path = converted(tmp_path)
    with pytest.raises(DataError, match=r"convert_body\.py"):
        smpl_body(tmp_path / "model.npz", kind="smpl")
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(DataError, match=r"plain\.npz.*convert_body\.py"):
        smpl_body(path, kind="smpl")
