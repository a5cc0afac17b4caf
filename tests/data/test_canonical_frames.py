"""Outfits in canonical space: the canonicalizer's scan over the body at rest, told the posed body's pose."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import canonical_truth

from avatar.checks import AvatarError, DataError
from avatar.data.batches import FrameDataset, name_frames
from avatar.data.layouts import CanonicalOutfit
from avatar.io.frames import write_canonical_scan


@pytest.fixture(scope="module")
def scans(tiny_outfit, tmp_path_factory) -> Path:
    """The train frames' true canonical scans."""
    folder = tmp_path_factory.mktemp("scans")
    for name in tiny_outfit.frames("train"):
        write_canonical_scan(folder / "train" / f"{name}.npz", canonical_truth(tiny_outfit, "train", name))
    return folder


def test_scan_and_body_are_at_rest_and_the_pose_is_kept(tiny_outfit, scans):
    resting, name = CanonicalOutfit(tiny_outfit, scans), tiny_outfit.frames("train")[3]
    assert (resting.name, resting.dataset) == (tiny_outfit.name, tiny_outfit.dataset)
    frame, posed = resting.load("train", name), tiny_outfit.load("train", name)
    np.testing.assert_array_equal(frame.scan.points, posed.scan.canonical)
    np.testing.assert_array_equal(frame.body.vertices, tiny_outfit.template.vertices.numpy())
    np.testing.assert_array_equal(frame.body.vertex_transforms, np.broadcast_to(np.eye(4), (12272, 4, 4)))
    for key in ("joint_transforms", "pose_vertices", "pose", "translation"):
        np.testing.assert_array_equal(getattr(frame.body, key), getattr(posed.body, key))
    assert (frame.name, frame.outfit, frame.split) == (posed.name, posed.outfit, posed.split)
    again = resting.fit_pose(posed.body.pose, posed.body.translation)
    np.testing.assert_array_equal(again.vertices, posed.body.vertices)


def test_they_make_batches_as_posed_outfits_do(tiny_outfit, scans):
    resting = CanonicalOutfit(tiny_outfit, scans)
    names = name_frames([resting], "train", [resting.frames("train")])
    batch = FrameDataset([resting], names, 500).batch_at(0, 2)
    posed = FrameDataset([tiny_outfit], names, 500).batch_at(0, 2)
    assert batch.names == posed.names
    torch.testing.assert_close(batch.pose_vertices, posed.pose_vertices, rtol=0, atol=0)
    torch.testing.assert_close(batch.vertices[0], resting.template.vertices, rtol=0, atol=0)
    assert (batch.scan_points - posed.scan_points).abs().max() > 0.1


def test_what_is_missing_or_elsewhere_is_refused(tiny_outfit, scans, tmp_path):
    first, second = tiny_outfit.frames("train")[:2]
    resting = CanonicalOutfit(tiny_outfit, scans)
    with pytest.raises(DataError, match=r"check\.00000\.npz: no canonical scan of this frame.*tools/canonicalize\.py"):
        resting.load("test", tiny_outfit.frames("test")[0])
    with pytest.raises(AvatarError, match="has no train frame 'nothing'"):
        resting.load("train", "nothing")
    shutil.copytree(scans, tmp_path / "scans")
    off = canonical_truth(tiny_outfit, "train", first)
    away = replace(off, points=off.points + np.float32([2, 0, 0]))
    write_canonical_scan(tmp_path / "scans" / "train" / f"{first}.npz", away)
    elsewhere = CanonicalOutfit(tiny_outfit, tmp_path / "scans")
    with pytest.raises(DataError, match=r"scans.train.rise\.00000\.npz"):
        elsewhere.load("train", first)
    assert len(elsewhere.load("train", second).scan.points) == 4000
