"""Bodies of rigged glTF files: those of this project, and those of other programs in other axes and units."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rigs import mixamo_rig, write_rig

from avatar.body.model import SMPL_JOINTS
from avatar.body.open import open_body
from avatar.body.packed import packed_body
from avatar.body.registry import body_of_file
from avatar.body.rigged import rigged_body
from avatar.body.smpl import convert_body_model
from avatar.checks import AvatarError, DataError
from avatar.export.rigged import write_rigged_glb

TURNED = np.diag([-1.0, 1.0, -1.0, 1.0])  # facing -z
DIAGONAL = np.array([[0.8, 0, 0.6, 0], [0, 1, 0, 0], [-0.6, 0, 0.8, 0], [0, 0, 0, 1]])
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def body():
    return open_body("female")


@pytest.fixture(scope="module")
def rig(body):
    return mixamo_rig(body)


def random_poses(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return 0.4 * torch.randn(2, 22, 3, generator=generator), torch.randn(2, 3, generator=generator)


def assert_same_body(one, other, atol=1e-5):
    assert one.joint_names == other.joint_names and one.parents == other.parents
    assert torch.equal(one.faces, other.faces)
    pose, translation = random_poses()
    mine, theirs = one(pose, translation), other(pose, translation)
    torch.testing.assert_close(mine.vertices, theirs.vertices, atol=atol, rtol=0)
    torch.testing.assert_close(mine.vertex_transforms, theirs.vertex_transforms, atol=atol, rtol=0)
    torch.testing.assert_close(mine.joint_transforms, theirs.joint_transforms, atol=atol, rtol=0)


def test_a_body_that_was_exported_comes_back(body, tmp_path):
    write_rigged_glb(tmp_path / "body.glb", body)
    assert_same_body(rigged_body(tmp_path / "body.glb"), body)


@pytest.mark.parametrize("armature", [np.eye(4), TURNED, Z_UP], ids=["as-is", "facing-away", "z-up"])
def test_an_a_pose_becomes_the_t_pose_upright_and_facing_z(body, rig, tmp_path, armature):
    """Joints, finger, texture seams and axes are a Mixamo character's; the body is the open one."""
    found = rigged_body(write_rig(tmp_path / "person.glb", replace(rig, armature=armature)))
    assert found.joint_names == tuple(SMPL_JOINTS)
    assert_same_body(found, body)
    torch.testing.assert_close(found.uv, body.uv, atol=1e-6, rtol=0)
    assert torch.equal(found.uv_faces, body.uv_faces)


def test_units(body, rig, tmp_path, caplog):
    scaled = replace(rig, vertices=100 * rig.vertices, joints=100 * rig.joints)
    shrunk = np.diag([0.01, 0.01, 0.01, 1.0])  # as Mixamo's files have it
    assert_same_body(rigged_body(write_rig(tmp_path / "a.glb", replace(scaled, armature=shrunk))), body)
    assert not caplog.records
    assert_same_body(rigged_body(write_rig(tmp_path / "b.glb", scaled)), body)
    assert "taken for cm" in caplog.text
    child = replace(rig, vertices=40 * rig.vertices, joints=40 * rig.joints)
    with pytest.raises(DataError, match=r"height of 70\.7.* 1\.80 m in in or 0\.71 m in cm"):
        rigged_body(write_rig(tmp_path / "c.glb", child))


def test_reached_by_path_and_converted(body, rig, tmp_path):
    path = write_rig(tmp_path / "person.glb", rig)
    assert_same_body(body_of_file(path, {}), body)
    assert convert_body_model(path, tmp_path / "person.npz") == "rigged"
    assert_same_body(packed_body(tmp_path / "person.npz"), rigged_body(path), atol=1e-6)
    with pytest.raises(AvatarError, match="uv: expected none"):
        convert_body_model(path, tmp_path / "person.npz", tmp_path / "uv.obj")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint_scale": 1.2}, "got some with a scale"),
        ({"skinned": False}, "expected a skinned mesh"),
        ({"names": [f"bone{number}" for number in range(23)]}, "Hint: rename its joints"),
        ({"armature": DIAGONAL}, "is wide along an axis"),
        ({"armature": np.diag([30.0, 30.0, 30.0, 1.0])}, "got a height of 5"),
    ],
    ids=["scaled", "unskinned", "unnamed", "diagonal", "ambiguous"],
)
def test_refused_with_the_reason(rig, tmp_path, change, message):
    with pytest.raises(DataError, match=message) as error:
        rigged_body(write_rig(tmp_path / "person.glb", replace(rig, **change)))
    assert "person.glb" in str(error.value)
