"""Held-back frames, fractions and leakage."""

import re
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from avatar.checks import AvatarError
from avatar.data.splits import SplitConfig, check_copies, check_leakage, sequence_of, split_frames, split_outfit


def frames(**sequences):
    return [f"{name}.{i:05d}" for name, count in sequences.items() for i in range(count)]


def test_whole_sequences_are_held_back_where_there_are_several():
    names = frames(a=10, b=10, c=10, d=10, e=10)
    split = split_frames(names, SplitConfig(validation_share=0.2))
    assert {sequence_of(name) for name in split.validation} == {"e"}
    assert sorted(split.train + split.validation) == names
    assert split == split_frames(list(reversed(names)), SplitConfig(validation_share=0.2))
    assert len(split_frames(names, SplitConfig(validation_share=0.01)).validation) == 10  # never half a sequence
    uneven = frames(a=3, b=3, c=4, long=90)
    assert {sequence_of(n) for n in split_frames(uneven, SplitConfig(validation_share=0.05)).validation} == {"c"}


def test_frames_are_held_back_where_sequences_are_few():
    names = frames(random=54)
    split = split_frames(names, SplitConfig(validation_share=0.1))
    assert split.validation == tuple(names[-5:])
    assert split.train == tuple(names[:-5])
    assert split_frames(names, SplitConfig(validation_share=0)).validation == ()


@pytest.mark.parametrize(("fraction", "kept"), [(1.0, 48), (0.5, 24), (0.125, 6), (1 / 3, 16), (0.01, 1)])
def test_fractions_thin_evenly_and_leave_validation_alone(fraction, kept):
    names = frames(random=54)
    whole = split_frames(names, SplitConfig(validation_share=6 / 54))
    split = split_frames(names, SplitConfig(validation_share=6 / 54, train_fraction=fraction))
    assert split.validation == whole.validation
    assert len(split.train) == kept
    places = [whole.train.index(name) for name in split.train]
    gaps = {b - a for a, b in pairwise(places)}
    assert places[0] == 0
    assert gaps <= {round(1 / fraction)} or not gaps


def test_frames_in_train_and_test_are_refused(tiny_outfit):
    split = split_outfit(tiny_outfit)
    assert not set(split.train + split.validation) & set(tiny_outfit.frames("test"))
    assert len(split.train + split.validation) == 6
    with pytest.raises(AvatarError, match=r"tiny: .* 1 are in both \(b\)"):
        check_leakage(["a", "b"], ["b", "c"], "tiny")
    leaking = SimpleNamespace(
        name="x", path=tiny_outfit.path, frames=lambda _: ("a.1", "a.2"), has_frames=lambda split: split != "test"
    )
    with pytest.raises(AvatarError, match=r"x, interpolation: .* 2 are in both"):
        split_outfit(leaking)


def test_bad_shares_are_refused():
    for bad in ({"validation_share": 1.0}, {"train_fraction": 0.0}, {"validation_share": -0.1}, {"train_fraction": 2}):
        with pytest.raises(AvatarError, match="expected at least 0 and below 1"):
            SplitConfig(**bad)
    with pytest.raises(AvatarError, match="frames left to train on"):
        split_frames(["a.1"], SplitConfig())


def test_held_back_frames_are_a_split_of_their_own(tiny_outfit):
    names = tiny_outfit.frames("train")[1::3]
    outfit = tiny_outfit.with_validation(names)
    assert outfit.frames("validation") == names and outfit.frames("train") == tiny_outfit.frames("train")
    frame = outfit.load("validation", names[0])
    assert frame.split == "validation" and np.array_equal(frame.scan.points, outfit.load("train", names[0]).scan.points)
    assert outfit.digest("validation", names[0]) == outfit.digest("train", names[0])
    with pytest.raises(AvatarError, match="no validation frame"):
        outfit.load("validation", tiny_outfit.frames("train")[0])
    with pytest.raises(AvatarError, match="no train frame"):
        tiny_outfit.with_validation(("dance.00001",))
    with pytest.raises(AvatarError, match="validation where frames were held back"):
        tiny_outfit.frames("validation")


def packed(folder, **scans):
    """An outfit of files with scans, by path."""
    names = {}
    for path, scan in scans.items():
        split, _, name = path.partition("_")
        names.setdefault(split, []).append(name)
        (folder / split).mkdir(exist_ok=True)
        np.savez(folder / split / f"{name}.npz", scan_pc=np.full((5, 3), scan), scan_name=np.array(name))
    return SimpleNamespace(name="x", path=folder, frames=names.get, has_frames=names.__contains__)


def test_copies_of_scans_are_found_whatever_their_names(tmp_path, caplog):
    check_copies(packed(tmp_path, train_a=1.0, train_b=2.0, test_c=3.0))
    assert caplog.text == ""
    check_copies(packed(tmp_path, train_a=1.0, train_b=1.0, train_d=1.0, test_c=3.0))
    assert re.search(
        r"2 train frames have the scan of another .*train/b = train/a, train/d = train/a.*once more", caplog.text
    )
    with pytest.raises(AvatarError, match=r"1 test frames have the scan of another frame of train .test/c = train/b"):
        check_copies(packed(tmp_path, train_a=1.0, train_b=2.0, test_c=2.0))
