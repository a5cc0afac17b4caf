"""The start of every verb: ``avatar train outfit=dress``, ``python -m avatar train``, ``python tools/train.py``.

The standard library alone until the verb is known, so that a missing package, a signal during imports, and a reader
that has left (``| head``) each end in one line or none, and not in a traceback.
"""

from __future__ import annotations

import contextlib
import difflib
import os
import select
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import NoReturn

from avatar.invocation import CORE, PIPE_CLOSED, STOPPED, activation_line, checkout, command_line, install_line
from avatar.verbs import VERBS, Verb, resolve

OLDEST = (3, 11)


def main() -> NoReturn:
    """The console command: its first argument is the verb."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in VERBS:
        del sys.argv[1]
        run(name)
    if name in ("-h", "--help"):
        lines = [f"  {verb:13} {entry.does}" for verb, entry in VERBS.items()]
        text, stream, code = "\n".join(["usage: avatar VERB [OPTION=VALUE ...]", "", *lines]), sys.stdout, 0
    else:
        near = difflib.get_close_matches(name, VERBS, n=1)
        hint = f"Did you mean {near[0]}? " if near else ""
        text, stream, code = f"avatar: no verb {name!r}. {hint}There are: {', '.join(VERBS)}.", sys.stderr, 2
    with contextlib.suppress(BrokenPipeError):
        print(text, file=stream, flush=True)
    silence_closed_streams()
    sys.exit(code)


def run(name: str, verb: Verb | None = None) -> NoReturn:
    """Runs a verb, given where it is not in `VERBS`, with the arguments of the command line; leaves with its exit code.

    The code is 0, 2 for bad input or a missing package, 75 after a signal, or 141 where the reader of its output has
    left; faults of the program end in a traceback.
    """
    for number in (signal.SIGINT, signal.SIGTERM):  # until the verb listens itself
        signal.signal(number, leave_at_once(name))
    code: int | str | None = 0
    try:
        try:
            start(name, verb or VERBS[name])
        except SystemExit as leaving:
            code = leaving.code
        sys.stdout.flush()
    except BrokenPipeError:
        if not silence_closed_streams():
            raise
        code = PIPE_CLOSED
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done
    sys.exit(code)


def leave_at_once(verb: str) -> Callable[[int, FrameType | None], NoReturn]:
    """What listens to signals while a verb is imported, amid which no exception may be raised."""

    def leave(number: int, frame: FrameType | None) -> NoReturn:
        os.write(2, f"{verb}: stopped by {signal.Signals(number).name} before it began.\n".encode())
        os._exit(STOPPED)

    return leave


def start(name: str, verb: Verb) -> None:
    """Imports what a verb needs and calls it."""
    try:
        if sys.version_info < OLDEST:
            version = ".".join(map(str, sys.version_info[:2]))
            sys.exit(refuse(name, f"expected Python 3.11 or newer, got {version}.{environment_hint()}"))
        if verb.settings:
            from avatar.config import command

            command(name, verb=verb)
        else:
            resolve(verb.run)()
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if package not in CORE:
            raise
        message = f"{package} cannot be imported ({error}). Run: {command_line('doctor')}"
        if isinstance(error, ModuleNotFoundError):
            hint = environment_hint() or f" Run: {install_line(package)}"
            message = f"{package} is not installed for {sys.executable}.{hint}"
        sys.exit(refuse(name, message))
    except ValueError as error:
        from avatar.checks import AvatarError

        if not isinstance(error, AvatarError):
            raise
        sys.exit(refuse(name, error))


def refuse(name: str, message: object) -> int:
    """Prints why a verb does not do what it was asked to; gives the exit code for it."""
    print(f"{name}: {message}", file=sys.stderr)
    return 2


def environment_hint() -> str:
    """The line that leads to the checkout's own environment; nothing in it, or where there is no checkout."""
    root = checkout()
    if root is None or ((root / ".venv").is_dir() and Path(sys.prefix).samefile(root / ".venv")):
        return ""
    return f" Run: {activation_line()}"


def silence_closed_streams() -> bool:
    """Turns streams whose reader has left to nowhere, so that the interpreter's last flush is quiet; were there any?"""
    found = False
    for stream in (sys.stdout, sys.stderr):
        poll = select.poll()
        poll.register(stream.fileno(), 0)  # errors and hang-ups are always reported
        if any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0)):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            found = True
    return found
