"""Peak memory of a contender: measured in a process of its own, above what stood there before it ran."""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Callable
from pathlib import Path

import torch

from avatar.environment import keep_freed_memory
from avatar.processes import in_workers
from benchmarks.races import Job, Race

STATUS = Path("/proc/self/status")


def peak_memory(build: Callable[[Job], list[Race]], job: Job, race: int, contender: str) -> float | None:
    """MiB that one contender's first run adds at its peak; None where the system does not tell.

    On CUDA of the device's memory, else of the process's resident memory; what its workers take is not counted.

    Args:
        build: what makes the topic's races; a function of a module, for it runs in the new process.
        job: what it is told.
        race: which of its races.
        contender: who runs.
    """
    if not STATUS.is_file():
        return None
    threads = torch.get_num_threads()
    ((_, peak),) = in_workers(_measure, [(build, job, race, contender, threads)], workers=1)
    return peak


def _measure(build: Callable[[Job], list[Race]], job: Job, race: int, contender: str, threads: int) -> float:
    torch.set_num_threads(threads)
    keep_freed_memory()  # as every verb has it
    run = build(job)[race].contenders[contender]()
    if job.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        run()
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what preparing has freed would else be used again, and not be seen
    Path(f"/proc/{os.getpid()}/clear_refs").write_text("5")  # the peak starts anew from what is resident now
    before = _kibibytes("VmRSS")
    run()
    return max(0, _kibibytes("VmHWM") - before) / 2**10


def _kibibytes(key: str) -> int:
    lines = (line.split() for line in STATUS.read_text().splitlines())
    return next(int(words[1]) for words in lines if words[0] == f"{key}:")
