"""The rigged body: skinned in numpy from the file's own data, it must be what `BodyModel` computes."""

import numpy as np
import pytest
import torch
from glb import Glb

from avatar.body.model import BodyModel
from avatar.body.open import open_body
from avatar.checks import AvatarError, DataError
from avatar.export.rigged import write_rigged_glb
from avatar.records import Motion, Template


def motion(frames=5, joints=22, seed=0, turns=0.5):
    generator = np.random.default_rng(seed)
    poses = generator.normal(scale=turns, size=(frames, joints, 3)).astype(np.float32)
    return Motion(poses, generator.normal(size=(frames, 3)).astype(np.float32), 30.0, "waving")


@pytest.fixture(scope="module")
def body():
    return open_body("female")


def test_the_file_s_own_skinning_is_the_body_s(tmp_path, body):
    moving = motion()
    write_rigged_glb(tmp_path / "body.glb", body, moving)
    glb = Glb(tmp_path / "body.glb")
    posed = body(torch.from_numpy(moving.poses), torch.from_numpy(moving.translations))
    for frame in range(len(moving.poses)):
        np.testing.assert_allclose(glb.skinned(frame), posed.vertices[frame].numpy(), atol=2e-6)
    times = glb.array(glb.file.animations[0].samplers[0].input)[:, 0]
    np.testing.assert_allclose(times, np.arange(5) / 30, atol=1e-7)
    assert glb.file.animations[0].name == "waving"


def test_at_rest_it_stands_in_the_t_pose_whatever_the_canonical_pose(tmp_path, body):
    legs_apart = torch.zeros(22, 3)
    legs_apart[1, 2], legs_apart[2, 2] = 0.3, -0.3
    zero = body(torch.zeros(1, 22, 3))
    for name, model in (("a", body), ("b", open_body("female", legs_apart))):
        write_rigged_glb(tmp_path / f"{name}.glb", model)
        glb = Glb(tmp_path / f"{name}.glb")
        np.testing.assert_allclose(glb.skinned(None), zero.vertices[0].numpy(), atol=2e-6)
        assert not glb.file.animations
        np.testing.assert_allclose(glb.world(None)[1:, :3, 3], body.zero_joints.numpy(), atol=1e-6)


def test_the_file_keeps_the_rules_of_gltf(tmp_path, body):
    write_rigged_glb(tmp_path / "body.glb", body, motion(turns=2.0))
    glb = Glb(tmp_path / "body.glb")
    primitive = glb.file.meshes[0].primitives[0]
    positions, faces = glb.array(primitive.attributes.POSITION), glb.array(primitive.indices)
    accessor = glb.file.accessors[primitive.attributes.POSITION]
    np.testing.assert_allclose(accessor.min, positions.min(axis=0))
    np.testing.assert_allclose(accessor.max, positions.max(axis=0))
    np.testing.assert_array_equal(faces.reshape(-1, 3), body.faces.numpy())
    np.testing.assert_allclose(np.linalg.norm(glb.array(primitive.attributes.NORMAL), axis=1), 1, atol=1e-5)
    weights, chosen = glb.influences(primitive.attributes)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert not chosen[weights == 0].any()  # the specification asks for joint 0 where nothing weighs
    names = [node.name for node in glb.file.nodes[1:]]
    assert names == list(body.joint_names)
    parents = {child: index for index, node in enumerate(glb.file.nodes) for child in node.children or []}
    assert [parents.get(joint + 1, 0) - 1 for joint in range(22)] == list(body.parents)
    for channel in glb.file.animations[0].channels:
        values = glb.array(glb.file.animations[0].samplers[channel.sampler].output)
        if channel.target.path == "rotation":
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1, atol=1e-6)
            assert (np.einsum("tc,tc->t", values[1:], values[:-1]) >= 0).all()  # the short way between


def test_equal_bodies_give_equal_bytes(tmp_path, body):
    for name in "ab":
        write_rigged_glb(tmp_path / f"{name}.glb", body, motion())
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_fewer_joints_than_influences(tmp_path):
    template = Template(
        torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]]),
        torch.tensor([[1.0, 0], [0.5, 0.5], [0, 1]]), torch.tensor([[0.0, 0, 0], [0, 1, 0]]), (-1, 0), ("a", "b"),
    )  # fmt: skip
    model, moving = BodyModel(template), motion(2, 2)
    write_rigged_glb(tmp_path / "a.glb", model, moving)
    posed = model(torch.from_numpy(moving.poses), torch.from_numpy(moving.translations))
    np.testing.assert_allclose(Glb(tmp_path / "a.glb").skinned(1), posed.vertices[1].numpy(), atol=1e-6)


def test_motions_that_do_not_fit_are_refused(tmp_path, body):
    good = motion()
    nan = good.poses.copy()
    nan[1, 2, 0] = np.nan
    for bad in (
        motion(joints=24),
        Motion(nan, good.translations, 30, "a"),
        Motion(good.poses, good.translations[:2], 30, "a"),
        Motion(good.poses, good.translations, 0, "a"),
        Motion(good.poses[:0], good.translations[:0], 30, "a"),
    ):
        with pytest.raises(AvatarError):
            write_rigged_glb(tmp_path / "a.glb", body, bad)
    with pytest.raises(DataError, match=r"\.glb"):
        write_rigged_glb(tmp_path / "a.fbx", body)
    assert not list(tmp_path.iterdir())
