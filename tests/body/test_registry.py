"""Bodies and canonical poses by name, and the errors that lead to a good configuration."""

import math

import pytest
import torch
from bodies import random_pose

from avatar.body.model import SMPL_JOINTS
from avatar.body.open import open_body
from avatar.body.packed import write_body
from avatar.body.registry import BodyConfig, canonical_pose, load_body
from avatar.checks import AvatarError, DataError


def test_open_body_by_name():
    body, expected = load_body(BodyConfig(shape="male")), open_body("male")
    pose = random_pose(1, 22).float()
    assert torch.equal(body(pose).vertices, expected(pose).vertices)


def test_packed_body_by_name(tmp_path):
    write_body(tmp_path / "template.npz", open_body())
    body = load_body(BodyConfig(name="packed", path=str(tmp_path / "template.npz"), canonical="apart"))
    expected = load_body(BodyConfig(canonical="apart")).template.vertices
    torch.testing.assert_close(body.template.vertices, expected, atol=1e-5, rtol=0)


def test_legs_apart_turns_each_hip_outwards():
    straight, apart = load_body(BodyConfig()), load_body(BodyConfig(canonical="apart"))
    for side, sign in (("left", 1), ("right", -1)):
        hip, knee = (SMPL_JOINTS.index(f"{side}_{name}") for name in ("hip", "knee"))
        thighs = [body.template.joints[knee] - body.template.joints[hip] for body in (straight, apart)]
        angles = [math.degrees(math.atan2(sign * float(t[0]), -float(t[1]))) for t in thighs]
        assert angles[1] - angles[0] == pytest.approx(25, abs=0.01)
    upper = straight.template.vertices[:, 1] > 1.2
    torch.testing.assert_close(apart.template.vertices[upper], straight.template.vertices[upper], atol=1e-5, rtol=0)


def test_canonical_pose_changes_no_posed_body():
    pose = random_pose(2, 22).float()
    straight, apart = load_body(BodyConfig()), load_body(BodyConfig(canonical="apart"))
    torch.testing.assert_close(apart(pose).vertices, straight(pose).vertices, atol=1e-5, rtol=0)


def test_canonical_pose_by_name_for_any_joints():
    assert canonical_pose("t", ["a", "b"]).abs().max() == 0
    pose = canonical_pose("apart", ["root", "right_hip", "left_hip"])
    torch.testing.assert_close(pose[:, 2], torch.tensor([0, -math.radians(25), math.radians(25)]))
    with pytest.raises(AvatarError, match="expected a joint left_hip"):
        canonical_pose("apart", ["root"])
    with pytest.raises(AvatarError, match="expected one of t, apart, got 'A'"):
        canonical_pose("A", SMPL_JOINTS)


def test_unknown_names_list_the_known():
    with pytest.raises(AvatarError, match="expected one of open, anny, smpl, smplh, smplx, packed, rigged, got 'smlp'"):
        BodyConfig(name="smlp")
    with pytest.raises(AvatarError, match="expected one of t, apart, got 'a'"):
        BodyConfig(canonical="a")


@pytest.mark.parametrize(
    ("name", "page"),
    [("smpl", "smpl.is.tue.mpg.de"), ("smplh", "mano.is.tue.mpg.de"), ("smplx", "smpl-x.is.tue.mpg.de")],
)
def test_missing_model_file_says_where_to_get_it_and_how_to_convert_it(name, page, tmp_path):
    with pytest.raises(AvatarError, match=page):
        BodyConfig(name=name)
    path = tmp_path / "model.npz"
    with pytest.raises(DataError, match=page) as caught:
        load_body(BodyConfig(name=name, path=str(path)))
    assert f"tools/convert_body.py <downloaded file> {path}" in str(caught.value)


def test_packed_without_a_path_is_refused():
    with pytest.raises(AvatarError, match=r"template\.npz"):
        BodyConfig(name="packed")
