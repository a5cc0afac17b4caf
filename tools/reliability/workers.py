"""Worker processes that are killed or crash: forked, so that they need not import the program again."""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from avatar.checks import AvatarError

CRASH = 70  # exit code of a worker that ended with an untyped error


@dataclass(frozen=True)
class Outcome:
    """Outcome of a process.

    ``code`` is its exit code, negative for a signal and None after a timeout; ``value`` is what its function returned,
    ``error`` the message of an `AvatarError`, ``crash`` the traceback of any other exception.
    """

    code: int | None
    value: Any = None
    error: str = ""
    crash: str = ""


class Worker:
    """Forked process that calls one function; its output goes to a file or nowhere.

    Torch has one thread in it, because a forked process cannot use its parent's.
    """

    def __init__(self, function: Callable[..., Any], *arguments: Any, log: Path | None = None):
        self.near, far = get_context("fork").Pipe()
        self.process = get_context("fork").Process(target=_serve, args=(far, log, function, arguments), daemon=True)
        self.process.start()
        far.close()

    def kill(self) -> None:
        """Sends SIGKILL."""
        os.kill(self.process.pid, signal.SIGKILL)

    def end(self, timeout: float = 600.0) -> Outcome:
        """Waits for the process, kills it after the timeout, and returns its outcome."""
        answer: dict[str, Any] = {}
        in_time = self.near.poll(timeout)
        if in_time:
            with suppress(EOFError, OSError):  # it ended without an answer
                answer = json.loads(self.near.recv_bytes())
        else:
            self.kill()
        self.process.join()
        self.near.close()
        return Outcome(self.process.exitcode if in_time else None, **answer)


def _serve(far: Connection, log: Path | None, function: Callable[..., Any], arguments: tuple) -> None:
    """Worker's side: calls the function and sends the outcome as JSON."""
    with Path(log or os.devnull).open("a") as sink:
        os.dup2(sink.fileno(), 1)
        os.dup2(sink.fileno(), 2)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    try:
        answer = {"value": function(*arguments)}
    except AvatarError as error:
        answer = {"error": str(error)}
    except BaseException:
        answer = {"crash": traceback.format_exc()}
    far.send_bytes(json.dumps(answer, default=str).encode())
    os._exit(0 if "value" in answer else 2 if "error" in answer else CRASH)


def run_worker(function: Callable[..., Any], *arguments: Any, timeout: float = 600.0) -> Outcome:
    """Outcome of a function that is called in a worker process."""
    return Worker(function, *arguments).end(timeout)


def call_in_process(function: Callable[..., Any], *arguments: Any, timeout: float = 600.0) -> Any:
    """Value of a function that is called in a worker process, so that this one starts no threads and loads nothing.

    Raises:
        RuntimeError: when it fails, as the preparation of a trial must not.
    """
    outcome = run_worker(function, *arguments, timeout=timeout)
    if outcome.code:
        raise RuntimeError(outcome.crash or outcome.error or f"{function.__name__}: exit code {outcome.code}")
    return outcome.value


def peak_memory() -> int:
    """Peak resident memory of this process, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def resident_memory(pid: int) -> int:
    """Resident memory of a process now, bytes."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def wait_until(true: Callable[[], bool], seconds: float) -> bool:
    """Waits until a condition is true or the time is over; returns whether it is true."""
    ends = time.monotonic() + seconds
    while not true():
        if time.monotonic() > ends:
            return False
        time.sleep(0.001)
    return True
