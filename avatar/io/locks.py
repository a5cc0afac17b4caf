"""One job a run folder: a lock on an open file, which the operating system frees when its holder ends, however."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from avatar.checks import AvatarError, DataError

LOCK = "run.lock"
HELD: dict[Path, int] = {}  # folders this process has locked, and the thread that did
NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)  # Lustre and NFS mounts without locks
report = logging.getLogger(__name__)


def lock_file(file: IO[bytes], wait: bool = True) -> bool:
    """Locks an open file for this process until it is closed; gives False where the file system has no locks.

    Raises `BlockingIOError` when another process holds it and ``wait`` is False, `OSError` for any other refusal.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return False
    return True


@contextmanager
def lock_folder(folder: Path, wait: bool = False) -> Iterator[None]:
    """Holds a run's folder for the length of a ``with`` block; the thread that holds it may enter again.

    The system lets go of it after ``kill -9``, too; the file says who holds it, for the message alone. Raises
    `AvatarError` naming the job that holds it unless it is to ``wait``; `DataError` when the lock cannot be written.
    """
    place = folder.resolve()
    if HELD.get(place) == threading.get_ident():
        yield
        return
    try:
        place.mkdir(parents=True, exist_ok=True)
        file = (place / LOCK).open("a+b", buffering=0)
    except OSError as error:
        raise DataError(place / LOCK, f"could not be opened for writing ({error.strerror}).") from error
    with file:
        try:
            locked = lock_file(file, wait)
        except BlockingIOError:
            raise AvatarError(
                f"{place}: another job is at work here ({_holder(file)}). "
                "Wait for it, stop it, or give this run another name (name=...)."
            ) from None
        try:
            if locked:
                file.truncate(0)
                file.write(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())
            else:
                report.warning("%s: this file system has no locks; take care that one job alone works here.", place)
        except OSError as error:  # a full disk: the lock holds all the same
            report.warning("%s: could not note who holds this folder (%s).", place / LOCK, error.strerror)
        HELD[place] = threading.get_ident()
        try:
            yield
        finally:
            del HELD[place]
            file.truncate(0)


def _holder(file: IO[bytes]) -> str:
    try:
        file.seek(0)
        facts = json.loads(file.read())
        return f"process {facts['pid']} on {facts['host']}"
    except (ValueError, KeyError, TypeError):
        return "it has not said which"
