"""Processes to be killed, crashed and starved: real ones, forked, so that they need not import all anew."""

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

CRASH = 70  # exit code of a victim that an untyped error ended


@dataclass(frozen=True)
class Outcome:
    """How a process ended.

    ``code`` is its exit code, negative for a signal and None where it had to be killed for taking too long; ``value``
    what it gave back, ``error`` the message of an `AvatarError`, ``crash`` the traceback of any other exception.
    """

    code: int | None
    value: Any = None
    error: str = ""
    crash: str = ""


class Victim:
    """A forked process that calls one function; what it prints goes to a file or nowhere.

    Torch works on one thread in it, for a forked process may not use its parent's.
    """

    def __init__(self, function: Callable[..., Any], *arguments: Any, log: Path | None = None):
        self.near, far = get_context("fork").Pipe()
        self.process = get_context("fork").Process(target=_serve, args=(far, log, function, arguments), daemon=True)
        self.process.start()
        far.close()

    def kill(self) -> None:
        """``kill -9``."""
        os.kill(self.process.pid, signal.SIGKILL)

    def end(self, timeout: float = 600.0) -> Outcome:
        """Waits for the process, kills it when it takes longer, and says how it ended."""
        answer: dict[str, Any] = {}
        in_time = self.near.poll(timeout)
        if in_time:
            with suppress(EOFError, OSError):  # it died without a word
                answer = json.loads(self.near.recv_bytes())
        else:
            self.kill()
        self.process.join()
        self.near.close()
        return Outcome(self.process.exitcode if in_time else None, **answer)


def _serve(far: Connection, log: Path | None, function: Callable[..., Any], arguments: tuple) -> None:
    """The victim's side: calls the function and sends what came of it, in JSON."""
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


def run_victim(function: Callable[..., Any], *arguments: Any, timeout: float = 600.0) -> Outcome:
    """Calls a function in a process of its own."""
    return Victim(function, *arguments).end(timeout)


def work_alone(function: Callable[..., Any], *arguments: Any, timeout: float = 600.0) -> Any:
    """What a function gives in a process of its own, so that this one stays free of threads and of what it loads.

    Raises:
        RuntimeError: when it fails: a trial's own work must not.
    """
    outcome = run_victim(function, *arguments, timeout=timeout)
    if outcome.code:
        raise RuntimeError(outcome.crash or outcome.error or f"{function.__name__}: exit code {outcome.code}")
    return outcome.value


def peak_memory() -> int:
    """The most memory this process has had resident, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def resident_memory(pid: int) -> int:
    """Memory that a process has resident now, bytes."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def wait_until(true: Callable[[], bool], seconds: float) -> bool:
    """Waits for something to become true, for so long at most; says whether it did."""
    ends = time.monotonic() + seconds
    while not true():
        if time.monotonic() > ends:
            return False
        time.sleep(0.001)
    return True
