"""Sequences that stay on the disk: items are read when they are asked for, and kept while they fit into memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

MAX_BYTES = 1 << 30  # bytes of one sequence's items kept in memory: with torch and a network's work below 2 GiB
Item = TypeVar("Item")


class LruSequence(Sequence[Item]):
    """A sequence of any length in bounded memory; the least recently used items leave first.

    What an item is must follow from its index alone, for it may be read again.
    """

    def __init__(self, read: Callable[[int], Item], count: int, max_bytes: int = MAX_BYTES):
        """Prepares a sequence of ``count`` items; none is read yet.

        Args:
            read: gives an item, a dataclass of arrays or tensors, by its index.
            count: how many there are.
            max_bytes: bytes that items may be kept in.
        """
        self.read, self.count, self.left = read, count, max(max_bytes, 0)
        self.kept: OrderedDict[int, Item] = OrderedDict()

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Item:
        if not 0 <= index < self.count:
            raise IndexError(f"index: expected 0 to {self.count - 1}, got {index}.")
        if index in self.kept:
            self.kept.move_to_end(index)
            return self.kept[index]
        item = self.read(index)
        self.kept[index] = item
        self.left -= bytes_of(item)
        while self.left < 0:
            _, leaving = self.kept.popitem(last=False)
            self.left += bytes_of(leaving)
        return item


def bytes_of(value: Any) -> int:
    """Memory that the arrays and tensors of a dataclass, or of dataclasses within it, take."""
    if is_dataclass(value):
        return sum(bytes_of(getattr(value, part.name)) for part in fields(value))
    return getattr(value, "nbytes", 0)
