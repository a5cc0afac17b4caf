"""Work cut into chunks that fit the memory there is: where it runs out the chunk is halved, nothing else changes."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable
from typing import TypeVar

import torch

from avatar.checks import AvatarError

Part = TypeVar("Part")
UNIT = 1024  # rows; chunks are multiples of it. Vector instructions and threads then part every chunk in the same way:
# where their last lanes fall decides the last bit of an exponential or a logarithm.
report = logging.getLogger(__name__)


def in_chunks(work: Callable[[slice], Part], count: int, size: int) -> list[Part]:
    """What a function gives for consecutive chunks of ``count`` rows, in order; at least one chunk, even of none.

    Chunks have ``size`` rows, half as many each time memory runs out. All are multiples of 1024 rows, but for what is
    left over, which comes last. For a function that treats every row by itself the joined result is then the same to
    the bit on a power of two threads of the CPU. Raises `AvatarError` when not even 1024 rows fit.
    """
    size, even = max(UNIT, size // UNIT * UNIT), count // UNIT * UNIT
    parts: list[Part] = []
    start = 0
    while start < count or not parts:
        chunk = slice(start, min(start + size, even) if start < even else count)
        try:
            parts.append(work(chunk))
        except (MemoryError, RuntimeError) as error:
            if not ran_out(error):
                raise
            refused = str(error)
        else:
            start = chunk.stop
            continue
        if size <= UNIT:  # outside of `except`, so that the failed attempt's tensors are gone
            raise AvatarError(f"memory: not even {size} rows at once fit ({refused:.200}). Free some, or ask for less.")
        size = max(UNIT, size // 2 // UNIT * UNIT)
        report.info("Memory ran out; going on with %d rows at once.", size)
        gc.collect()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
    return parts


def ran_out(error: BaseException) -> bool:
    """Whether an error says that there was no memory left, on the CPU or on a device."""
    words = ("can't allocate memory", "not enough memory", "out of memory")
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or any(word in str(error) for word in words)
