"""Outfit lists and splits of papers: plain names, each once, and frames that go where the paper has them."""

from dataclasses import replace
from pathlib import Path

import pytest

from avatar.checks import SAFE_NAME, AvatarError, DataError
from avatar.sources.base import SourceFrame, numbered, outfits_at, sorted_frames
from avatar.sources.published import named_outfits, published_outfits, published_splits, split_frames


def sequences(**counts: int) -> list[SourceFrame]:
    return [
        SourceFrame(f"{name}.{number:03d}", "", (Path("scan.ply"),), name, number)
        for name, count in counts.items()
        for number in range(count)
    ]


def test_names_are_plain_and_each_stands_once_in_a_list():
    lists = published_outfits()
    for name, outfits in lists.items():
        assert SAFE_NAME.fullmatch(name) and all(SAFE_NAME.fullmatch(outfit) for outfit in outfits)
        assert len(set(outfits)) == len(outfits) and list(outfits) == sorted(outfits)
    assert not set(lists) & {outfit for outfits in lists.values() for outfit in outfits}
    assert {key: len(lists[key]) for key in lists if "pop" in key} == {
        "resynth_pop_seen": 12,
        "resynth_pop_unseen": 4,
        "cape_pop_seen": 14,
        "cape_pop_unseen": 1,
    }
    assert not set(lists["resynth_pop_seen"]) & set(lists["resynth_pop_unseen"])


def test_a_list_stands_for_its_outfits():
    assert named_outfits(["mine", "cape_pop_unseen", "mine"]) == ["mine", "00032_shortlong"]
    assert set(published_splits()["4d-dress"].takes) == set(published_outfits()["4d-dress_representation"])


def test_sequences_of_capes_motions_are_tested_on():
    frames = sequences(shortlong_ATUsquat_trial1=4, shortlong_ballerina_spin_trial2=3)
    found = split_frames(frames, "00096_shortlong", "cape")
    assert [(frame.split, frame.number) for frame in found] == [("test", 2), ("train", 2), ("train", 3)]
    with pytest.raises(AvatarError, match="expected sequences to train on and to test on, cape tests on all or none"):
        split_frames(frames[:4], "00096_shortlong", "cape")


def test_scanimate_trains_on_every_tenth_frame_of_four_sequences_in_five():
    frames = sequences(a=21, b=21, c=21, d=21, e=21)
    found = split_frames(frames, "any", "scanimate")
    assert found == split_frames(frames, "any", "scanimate")
    tested = {frame.sequence for frame in found if frame.split == "test"}
    assert len(tested) == 1 and sum(frame.split == "test" for frame in found) == 21
    trained = [frame for frame in found if frame.split == "train"]
    assert {frame.number for frame in trained} == {0, 10, 20} and len(trained) == 12
    assert [frame.split for frame in found] == sorted(frame.split for frame in found)
    between = [frame for frame in found if frame.split == "interpolation"]
    assert {frame.number for frame in between} == {5, 15} and not tested & {frame.sequence for frame in between}


def test_frames_and_outfits_of_one_name_are_refused(tmp_path):
    frames = sequences(walk=2)
    assert sorted_frames(tmp_path, frames[::-1]) == tuple(frames)
    twin = replace(frames[0], files=(Path("other.ply"),))
    with pytest.raises(
        DataError, match=r"expected every frame once, scan\.ply and other\.ply are both called walk\.000"
    ):
        sorted_frames(tmp_path, [*frames, twin])
    with pytest.raises(DataError, match=r"expected every outfit once, a/coat has the name coat too"):
        outfits_at([Path("a/coat"), Path("b/coat")])


def test_one_take_of_4d_dress_is_tested_on():
    found = split_frames(sequences(Take2=2, Take7=2), "00148_Inner", "4d-dress")
    assert {(frame.sequence, frame.split) for frame in found} == {("Take2", "train"), ("Take7", "test")}


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("shortlong_ATUsquat_trial2.000009", ("shortlong_ATUsquat_trial2", 9)),
        ("mesh-f00011", ("mesh", 11)),
        ("0007", ("", 7)),
        ("standing", ("standing", -1)),
    ],
)
def test_names_of_files_hold_sequence_and_number(stem, expected):
    assert numbered(stem) == expected
