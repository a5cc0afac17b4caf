"""Worker processes: a pool of them, which the terminal's Ctrl-C does not reach and which ends with its parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Any


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Processes started within the ``with`` block never see SIGINT, which a terminal sends to all of its group.

    The mask of signals is inherited; in this process a SIGINT waits until the end of the block.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def in_workers(
    work: Callable[..., Any],
    jobs: Iterable[tuple[Any, ...]],
    workers: int,
    prepare: Callable[..., None] | None = None,
    arguments: tuple[Any, ...] = (),
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Jobs, which are arguments of ``work``, and their results as they are finished in worker processes.

    Each worker calls ``prepare(*arguments)`` first. Left early, it ends the workers at once.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _begin_work, (prepare, arguments)) as pool:
        try:
            with interrupts_blocked():
                futures = {pool.submit(work, *job): job for job in jobs}
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            for process in multiprocessing.active_children():
                process.terminate()
            pool.shutdown(cancel_futures=True)  # waits for its thread, whose pipes Python's exit writes to
            raise


def _begin_work(prepare: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    """Prepares a worker, which ends as soon as the process that started it is gone, however it went."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    if prepare is not None:
        prepare(*arguments)
