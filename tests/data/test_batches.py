"""Batches: stateless order, scan subsets, memory."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from avatar.checks import AvatarError
from avatar.data.batches import FrameDataset, bytes_of, draw_points, name_frames


@pytest.fixture
def frames(tiny_outfit):
    names = name_frames([tiny_outfit], "train", [tiny_outfit.frames("train")])
    return FrameDataset([tiny_outfit], names, points=500, seed=7)


def test_a_batch_holds_its_frames_as_float32(frames, tiny_outfit):
    batch = frames.batch_at(0, 4)
    assert batch.pose_vertices.shape == batch.vertices.shape == (4, 12272, 3)
    assert batch.vertex_transforms.shape == (4, 12272, 4, 4)
    assert batch.joint_transforms.shape == (4, 22, 4, 4)
    assert batch.scan_points.shape == batch.scan_normals.shape == (4, 500, 3)
    assert batch.outfit_ids.dtype == torch.int64
    assert all(getattr(batch, key).dtype == torch.float32 for key in ("vertices", "scan_points", "vertex_transforms"))
    for row, name in enumerate(batch.names):
        frame = tiny_outfit.load("train", name)
        for field in ("pose_vertices", "vertices", "vertex_transforms", "joint_transforms"):
            np.testing.assert_array_equal(getattr(batch, field)[row].numpy(), getattr(frame.body, field))
        assert not np.array_equal(frame.body.pose_vertices, frame.body.vertices)
        there = {tuple(point) for point in frame.scan.points}
        drawn = [tuple(point) for point in batch.scan_points[row].numpy()]
        assert set(drawn) <= there
        assert len(set(drawn)) == 500  # each point once
        place = {tuple(p): tuple(n) for p, n in zip(frame.scan.points, frame.scan.normals)}
        assert all(place[p] == tuple(n) for p, n in zip(drawn, batch.scan_normals[row].numpy()))


def test_steps_go_through_epochs_without_a_gap_and_depend_on_nothing_else(frames, tiny_outfit):
    seen = [name for step in range(9) for name in frames.batch_at(step, 4).names]
    for epoch in range(6):
        assert sorted(seen[6 * epoch : 6 * epoch + 6]) == list(tiny_outfit.frames("train"))
    assert len({tuple(seen[6 * epoch : 6 * epoch + 6]) for epoch in range(6)}) > 1
    fresh = FrameDataset(frames.outfits, frames.names, points=500, seed=7).batch_at(5, 4)
    again = frames.batch_at(5, 4)
    assert fresh.names == again.names
    torch.testing.assert_close(fresh.scan_points, again.scan_points, rtol=0, atol=0)
    other = FrameDataset(frames.outfits, frames.names, points=500, seed=8)
    assert not torch.equal(other.item(0, 0).scan_points, frames.item(0, 0).scan_points)
    assert any(other.batch_at(step, 4).names != frames.batch_at(step, 4).names for step in range(3))


def test_scan_points_change_from_epoch_to_epoch_and_frame_to_frame(frames):
    first, again, next_epoch = frames.item(0, 1), frames.item(0, 1), frames.item(1, 1)
    assert torch.equal(first.scan_points, again.scan_points)
    assert not torch.equal(first.scan_points, next_epoch.scan_points)
    places = [cKDTree(frames.frame(index).scan.points).query(frames.item(0, index).scan_points)[1] for index in (0, 1)]
    assert not np.array_equal(*places)  # another frame, other places in its scan


def test_an_epoch_gives_every_frame_once(frames):
    assert [len(batch.names) for batch in frames.ordered_batches(4)] == [4, 2]
    ordered = [name for batch in frames.ordered_batches(4) for name in batch.names]
    assert ordered == [name.name for name in frames.names]
    one = next(iter(frames.ordered_batches(4))).scan_points
    assert torch.equal(one, next(iter(frames.ordered_batches(4))).scan_points)


def test_scans_with_fewer_points_repeat_them_evenly():
    rng = np.random.default_rng(0)
    counts = np.bincount(draw_points(10, 25, rng), minlength=10)
    assert set(counts) == {2, 3}
    assert sorted(draw_points(10, 10, rng)) == list(range(10))


def test_memory_is_bounded_and_changes_nothing(tiny_outfit, frames):
    one = bytes_of(tiny_outfit.load("train", "rise.00000"))
    assert one > 12272 * 22 * 4
    small = FrameDataset([tiny_outfit], frames.names, points=500, seed=7, cache_bytes=int(2.5 * one))
    none = FrameDataset([tiny_outfit], frames.names, points=500, seed=7, cache_bytes=0)
    for index in (0, 1, 0, 2):
        a, b, c = (dataset.item(0, index) for dataset in (frames, small, none))
        assert torch.equal(a.scan_points, b.scan_points)
        assert torch.equal(a.vertices, c.vertices)
    assert [small.names[index].name for index in small.frames.kept] == [
        "rise.00000",
        "rise.00002",
    ]  # least recently used left
    assert not none.frames.kept
    assert frames.frame(0) is frames.frame(0)


def test_outfits_share_a_run_when_their_bodies_agree(tiny_outfit):
    names = name_frames([tiny_outfit] * 2, "train", [["rise.00000"], ["rise.00001"]])
    batch = FrameDataset([tiny_outfit] * 2, names, points=100).batch_at(0, 2)
    assert dict(zip(batch.names, batch.outfit_ids.tolist())) == {"rise.00000": 0, "rise.00001": 1}

    class Other:
        name = "other"
        template = type("T", (), {"faces": tiny_outfit.template.faces[:-1]})

    with pytest.raises(AvatarError, match="one body topology in a run, other has another than tiny"):
        FrameDataset([tiny_outfit, Other()], names, points=100)
    with pytest.raises(AvatarError, match="expected at least 1 each, got 0"):
        FrameDataset([tiny_outfit], (), points=100)
