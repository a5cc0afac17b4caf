"""`disk`: training on a full file system: the last valid checkpoint is kept, and training resumes later."""

from __future__ import annotations

import os
import random
import resource
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avatar.training import trainer
from reliability.corruption import digest, load_quietly
from reliability.findings import Finding, all_of
from reliability.small_jobs import JOBS, SAVE_EVERY, folder_of, prepare, train_job, weights_digest
from reliability.workers import call_in_process, run_worker

DISK_BYTES = 64 << 20


def disk_trial(root: Path, points: int, seed: int) -> list[Finding]:
    """Fills the file system before the saves of small trainings, leaving another number of bytes each time.

    The file system is a tmpfs where this user may mount one; otherwise the kernel's limit on the size of a file
    (RLIMIT_FSIZE) replaces it, and the findings say so.
    """
    rng = random.Random(seed)
    with small_disk(root / "disk") as mounted:
        place = root / "disk"
        call_in_process(prepare, place)
        expected, sizes = {}, {}
        for job in JOBS:
            call_in_process(train_job, job, place, "uninterrupted")
            expected[job] = weights_digest(folder_of(job, place, "uninterrupted"))
            sizes[job] = max(path.stat().st_size for path in folder_of(job, place, "uninterrupted").rglob("step-*.pt"))
        kept = reported = equal = 0
        for point in range(points):
            job, name = JOBS[point % len(JOBS)], f"full-{point}"
            folder = folder_of(job, place, name)
            run_worker(train_to_step, job, place, name, 2 * SAVE_EVERY)
            before = digest(load_quietly(folder / "checkpoints"))
            free = rng.randrange(sizes[job])
            if mounted:
                fill(place, free)
                outcome = run_worker(train_job, job, place, name)
                (place / "filler").unlink()
            else:
                outcome = run_worker(train_in_small_files, job, place, name, free)
            reported += outcome.code == 2 and str(folder) in outcome.error and "Free disk space" in outcome.error
            kept += before is not None and digest(load_quietly(folder / "checkpoints")) == before
            run_worker(train_job, job, place, name)
            equal += weights_digest(folder) == expected[job]
            shutil.rmtree(folder)
    how = "full disks" if mounted else "full disks (by a limit on file sizes: no right to mount)"
    return [
        all_of("disk", f"{how} reported with file and hint, exit code 2", reported, points),
        all_of("disk", "last valid checkpoints kept, bit for bit", kept, points),
        all_of("disk", "resumed to the uninterrupted run's weights", equal, points),
    ]


@contextmanager
def small_disk(place: Path) -> Iterator[bool]:
    """Mount of a small file system for a ``with`` block; gives whether mounting was possible."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    line = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "avatar-reliability", str(place)]
    mounted = shutil.which("mount") is not None and subprocess.run(line, capture_output=True).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(place)], check=True)  # a worker may still be ending


def fill(place: Path, left: int) -> None:
    """Fills a file system except for so many bytes, rounded to its pages."""
    free = os.statvfs(place)
    with (place / "filler").open("wb") as filler:
        os.posix_fallocate(filler.fileno(), 0, max(1, free.f_bavail * free.f_frsize - left))


def train_to_step(job: str, root: Path, name: str, steps: int) -> None:
    """Trains with the budget of a complete run, and exits after the save at a step."""
    save = trainer.save_checkpoint

    def save_and_exit(folder: Path, state: dict, step: int, *score: float) -> None:
        save(folder, state, step, *score)
        if step >= steps:
            os._exit(0)

    trainer.save_checkpoint = save_and_exit
    train_job(job, root, name)


def train_in_small_files(job: str, root: Path, name: str, largest: int) -> None:
    """Trains under a kernel limit on the size of every file."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (max(largest, 1), resource.RLIM_INFINITY))
    train_job(job, root, name)
