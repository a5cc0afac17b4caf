"""`race`: two jobs start in one run folder at the same time; one trains, the other is refused."""

from __future__ import annotations

import shutil
from multiprocessing import get_context
from multiprocessing.synchronize import Barrier
from pathlib import Path

from reliability.findings import Finding, all_of
from reliability.small_jobs import folder_of, prepare, train_job, weights_digest
from reliability.workers import Worker, call_in_process


def race_trial(root: Path, races: int) -> list[Finding]:
    """Starts two processes that train the same run at the same moment, repeatedly."""
    call_in_process(prepare, root)
    call_in_process(train_job, "closet", root, "uninterrupted")
    expected = weights_digest(folder_of("closet", root, "uninterrupted"))
    one = equal = 0
    for race in range(races):
        name, barrier = f"race-{race}", get_context("fork").Barrier(2)
        runners = [Worker(start_together, barrier, root, name) for _ in range(2)]
        ends = sorted((runner.end() for runner in runners), key=lambda end: end.code or 0)
        one += [end.code for end in ends] == [0, 2] and "another job is at work" in ends[1].error
        folder = folder_of("closet", root, name)
        equal += weights_digest(folder) == expected
        shutil.rmtree(folder)
    return [
        all_of("race", "races in which one job trained and the other was refused, naming the first", one, races),
        all_of("race", "weights equal to those of a run without a race", equal, races),
    ]


def start_together(barrier: Barrier, root: Path, name: str) -> None:
    """Trains as soon as the other process is ready."""
    barrier.wait(60)
    train_job("closet", root, name)
