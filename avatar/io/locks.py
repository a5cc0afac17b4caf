"""One job a run folder: a lock that its holder's death frees, however it dies."""

from __future__ import annotations

import json
import logging
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from avatar.checks import AvatarError, DataError
from avatar.io.file_locks import lock_file

LOCK = "run.lock"
HELD: dict[Path, int] = {}  # folders this process has locked, and the thread that did
report = logging.getLogger(__name__)


@contextmanager
def lock_folder(folder: Path, wait: bool = False) -> Iterator[None]:
    """Holds a run's folder for the length of a ``with`` block; the thread that holds it may enter again.

    With ``wait`` a folder that another job holds is waited for, instead of refused.

    The operating system keeps the lock with the open file and lets go of it when the process ends, by ``kill -9``
    too, so there are no stale locks. The file says who holds it, for the message alone.

    Raises:
        AvatarError: when another job holds the folder, naming its process and machine.
        DataError: when the lock cannot be written.
    """
    place = folder.resolve()
    if HELD.get(place) == threading.get_ident():
        yield
        return
    with _open_lock(place) as file:
        _take(file, place, wait)
        HELD[place] = threading.get_ident()
        try:
            yield
        finally:
            del HELD[place]
            file.truncate(0)


def _open_lock(folder: Path) -> BinaryIO:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return (folder / LOCK).open("a+b", buffering=0)
    except OSError as error:
        raise DataError(folder / LOCK, f"could not be opened for writing ({error.strerror}).") from error


def _take(file: BinaryIO, folder: Path, wait: bool) -> None:
    """Locks an open file, or refuses, and writes down who holds it."""
    try:
        locked = lock_file(file, wait)
    except BlockingIOError:
        raise AvatarError(
            f"{folder}: another job is at work here ({_holder(file)}). "
            "Wait for it, stop it, or give this run another name (name=...)."
        ) from None
    if not locked:
        report.warning("%s: this file system has no locks; take care that one job alone works here.", folder)
        return
    try:
        file.truncate(0)
        file.write(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())
    except OSError as error:  # a full disk: the lock holds all the same
        report.warning("%s: could not note who holds this folder (%s).", folder / LOCK, error.strerror)


def _holder(file: BinaryIO) -> str:
    try:
        file.seek(0)
        facts = json.loads(file.read())
        return f"process {facts['pid']} on {facts['host']}"
    except (ValueError, KeyError, TypeError):
        return "it has not said which"
