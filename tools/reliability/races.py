"""`race`: two jobs begin in one run folder at the same time; one works, the other is told so."""

from __future__ import annotations

import shutil
from multiprocessing import get_context
from multiprocessing.synchronize import Barrier
from pathlib import Path

from reliability.findings import Finding, all_of
from reliability.small_jobs import folder_of, prepare, train_job, weights_digest
from reliability.workers import Victim, work_alone


def race_trial(root: Path, races: int) -> list[Finding]:
    """Lets two processes train the same run from the same moment on, again and again."""
    work_alone(prepare, root)
    work_alone(train_job, "closet", root, "whole")
    whole = weights_digest(folder_of("closet", root, "whole"))
    one = equal = 0
    for race in range(races):
        name, barrier = f"race-{race}", get_context("fork").Barrier(2)
        runners = [Victim(start_together, barrier, root, name) for _ in range(2)]
        ends = sorted((runner.end() for runner in runners), key=lambda end: end.code or 0)
        one += [end.code for end in ends] == [0, 2] and "another job is at work" in ends[1].error
        folder = folder_of("closet", root, name)
        equal += weights_digest(folder) == whole
        shutil.rmtree(folder)
    return [
        all_of("race", "races in which one job worked and the other was told who does", one, races),
        all_of("race", "weights as if there had been no race", equal, races),
    ]


def start_together(barrier: Barrier, root: Path, name: str) -> None:
    """Trains as soon as the other process is ready to."""
    barrier.wait(60)
    train_job("closet", root, name)
