"""Bodies from template files: round trips, sparse weights, estimated joints, bad files."""

import numpy as np
import pytest
import torch
from bodies import random_bind, random_body, random_pose

from avatar.body.model import BodyModel
from avatar.body.open import open_body
from avatar.body.packed import (
    dense_weights,
    joint_positions,
    packed_body,
    read_template,
    sparse_weights,
    write_body,
    write_template,
)
from avatar.checks import AvatarError, DataError


def write(path, **changes):
    """A good template.npz with changes; None leaves a key out."""
    bind = random_bind()
    arrays = {
        "vertices": bind.vertices.numpy(),
        "faces": bind.faces.numpy(),
        "weights": bind.weights.numpy(),
        "parents": np.array(bind.parents),
        "joint_names": np.array(bind.joint_names),
        "joints": bind.joints.numpy(),
        **changes,
    }
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


def test_round_trip_poses_the_open_body_as_it_was(tmp_path):
    """Its weights were painted in an A-pose, which the file keeps: skinning its T-pose would be off by a centimetre."""
    body, pose = open_body("male"), random_pose(2, 22).float()
    path = tmp_path / "template.npz"
    write_body(path, body.with_canonical_pose(random_pose(22, seed=1)))
    again = packed_body(path)
    assert torch.equal(again.faces, body.faces)
    assert (again.parents, again.joint_names) == (body.parents, body.joint_names)
    torch.testing.assert_close(again.template.vertices, body.template.vertices, atol=1e-6, rtol=0)
    torch.testing.assert_close(again(pose).vertices, body(pose).vertices, atol=1e-5, rtol=0)
    stored = np.load(path)
    np.testing.assert_allclose(stored["vertices"], body.template.vertices.numpy(), atol=1e-6)


def test_template_round_trip_loses_nothing_but_the_bind_pose(tmp_path):
    body, path = open_body("male").with_canonical_pose(random_pose(22)), tmp_path / "template.npz"
    write_template(path, body.template)
    torch.testing.assert_close(read_template(path).canonical_from_bind, body.template.canonical_from_bind)
    for again in (read_template(path), packed_body(path).template):
        for name in ("vertices", "faces", "joints", "weights", "uv", "uv_faces"):
            torch.testing.assert_close(getattr(again, name), getattr(body.template, name), atol=1e-6, rtol=0)
        assert (again.parents, again.joint_names) == (body.parents, body.joint_names)


def test_file_of_vertices_and_dense_weights_poses_like_its_body(tmp_path):
    body, pose = BodyModel(random_bind()).float(), random_pose(2, 5).float()
    again = packed_body(write(tmp_path / "template.npz"))
    torch.testing.assert_close(again(pose).vertices, body(pose).vertices, atol=1e-5, rtol=1e-5)


def test_bind_pose_and_pose_blendshapes_are_kept(tmp_path):
    """What `write_body` keeps in full; of `write_template` the bind pose follows from ``canonical_from_bind``."""
    body, pose = random_body(correctives=True).float(), random_pose(2, 5).float()
    write_body(tmp_path / "body.npz", body)
    torch.testing.assert_close(packed_body(tmp_path / "body.npz")(pose).vertices, body(pose).vertices)
    body = random_body().float()
    write_template(tmp_path / "template.npz", body.template)
    torch.testing.assert_close(packed_body(tmp_path / "template.npz")(pose).vertices, body(pose).vertices)


def test_a_bind_pose_that_cannot_be_undone_is_refused(tmp_path):
    path = write(tmp_path / "template.npz", canonical_from_bind=np.zeros((5, 4, 4)))
    with pytest.raises(DataError, match=r"template\.npz.*singular"):
        packed_body(path)


def test_sparse_weights_keep_the_largest_and_sum_to_one():
    weights = np.array([[0.5, 0.3, 0.2, 0], [0, 0, 0, 1.0]])
    ids, values = sparse_weights(weights)
    assert ids.shape == (2, 3)
    np.testing.assert_allclose(dense_weights(ids, values, 4), weights, atol=1e-7)
    ids, values = sparse_weights(weights, most=2)
    assert ids.tolist()[0] == [0, 1] and ids[1, 0] == 3
    np.testing.assert_allclose(values, [[0.625, 0.375], [1, 0]])


def test_dense_weights_of_integers_and_of_a_joint_named_twice():
    assert dense_weights(np.array([[2, 0]]), np.array([[3, 1]], np.uint8), 3).tolist() == [[0.25, 0, 0.75]]
    assert dense_weights(np.array([[1, 1]]), np.array([[1, 3]]), 2).tolist() == [[0, 1]]


@pytest.mark.parametrize(("ids", "values"), [([[5]], [[1]]), ([[-1]], [[1]]), ([[0]], [[0]]), ([[0, 1]], [[2, -1]])])
def test_bad_sparse_weights_are_refused(ids, values):
    with pytest.raises(AvatarError, match="weight_"):
        dense_weights(np.array(ids), np.array(values), 3)


def test_joint_of_a_hinged_tube_is_estimated_exactly():
    """Rings along x, the middle ring shared half and half: the joint is its centre."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rings = [np.stack([np.full(12, x), np.cos(angles), np.sin(angles)], axis=1) for x in (0.0, 1.0, 2.0)]
    weights = np.repeat([[1, 0], [0.5, 0.5], [0, 1]], 12, axis=0)
    joints = joint_positions(np.concatenate(rings), weights, (-1, 0))
    np.testing.assert_allclose(joints, [[1, 0, 0], [1, 0, 0]], atol=1e-12)


def test_joints_of_the_open_body_are_estimated_within_centimetres():
    template = open_body("female").template
    found = joint_positions(template.vertices.numpy(), template.weights.numpy(), template.parents)
    gaps = np.linalg.norm(found - template.joints.numpy(), axis=1)
    assert np.median(gaps) < 0.04 and gaps.max() < 0.13


def test_joints_missing_from_the_file_are_estimated(tmp_path):
    bind = random_bind()
    body = packed_body(write(tmp_path / "t.npz", joints=None))
    expected = joint_positions(bind.vertices.numpy(), bind.weights.numpy(), bind.parents)
    torch.testing.assert_close(body.template.joints, torch.tensor(expected).float())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": None}, "got neither"),
        ({"weights": np.full((40, 5), 0.5)}, "rows summing to 1"),
        ({"weights": np.eye(5)[np.arange(40) % 5], "joints": None}, "shares no vertex"),
        ({"parents": np.array([-1, 0, 7, 0, 0])}, "every parent before its child"),
        ({"parents": np.array([-1, 0, 7, 0, 0]), "joints": None}, "every parent before its child"),
        ({"bind_vertices": np.zeros((40, 3))}, "expected all of bind_vertices, bind_joints, zero_from_bind or none"),
        ({"faces": np.array([[0, 1, 99]])}, "faces: expected vertex indices"),
        ({"vertices": None}, "vertices"),
        ({"joint_names": np.array(["a", "b"])}, "joint_names"),
        ({"vertices": np.full((40, 3), np.nan)}, "finite"),
        ({"uv": np.zeros((3, 2))}, "uv_faces: expected shape"),
        ({"uv": np.zeros((3, 2)), "uv_faces": np.full((30, 3), 3)}, "uv_faces: expected indices"),
        ({"vertices": np.array([object()] * 40)}, "vertices"),
    ],
)
def test_bad_files_are_refused_by_name(tmp_path, changes, message):
    with pytest.raises(DataError, match=message) as caught:
        packed_body(write(tmp_path / "template.npz", **changes))
    assert "template.npz" in str(caught.value)
    if "bind_vertices" not in changes:
        with pytest.raises(DataError, match=message):
            read_template(tmp_path / "template.npz")


def test_missing_and_truncated_files(tmp_path):
    with pytest.raises(DataError, match=r"none\.npz"):
        packed_body(tmp_path / "none.npz")
    path = write(tmp_path / "template.npz")
    path.write_bytes(path.read_bytes()[:700])
    with pytest.raises(DataError, match=r"template\.npz"):
        packed_body(path)
