"""Batches made ahead: the same ones, by one thread, with errors where they belong and nothing left running."""

import threading
import time
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from avatar.training import trainer
from avatar.training.trainer import Feed

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Numbers:
    values: Tensor
    name: str


def numbers(step: int) -> tuple[Numbers, Numbers]:
    draw = torch.Generator().manual_seed(step)
    return Numbers(torch.rand(3, generator=draw), f"step {step}"), Numbers(torch.full((1,), step), "number")


@pytest.fixture
def elsewhere(monkeypatch) -> torch.device:
    """A device that is not the CPU, whose tensors stay where they are."""
    monkeypatch.setattr(trainer, "to_device", lambda records, device: records)
    return torch.device("meta")


def feeding_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("feed")]


def test_inputs_are_those_of_their_step_wherever_one_begins(elsewhere):
    for first, device in ((0, CPU), (0, elsewhere), (4, elsewhere)):
        with Feed(numbers, 8, device) as feed:
            for step in range(first, 8):
                for mine, expected in zip(feed(step), numbers(step), strict=True):
                    assert torch.equal(mine.values, expected.values) and mine.name == expected.name
    with Feed(numbers, 8, elsewhere) as feed:  # and where one jumps
        assert [feed(step)[1].values.item() for step in (3, 3, 0, 7)] == [3, 3, 0, 7]


def test_for_cuda_tensors_of_the_cpu_are_pinned_and_those_on_the_device_are_not(monkeypatch):
    pinned = []
    monkeypatch.setattr(Tensor, "pin_memory", lambda tensor: pinned.append(tensor) or tensor)
    mine, there = torch.zeros(3), torch.zeros(3, device="meta")  # torch refuses to pin the second
    feed = Feed(lambda step: (Numbers(mine, "mine"), Numbers(there, "there")), 2, CPU)
    feed.pinned = True
    first, second = feed._prepare(0)
    assert len(pinned) == 1 and pinned[0] is mine and (first.values is mine, second.values is there) == (True, True)


def test_on_the_cpu_no_thread_is_begun():
    """A second thread with tensor work halves the patience of OpenMP's idle threads, and with it the speed of steps."""
    seen = []
    with Feed(lambda step: seen.append(threading.current_thread()) or numbers(step), 2, CPU) as feed:
        feed(0)
    assert seen == [threading.main_thread()]


def test_the_next_step_is_made_while_this_one_trains_and_none_beyond_the_last(elsewhere):
    made, second = [], threading.Event()

    def make(step: int):
        assert threading.current_thread().name.startswith("feed")
        made.append(step)
        if step == 1:
            second.set()
        return numbers(step)

    with Feed(make, 2, elsewhere) as feed:
        feed(0)
        assert second.wait(10)  # without being asked for
        feed(1)
    assert made == [0, 1]


def test_an_error_is_raised_at_its_own_step_and_ends_the_thread(elsewhere):
    def make(step: int):
        return numbers(step) if step != 2 else 1 // 0

    with pytest.raises(ZeroDivisionError), Feed(make, 5, elsewhere) as feed:
        assert feed(0) and feed(1)
        feed(2)
    assert not feeding_threads()


@pytest.mark.parametrize("ending", [KeyboardInterrupt, SystemExit, None])
def test_whatever_ends_the_steps_nothing_goes_on(ending, elsewhere):
    running = []

    def make(step: int):
        running.append(step)
        time.sleep(0.05)
        running.remove(step)
        return numbers(step)

    def work():
        with Feed(make, 100, elsewhere) as feed:
            feed(0)
            if ending:
                raise ending

    if ending:
        with pytest.raises(ending):
            work()
    else:
        work()
    assert not running and not feeding_threads()


def test_copies_to_cuda_are_pinned_where_they_are_made(monkeypatch):
    """Without CUDA: what would be asked of it, and by whom."""
    asked = []
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: asked.append((str(device), in_thread())))
    monkeypatch.setattr(Tensor, "pin_memory", lambda tensor: asked.append(("pin", in_thread())) or tensor)
    monkeypatch.setattr(Tensor, "to", lambda tensor, *_, **how: asked.append((how, in_thread())) or tensor)

    def in_thread() -> bool:
        return threading.current_thread().name.startswith("feed")

    with Feed(numbers, 1, torch.device("cuda", 1)) as feed:
        feed(0)
    assert asked == [("cuda:1", True), *[("pin", True)] * 2, *[({"non_blocking": True}, False)] * 2]
