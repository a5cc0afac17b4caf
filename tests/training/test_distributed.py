"""Two processes under torchrun against one with the same batch: losses, weights, statistics, resuming."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

from avatar.checks import AvatarError
from avatar.io.checkpoints import load_checkpoint
from avatar.methods.canonicalizer import CanonicalizeConfig
from avatar.methods.settings import MethodChoice, RunConfig
from avatar.nn.layers import synchronize_norms
from avatar.runs.canonicalizing import train_canonicalizer
from avatar.runs.training import train as train_run
from avatar.training.logs import read_log
from avatar.world import World, average, broadcast, current_world, gather, torchrun_world

SCRIPT = Path(__file__).parent / "team.py"
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(SCRIPT)]


def run(folder: Path, steps: int, line: list[str]) -> Path:
    folder.mkdir(exist_ok=True)
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*line, str(folder), str(steps)], env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def one(tmp_path_factory) -> Path:
    return run(tmp_path_factory.mktemp("one"), 20, [sys.executable, str(SCRIPT)])


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> Path:
    """Twenty steps of two processes, the last eight in a second start."""
    folder = tmp_path_factory.mktemp("two")
    run(folder, 12, TORCHRUN)
    return run(folder, 20, TORCHRUN)


def facts(folder: Path, rank: int) -> dict:
    return json.loads((folder / f"facts-{rank}.json").read_text())


@pytest.mark.slow
def test_two_processes_give_the_losses_of_one(one, two):
    alone, together = read_log(one / "metrics.csv"), read_log(two / "metrics.csv")
    expected = {(row["split"], row["step"]): row for row in alone}
    assert {key for key in expected if key[0] == "train"} == {("train", str(step)) for step in range(1, 21)}
    for row in together:
        if (row["split"], row["step"]) in expected:  # a first end of the budget adds a validation at step 12
            for term in ("loss", "chamfer", "normal", "offset", "code", "grad_norm"):
                wanted = expected[row["split"], row["step"]][term]
                assert float(row[term] or 0) == pytest.approx(float(wanted or 0), rel=1e-5), (row["step"], term)


@pytest.mark.slow
def test_all_processes_hold_the_same_weights_and_the_first_alone_writes(one, two):
    for rank in (0, 1):
        told = facts(two, rank)
        assert (told["rank"], told["size"], told["agree"]) == (rank, 2, True)
        assert told["seconds"][0] == told["seconds"][1]
    alone, together = (load_checkpoint(folder / "checkpoints") for folder in (one, two))
    assert alone["model"].keys() == together["model"].keys()
    assert len(together["random"]) == 2 and len(alone["random"]) == 1
    rows = [row for row in read_log(two / "metrics.csv") if row["split"] == "train"]
    assert [int(row["step"]) for row in rows] == list(range(1, 21))


@pytest.mark.slow
def test_shared_norms_equal_those_of_the_whole_batch(two):
    for rank in (0, 1):
        assert max(facts(two, rank)["norms"]) < 2e-5


@pytest.mark.slow
def test_outfits_count_once_in_whatever_processes_they_are(two):
    """Gradients, loss terms and running statistics of a step with two outfits are those of one process."""
    for rank in (0, 1):
        errors = facts(two, rank)["outfits"]
        assert len(errors) == 8 and max(errors.values()) < 1e-5, errors


@pytest.mark.slow
def test_a_bad_frame_of_one_process_costs_all_the_step_and_no_more(two):
    broken, valid = zip(*(facts(two, rank)["bad"] for rank in (0, 1)))
    assert not any(map(math.isfinite, broken)) and valid[0] == valid[1] and math.isfinite(valid[0])


def test_a_process_alone_is_a_world_of_one(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "1")
    monkeypatch.setenv("LOCAL_RANK", "0")
    with torchrun_world() as world:
        assert world == current_world() == World(0, 1)
    assert world.is_main and world.shard(3) == slice(0, 3)
    values = [torch.tensor([2.0])]
    average(values, world)
    assert values[0] == 2 and gather("a", world) == ["a"] and broadcast("b", world) == "b"


def test_what_trains_in_one_process_refuses_several(monkeypatch):
    monkeypatch.setattr("avatar.world.current_world", lambda: World(1, 2))
    with pytest.raises(AvatarError, match=r"scanimate: expected one process, got 2.*without torchrun"):
        train_run(RunConfig(method=MethodChoice("scanimate")))
    with pytest.raises(AvatarError, match=r"canonicalizer: expected one process, got 2.*without torchrun"):
        train_canonicalizer(CanonicalizeConfig())


def test_shares_cover_the_batch_and_must_be_even():
    rows = [list(range(12))[World(rank, 3).shard(12)] for rank in range(3)]
    assert rows == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]
    with pytest.raises(AvatarError, match="batch: expected a multiple of the 2 processes, got 3"):
        World(0, 2).shard(3)


def test_norms_of_another_kind_are_refused():
    class Conditional(nn.BatchNorm1d):
        pass

    with pytest.raises(AvatarError, match="Conditional"):
        synchronize_norms(nn.Sequential(Conditional(3)))
