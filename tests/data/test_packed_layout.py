"""Packed outfits of one's own body: what ``outfit.yaml`` may say, poses with and without hands, mean shapes."""

import dataclasses
import re
import shutil
import sys

import numpy as np
import pytest
import torch
import yaml
from smpl_person import BETAS, frame_arrays, pose_person, whole_pose
from tiny import tiny_pose

from avatar.body.open import open_body
from avatar.body.packed import write_template
from avatar.body.registry import canonical_pose
from avatar.checks import DataError
from avatar.cli import pack
from avatar.data.layouts import OpenOutfit, open_outfit_folder
from avatar.data.packed_layout import PackedOutfit

POSE = tiny_pose(0.5)


@pytest.fixture
def folder(person_folder, tmp_path):
    return shutil.copytree(person_folder, tmp_path / "mine" / "coat")


def say(folder, **settings):
    (folder / "outfit.yaml").write_text(yaml.safe_dump(settings))
    return open_outfit_folder(folder)


def vertices(person, pose=POSE):
    return pose_person(person, whole_pose(pose), np.zeros(3)).vertices


def test_a_converted_file_in_place_of_the_template_is_a_body_without_outfit_yaml(folder, person):
    (folder / "outfit.yaml").unlink()
    outfit = PackedOutfit(folder)
    assert len(outfit.template.parents) == 24
    shaped = vertices(person) - outfit.fit_pose(whole_pose(POSE)).vertices
    assert 0.02 < np.abs(shaped).max() < 0.1  # the mean shape: nobody has named this person's betas


def test_a_body_may_be_shared_and_named_by_its_kind(folder, person):
    (folder / "template.npz").rename(folder.parent / "body.npz")
    outfit = say(folder, body={"model": "smpl", "path": "../body.npz", "betas": list(BETAS)})
    np.testing.assert_allclose(outfit.fit_pose(whole_pose(POSE)).vertices, vertices(person), atol=1e-5)
    before = outfit.shared_digest
    shutil.copy(folder.parent / "body.npz", folder / "template.npz")
    with np.load(folder / "template.npz") as stored:
        arrays = dict(stored)
    np.savez(folder.parent / "body.npz", **arrays | {"v_template": arrays["v_template"] * 1.01})
    (folder / "template.npz").unlink()
    assert PackedOutfit(folder).shared_digest != before  # so that predictions of the other body are made again


def test_hands_may_be_left_out_of_bodies_and_poses(folder, person):
    body = {"path": "template.npz", "betas": list(BETAS)}
    arrays = frame_arrays(person, 0.5)
    bent = arrays["pose"].copy()
    np.savez(folder / "train" / "rise.00000.npz", **arrays)
    with pytest.raises(DataError, match=r"rotations of 22 joints, it turns joints beyond them.*all_joints: true"):
        say(folder, body=body | {"all_joints": False}).load("train", "rise.00000")
    bent[22:] = 0
    flat = pose_person(person, bent, arrays["translation"]).vertices.astype(np.float32)
    arrays = {key: value for key, value in arrays.items() if key != "vtransf"} | {"body_verts": flat}
    for rows in (22, 24):
        np.savez(folder / "train" / "rise.00000.npz", **arrays | {"pose": bent[:rows]})
        for every, joints in ((False, 22), (True, 24)):
            fit = say(folder, body=body | {"all_joints": every}).load("train", "rise.00000").body
            assert fit.pose.shape == (joints, 3) and fit.joint_transforms.shape == (joints, 4, 4)
    np.savez(folder / "train" / "rise.00000.npz", **arrays | {"pose": bent[:21]})
    with pytest.raises(DataError, match=r"pose: expected shape \(24, 3\)"):
        say(folder, body=body).load("train", "rise.00000")


def test_a_mean_body_is_what_encoders_see_of_frames_and_motions(folder, person):
    mean = say(folder, body={"path": "template.npz"}).fit_pose(whole_pose(POSE)).pose_vertices
    outfit = say(folder, body={"betas": list(BETAS)}, mean_body={"path": "template.npz"})
    np.testing.assert_allclose(outfit.fit_pose(whole_pose(POSE)).pose_vertices, mean, atol=1e-6)
    seen = outfit.load("train", "rise.00001").body
    np.testing.assert_allclose(seen.pose_vertices, outfit.fit_pose(seen.pose).pose_vertices, atol=1e-6)
    write_template(folder / "mean.npz", open_body("mean").template)
    with pytest.raises(DataError, match="mean_body: expected the faces and joints of body"):
        _ = say(folder, body={"betas": list(BETAS)}).mean_body


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"path": "none.npz"}, r"none\.npz.*there is none.*tools/convert_body\.py <downloaded file>"),
        ({"beta": [1.0]}, "body.beta: no such option. Did you mean 'betas'"),
        ({"betas": [0.0] * 11}, "at most 10 numbers"),
        ({"model": "smplx"}, "expected a smplx body model, got smpl"),
        ({"model": "smlp"}, "expected one of open, anny, smpl"),
        ("template.npz", r"body: expected a mapping such as \{path: template.npz"),
        ({"path": 7}, "body: expected a mapping"),
        ({"canonical": "sitting"}, "expected one of t, apart"),
    ],
)
def test_what_outfit_yaml_says_of_a_body_is_checked(folder, body, message):
    with pytest.raises(DataError, match=message):
        _ = say(folder, body=body).template


def test_the_pack_command_keeps_the_canonical_pose(tiny_folder, tmp_path, monkeypatch, capsys):
    """Frames are relative to it: legs apart at rest must not become the T-pose."""
    shutil.copytree(tiny_folder, tmp_path / "open" / "tiny")
    shutil.rmtree(tmp_path / "open" / "tiny" / "test")
    for path in sorted((tmp_path / "open" / "tiny" / "train").glob("*.npz"))[1:]:
        path.unlink()
    text = (tmp_path / "open" / "tiny" / "outfit.yaml").read_text()
    (tmp_path / "open" / "tiny" / "outfit.yaml").write_text(text.replace("canonical: t", "canonical: apart"))
    outfit = OpenOutfit(tmp_path / "open" / "tiny")
    monkeypatch.setattr(sys, "argv", ["pack", str(outfit.path), str(tmp_path / "packed" / "tiny")])
    pack()
    assert re.search(r"1 frames\nnext: .*train\.py dataset=packed outfit=tiny data_root=", capsys.readouterr().out)
    packed = PackedOutfit(tmp_path / "packed" / "tiny")
    apart = canonical_pose("apart", outfit.body.joint_names)
    torch.testing.assert_close(packed.body.canonical_pose, apart)
    ours, theirs = (o.load("train", "rise.00000").body for o in (outfit, packed))
    posed = packed.fit_pose(ours.pose, ours.translation)
    for key in (field.name for field in dataclasses.fields(ours)):
        np.testing.assert_allclose(getattr(theirs, key), getattr(ours, key), atol=1e-5)
        np.testing.assert_allclose(getattr(posed, key), getattr(ours, key), atol=2e-5)
