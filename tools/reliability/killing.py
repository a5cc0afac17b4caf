"""`kill`: SIGKILL at random moments of training and inside saves; resumed trainings must end in the same bits."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from avatar.io.checkpoints import read_manifest
from avatar.training import trainer
from avatar.training.logs import read_log
from reliability.corruption import digest, load_quietly
from reliability.findings import Finding, all_of
from reliability.small_jobs import JOBS, SAVE_EVERY, STEPS, folder_of, prepare, train_job, weights_digest
from reliability.workers import Worker, call_in_process, run_worker, wait_until

DISK_CALLS = 6 * STEPS // SAVE_EVERY  # system calls of a training's saves: two files each, flush, rename, folder flush


def kill_trial(root: Path, kills: int, in_saves: int, seed: int) -> list[Finding]:
    """Kills small trainings of all four kinds, each once, and resumes them by the same command.

    Args:
        root: a folder to work in.
        kills: how often, in all.
        in_saves: how many of these between two system calls of a save; the others come at uniformly random moments of
            a training.
        seed: of the moments.
    """
    call_in_process(prepare, root)
    rng = random.Random(seed)
    expected, states, length = {}, {}, {}
    for job in JOBS:
        started = time.monotonic()
        call_in_process(train_job, job, root, "uninterrupted")
        length[job], expected[job] = time.monotonic() - started, weights_digest(folder_of(job, root, "uninterrupted"))
        states[job] = digest(load_quietly(folder_of(job, root, "uninterrupted") / "checkpoints"))
    killed = resumed = equal = same_state = saving = 0
    lost = 0
    for trial in range(kills):
        job, name = JOBS[trial % len(JOBS)], f"killed-{trial}"
        folder, inside = folder_of(job, root, name), trial * in_saves // kills != (trial + 1) * in_saves // kills
        while True:  # a moment after the end kills nothing: another is drawn
            if inside:
                worker = Worker(train_until_save, job, root, name, rng.randrange(DISK_CALLS))
            else:
                worker = Worker(train_job, job, root, name)
                wait_until(lambda done=folder: (done / "config.yaml").is_file(), 60)
                time.sleep(rng.uniform(0, length[job]))
                worker.kill()
            if worker.end().code == -signal.SIGKILL and not weights_digest(folder):
                break
            shutil.rmtree(folder)
        killed, saving = killed + 1, saving + inside
        lost = max(lost, steps_lost(folder))
        resumed += run_worker(train_job, job, root, name).code == 0
        equal += weights_digest(folder) == expected[job]
        same_state += digest(load_quietly(folder / "checkpoints")) == states[job]
        shutil.rmtree(folder)
    return [
        Finding("kill", "trainings killed by SIGKILL before their end", killed, f"of {kills}", kills, kills, kills),
        Finding("kill", "of these inside a save", saving, f"of {kills}", kills, in_saves, None),
        all_of("kill", "resumed to their end by the same command", resumed, kills),
        all_of("kill", "final weights equal to the uninterrupted run's, by sha256", equal, kills),
        all_of("kill", "last checkpoints equal to its, bit for bit: model, optimiser, random state", same_state, kills),
        Finding("kill", "most steps to repeat (saved every 4)", lost, "steps", kills, None, SAVE_EVERY),
    ]


def train_until_save(job: str, root: Path, name: str, place: int) -> None:
    """Trains until the ``place``-th system call of its saves, and is killed in place of it."""
    left, saving = iter(range(place + 1)), []

    def killing(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if saving and next(left, None) == place:
                os.kill(os.getpid(), signal.SIGKILL)
            return real(*arguments, **options)

        return call

    def watched(save: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            saving.append(True)
            try:
                return save(*arguments, **options)
            finally:
                saving.pop()

        return call

    os.fsync, Path.replace = killing(os.fsync), killing(Path.replace)
    trainer.save_checkpoint = watched(trainer.save_checkpoint)
    train_job(job, root, name)


def steps_lost(folder: Path) -> int:
    """Steps of a killed run, by its log, after its newest checkpoint."""
    log = folder / "metrics.csv"
    done = max((int(row["step"]) for row in read_log(log)), default=0) if log.is_file() else 0
    saved = read_manifest(folder / "checkpoints").get("last", [])
    return done - (saved[-1]["step"] if saved else 0)
