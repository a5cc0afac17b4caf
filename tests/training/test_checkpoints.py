"""Checkpoints: damage is noticed, the previous one serves, nothing non-finite is written."""

import pytest
import torch

from avatar.checks import AvatarError, DataError
from avatar.training.checkpoints import load_checkpoint, read_weights, save_checkpoint, write_weights


def state(value: float) -> dict:
    return {"model": {"weight": torch.full((64,), value)}, "step": int(value)}


def test_newest_is_loaded_two_and_the_best_are_kept(tmp_path):
    for step, score in ((1, 0.5), (2, 0.1), (3, 0.3)):
        save_checkpoint(tmp_path, state(step), step, score)
    assert load_checkpoint(tmp_path)["step"] == 3
    assert load_checkpoint(tmp_path, "best")["step"] == 2
    assert sorted(p.name for p in tmp_path.glob("*.pt")) == ["best.pt", "step-00000002.pt", "step-00000003.pt"]
    assert load_checkpoint(tmp_path / "none") is None


@pytest.mark.parametrize("damage", ["flip", "truncate", "delete"])
def test_a_damaged_checkpoint_gives_way_to_the_one_before(tmp_path, damage):
    save_checkpoint(tmp_path, state(1), 1)
    newest = save_checkpoint(tmp_path, state(2), 2)
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 1
    newest.write_bytes(bytes(data) if damage == "flip" else bytes(data[: len(data) // 2]))
    if damage == "delete":
        newest.unlink()
    with pytest.warns(UserWarning, match=r"step-00000002\.pt.*step-00000001\.pt"):
        assert load_checkpoint(tmp_path)["step"] == 1
    (tmp_path / "step-00000001.pt").write_bytes(b"")
    with pytest.raises(DataError, match="no checkpoint listed here is sound"), pytest.warns(UserWarning):
        load_checkpoint(tmp_path)


def test_non_finite_weights_are_never_written(tmp_path):
    save_checkpoint(tmp_path, state(1), 1)
    with pytest.raises(AvatarError, match=r"weight.*finite.*step 2"):
        save_checkpoint(tmp_path, {"model": {"weight": torch.tensor([float("nan")])}}, 2)
    assert load_checkpoint(tmp_path)["step"] == 1


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
