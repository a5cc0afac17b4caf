"""Stop signals: SIGINT, SIGTERM and SIGUSR1 are noted, and the work ends where its state can be saved."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from avatar.invocation import STOPPED

SIGNALS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)
DOUBLE_S = 0.1  # within which the same Ctrl-C may come twice: from the terminal and from a wrapper such as `timeout`


class Stopped(Exception):
    """The work was asked to stop and its state is saved. No `AvatarError`: nothing is wrong."""


@contextmanager
def listening(listener: Callable[[int, FrameType | None], Any], numbers: Iterable[int]) -> Iterator[dict[int, Any]]:
    """Has signals of the main thread handled by a function within a ``with`` block; gives the earlier handlers."""
    ours = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, listener) for number in numbers} if ours else {}
    try:
        yield before
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def answer_interrupt(number: int, answer: str) -> None:
    """After a Ctrl-C, answers it on the terminal and has the next one end the process at once."""
    if number == signal.SIGINT:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        os.write(2, f"\n{answer} Ctrl-C again leaves at once.\n".encode())  # print might be what was interrupted
        time.sleep(DOUBLE_S)
        signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def leave_when_asked(passed_on: Callable[[int], bool] = lambda number: False) -> Iterator[None]:
    """Leaves with exit code 75 when asked to stop, unless ``passed_on`` has passed the signal on to other processes.

    They get SIGTERM for a Ctrl-C, which their terminal may have sent them already: a second would end them at once.
    """

    def leave(number: int, frame: FrameType | None) -> None:
        if not passed_on(signal.SIGTERM if number == signal.SIGINT else number):
            sys.exit(STOPPED)
        answer_interrupt(number, "Stopping: the jobs save their state.")

    with listening(leave, SIGNALS):
        yield


class StopRequest:
    """A signal that asks to stop, noted and not obeyed until the state is saved: ``number``, or None.

    SIGUSR2 is noted too where somebody listens to it already (submitit does, to queue a job again).
    """

    def __init__(self):
        self.number: int | None = None
        self.earlier: dict[int, Any] = {}

    def note(self, number: int, frame: FrameType | None) -> None:
        """Keeps the first signal, so that a save is never cut short; only a second Ctrl-C ends the process at once."""
        self.number = self.number or number
        answer_interrupt(number, "Stopping: this step is finished and saved.")

    def leave(self, folder: Path) -> None:
        """Raises `Stopped` once the state is saved, unless who listened to SIGUSR2 before hears it now and leaves."""
        if self.number == signal.SIGUSR2:
            self.earlier[self.number](self.number, None)
        name = signal.Signals(self.number).name if self.number else "another process"
        raise Stopped(f"{folder}: stopped by {name}, everything is saved. The same command goes on from here.")


@contextmanager
def stop_requests() -> Iterator[StopRequest]:
    """Notes the signals that ask to stop, for the length of a ``with`` block."""
    request = StopRequest()
    others = (signal.SIGUSR2,) if callable(signal.getsignal(signal.SIGUSR2)) else ()
    with listening(request.note, (*SIGNALS, *others)) as request.earlier:
        yield request
