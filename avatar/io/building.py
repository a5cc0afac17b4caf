"""Networks built from what a file says of them, never larger than the weights that came with it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from avatar.checks import AvatarError
from avatar.io.checkpoints import restoring

FACTOR = 4  # times the numbers in a weights file: initialisation makes temporaries of a layer's size
SPARE = 1 << 22  # numbers beside them, 16 MiB: what a network draws, sorts and caches of its template
FACTORIES = {torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn, torch.eye}


class Budget(TorchFunctionMode):
    """Refuses to allocate a tensor larger than a number of elements, for as long as it is entered."""

    def __init__(self, elements: int):
        super().__init__()
        self.left = elements

    def __torch_function__(self, function: Any, types: Any, arguments: tuple = (), options: dict | None = None) -> Any:
        options = options or {}
        if function in FACTORIES:
            given = options.get("size", arguments[:1] if function is torch.full else arguments)
            sizes = [size for part in given for size in (part if isinstance(part, (tuple, list)) else [part])]
            asked = math.prod(int(size) for size in sizes if isinstance(size, int))
            self.left -= asked
            if self.left < 0:
                raise AvatarError(
                    f"settings: they ask for a network of {asked} numbers, the weights beside it have less."
                )
        return function(*arguments, **options)


@contextmanager
def building(path: Path, weights: Mapping[str, Tensor]) -> Iterator[None]:
    """Builds and fills a network within a ``with`` block; sizes that its file invents are refused unallocated.

    Raises:
        DataError: naming the file, when the settings ask for more than the weights hold, or the two do not fit.
    """
    with restoring(path), Budget(FACTOR * sum(value.numel() for value in weights.values()) + SPARE):
        yield
