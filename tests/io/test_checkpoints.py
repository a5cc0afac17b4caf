"""Checkpoints: damage is noticed, the previous one serves, nothing non-finite is written, a full disk loses nothing."""

import errno
import json
import os
import random
import signal
from pathlib import Path

import pytest
import torch

from avatar.checks import AvatarError, DataError
from avatar.io.checkpoints import (
    MANIFEST,
    load_checkpoint,
    read_manifest,
    read_weights,
    save_checkpoint,
    write_weights,
)

PLACES = 8  # where a save can fail: two files, each opened, flushed to disk, renamed, and its folder flushed


def state(value: float) -> dict:
    return {"model": {"weight": torch.full((64,), float(value))}, "step": int(value)}


def fail_at(place: int, patch: pytest.MonkeyPatch, fail) -> None:
    """Makes the ``place``-th of a save's calls to the disk fail."""
    seen = iter(range(place + 1))

    def failing(real):
        def call(*arguments, **options):
            if next(seen, None) == place:
                fail()
            return real(*arguments, **options)

        return call

    patch.setattr(os, "fsync", failing(os.fsync))
    patch.setattr(Path, "replace", failing(Path.replace))
    patch.setattr(Path, "open", opening(Path.open, failing(Path.open)))


def opening(real, failing):
    def choose(path: Path, mode: str = "r", *arguments, **options):
        return (failing if mode == "wb" else real)(path, mode, *arguments, **options)

    return choose


def full_disk():
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_newest_is_loaded_two_and_the_best_are_kept(tmp_path):
    for step, score in ((1, 0.5), (2, 0.1), (3, 0.3), (4, None), (5, float("nan"))):
        save_checkpoint(tmp_path, state(step), step, score)
    assert load_checkpoint(tmp_path)["step"] == 5
    assert load_checkpoint(tmp_path, "best")["step"] == 2
    assert sorted(int(path.name[5:13]) for path in tmp_path.glob("*.pt")) == [2, 4, 5]
    assert load_checkpoint(tmp_path / "none") is None
    save_checkpoint(tmp_path / "unscored", state(1), 1)
    assert load_checkpoint(tmp_path / "unscored", "best") is None


@pytest.mark.parametrize("damage", ["flip", "truncate", "delete"])
def test_a_damaged_checkpoint_gives_way_to_the_one_before(tmp_path, damage):
    oldest = save_checkpoint(tmp_path, state(1), 1)
    newest = save_checkpoint(tmp_path, state(2), 2)
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 1
    newest.write_bytes(bytes(data) if damage == "flip" else bytes(data[: len(data) // 2]))
    if damage == "delete":
        newest.unlink()
    with pytest.warns(UserWarning, match=rf"{newest.name}.*{oldest.name}"):
        assert load_checkpoint(tmp_path)["step"] == 1
    save_checkpoint(tmp_path, state(2), 2)  # the run does the lost steps again
    assert load_checkpoint(tmp_path)["step"] == 2
    for path in tmp_path.glob("*.pt"):
        path.write_bytes(b"")
    with pytest.raises(DataError, match="no checkpoint listed here is valid"), pytest.warns(UserWarning):
        load_checkpoint(tmp_path)


def test_a_damaged_checkpoint_takes_no_sound_one_s_place(tmp_path):
    oldest, newest = save_checkpoint(tmp_path, state(10), 10), save_checkpoint(tmp_path, state(20), 20)
    newest.write_bytes(b"")
    save_checkpoint(tmp_path, state(15), 15).write_bytes(b"")
    with pytest.warns(UserWarning, match=rf"step-00000015.*{oldest.name}"):
        assert load_checkpoint(tmp_path)["step"] == 10


def test_every_flipped_bit_and_truncation_is_noticed(tmp_path):
    save_checkpoint(tmp_path, state(1), 1, 0.1)
    newest = save_checkpoint(tmp_path, state(2), 2, 0.2)
    rng = random.Random(0)
    for path, expected in ((newest, (1,)), (tmp_path / MANIFEST, (1, 2))):
        valid = path.read_bytes()
        for trial in range(60):
            data = bytearray(valid)
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            path.write_bytes(bytes(data) if trial < 40 else valid[: rng.randrange(len(valid))])
            with pytest.warns(UserWarning, match="damaged"):
                loaded = load_checkpoint(tmp_path)
            assert loaded["step"] in expected
            assert torch.equal(loaded["model"]["weight"], torch.full((64,), float(loaded["step"])))
        path.write_bytes(valid)


def test_a_lost_manifest_is_made_again(tmp_path):
    for step, score in ((1, 0.1), (2, 0.5), (3, 0.4)):
        save_checkpoint(tmp_path, state(step), step, score)
    before = read_manifest(tmp_path)
    (tmp_path / MANIFEST).write_text(json.dumps({"last": [], "sha256": "0"}))
    with pytest.warns(UserWarning, match="made again"):
        again = read_manifest(tmp_path)
    assert [entry["step"] for entry in again["last"]] == [1, 2, 3]
    assert again["best"]["file"] == before["best"]["file"]
    (tmp_path / MANIFEST).unlink()
    assert load_checkpoint(tmp_path)["step"] == 3
    assert load_checkpoint(tmp_path, "best")["step"] == 1


@pytest.mark.parametrize("place", range(PLACES))
def test_a_full_disk_leaves_the_last_good_checkpoint(tmp_path, monkeypatch, place):
    save_checkpoint(tmp_path, state(1), 1, 0.1)
    with monkeypatch.context() as patch:
        fail_at(place, patch, full_disk)
        with pytest.raises(DataError, match=r"No space left.*bytes needed.*free.*step 1"):
            save_checkpoint(tmp_path, state(2), 2, 0.2)
    survivor = load_checkpoint(tmp_path)
    assert survivor["step"] in ((1,) if place < PLACES - 1 else (1, 2))
    assert not list(tmp_path.glob(".*.tmp-*"))
    save_checkpoint(tmp_path, state(3), 3, 0.3)
    assert load_checkpoint(tmp_path)["step"] == 3
    assert load_checkpoint(tmp_path, "best")["step"] == 1


@pytest.mark.parametrize("place", range(PLACES))
def test_a_kill_inside_a_save_leaves_a_sound_checkpoint(tmp_path, place):
    save_checkpoint(tmp_path, state(1), 1, 0.1)
    child = os.fork()
    if child == 0:
        fail_at(place, pytest.MonkeyPatch(), lambda: os.kill(os.getpid(), signal.SIGKILL))
        save_checkpoint(tmp_path, state(2), 2, 0.05)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    kept = load_checkpoint(tmp_path)["step"]
    assert kept in (1, 2)
    assert load_checkpoint(tmp_path, "best")["step"] == kept
    save_checkpoint(tmp_path, state(3), 3, 0.01)
    assert load_checkpoint(tmp_path, "best")["step"] == 3
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".json", ".pt", ".pt"]


@pytest.mark.parametrize("where", ["model", "optimiser"])
def test_what_is_not_finite_is_never_written(tmp_path, where):
    save_checkpoint(tmp_path, state(1), 1)
    broken = state(2) | {where: {"state": [{"weight": torch.tensor([1.0, float("nan")])}]}}
    with pytest.raises(AvatarError, match=rf"{where}\.state\.0\.weight.*finite.*step 2"):
        save_checkpoint(tmp_path, broken, 2)
    assert load_checkpoint(tmp_path)["step"] == 1
    with pytest.raises(AvatarError, match="codes: expected finite weights"):
        write_weights(tmp_path / "avatar", {"codes": torch.tensor([float("inf")])}, {})
    assert not (tmp_path / "avatar.safetensors").exists()


def test_shared_weights_round_trip_and_damage_is_noticed(tmp_path):
    path = tmp_path / "avatar"
    weights = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.ones(2).long()}
    write_weights(path, weights, {"method": "closet"})
    loaded, description = read_weights(path)
    assert description["method"] == "closet"
    assert all(torch.equal(loaded[key], weights[key]) for key in weights)
    file = path.with_suffix(".safetensors")
    data = bytearray(file.read_bytes())
    data[-1] ^= 4
    file.write_bytes(bytes(data))
    with pytest.raises(DataError, match="sha256"):
        read_weights(path)
    with pytest.raises(DataError, match="no such file"):
        read_weights(tmp_path / "other")
