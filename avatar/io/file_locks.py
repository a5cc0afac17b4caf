"""Locks on open files, which the operating system frees when the process that holds them ends, however it does."""

from __future__ import annotations

import errno
import fcntl
from typing import IO

NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)  # Lustre and NFS mounts without locks


def lock_file(file: IO[bytes], wait: bool = True) -> bool:
    """Locks an open file for this process until it is closed; gives False where the file system has no locks.

    Raises:
        BlockingIOError: when another process holds it and ``wait`` is False.
        OSError: when the system refuses otherwise.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return False
    return True
