"""`disk`: training on a file system that fills up: the last good checkpoint stays, the rest is done later."""

from __future__ import annotations

import os
import random
import resource
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avatar.training import cycles, implicit_loop, loop
from reliability.corruption import digest, load_quietly
from reliability.findings import Finding, all_of
from reliability.small_jobs import JOBS, SAVE_EVERY, folder_of, prepare, train_job, weights_digest
from reliability.workers import run_victim, work_alone

DISK_BYTES = 64 << 20


def disk_trial(root: Path, points: int, seed: int) -> list[Finding]:
    """Fills the disk a little before the saves of miniature trainings, to another byte each time.

    The disk is a file system of its own in memory where this user may mount one; otherwise the kernel's limit on the
    size of a file stands in for it, and the findings say so.
    """
    rng = random.Random(seed)
    with small_disk(root / "disk") as mounted:
        place = root / "disk"
        work_alone(prepare, place)
        whole, sizes = {}, {}
        for job in JOBS:
            work_alone(train_job, job, place, "whole")
            whole[job] = weights_digest(folder_of(job, place, "whole"))
            sizes[job] = max(path.stat().st_size for path in folder_of(job, place, "whole").rglob("step-*.pt"))
        kept = told = equal = 0
        for point in range(points):
            job, name = JOBS[point % len(JOBS)], f"full-{point}"
            folder = folder_of(job, place, name)
            run_victim(train_to_step, job, place, name, 2 * SAVE_EVERY)
            before = digest(load_quietly(folder / "checkpoints"))
            room = rng.randrange(sizes[job])
            if mounted:
                fill(place, room)
                outcome = run_victim(train_job, job, place, name)
                (place / "ballast").unlink()
            else:
                outcome = run_victim(train_in_small_files, job, place, name, room)
            told += outcome.code == 2 and str(folder) in outcome.error and "Make room" in outcome.error
            kept += before is not None and digest(load_quietly(folder / "checkpoints")) == before
            run_victim(train_job, job, place, name)
            equal += weights_digest(folder) == whole[job]
            shutil.rmtree(folder)
    how = "full disks" if mounted else "full disks (by a limit on file sizes: no right to mount)"
    return [
        all_of("disk", f"{how} told with file and way out, exit code 2", told, points),
        all_of("disk", "last good checkpoints kept, to the bit", kept, points),
        all_of("disk", "finished later with the uninterrupted run's weights", equal, points),
    ]


@contextmanager
def small_disk(place: Path) -> Iterator[bool]:
    """Mounts a small file system for the length of a ``with`` block; gives whether that could be done."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    line = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "avatar-torture", str(place)]
    mounted = shutil.which("mount") is not None and subprocess.run(line, capture_output=True).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(place)], check=True)  # a victim may not be quite gone


def fill(place: Path, room: int) -> None:
    """Fills a disk but for so many bytes, rounded to its pages."""
    free = os.statvfs(place)
    with (place / "ballast").open("wb") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, max(1, free.f_bavail * free.f_frsize - room))


def train_to_step(job: str, root: Path, name: str, steps: int) -> None:
    """Trains with the budget of a whole run, and dies after the save at a step."""
    for module in (cycles, implicit_loop, loop):
        save = module.save_checkpoint

        def save_and_die(folder: Path, state: dict, step: int, *score: float, save=save) -> None:
            save(folder, state, step, *score)
            if step >= steps:
                os._exit(0)

        module.save_checkpoint = save_and_die
    train_job(job, root, name)


def train_in_small_files(job: str, root: Path, name: str, largest: int) -> None:
    """Trains while the kernel refuses to let any file grow beyond a size."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (max(largest, 1), resource.RLIM_INFINITY))
    train_job(job, root, name)
