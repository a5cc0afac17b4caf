"""Peak memory of a candidate, measured in a process of its own above its memory before the run."""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Callable
from pathlib import Path

import torch

from avatar.environment import keep_freed_memory
from avatar.processes import in_workers
from benchmarks.comparisons import Comparison, Job

STATUS = Path("/proc/self/status")


def peak_memory(build: Callable[[Job], list[Comparison]], job: Job, comparison: int, candidate: str) -> float | None:
    """Peak memory that one candidate's first run adds, MiB; None where the system does not report it.

    Device memory on CUDA, else resident memory of the process; that of its worker processes is not counted.

    Args:
        build: function of a module that makes the topic's comparisons in the new process.
        job: its argument.
        comparison: index among its comparisons.
        candidate: name of the candidate that runs.
    """
    if not STATUS.is_file():
        return None
    threads = torch.get_num_threads()
    ((_, peak),) = in_workers(_measure, [(build, job, comparison, candidate, threads)], workers=1)
    return peak


def _measure(
    build: Callable[[Job], list[Comparison]], job: Job, comparison: int, candidate: str, threads: int
) -> float:
    torch.set_num_threads(threads)
    keep_freed_memory()  # as every verb has it
    run = build(job)[comparison].candidates[candidate]()
    if job.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        run()
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # memory freed by the preparation would otherwise be reused, and not be counted
    Path(f"/proc/{os.getpid()}/clear_refs").write_text("5")  # the peak starts anew from what is resident now
    before = _kibibytes("VmRSS")
    run()
    return max(0, _kibibytes("VmHWM") - before) / 2**10


def _kibibytes(key: str) -> int:
    lines = (line.split() for line in STATUS.read_text().splitlines())
    return next(int(words[1]) for words in lines if words[0] == f"{key}:")
