"""Full precision for positions: bfloat16 keeps 8 bits of a number, so a place on a body is 1 to 4 mm off."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import torch
from torch import Tensor

Result = TypeVar("Result")


def widen(value: Any) -> Any:
    """A tensor of half precision in float32; anything else as it is."""
    return value.float() if getattr(value, "dtype", None) in (torch.bfloat16, torch.float16) else value


def full_precision(function: Callable[..., Result]) -> Callable[..., Result]:
    """Has a function with tensors among its positional arguments compute in float32 or wider under autocast, too.

    For layers that are linear in positions: a later difference or normalisation removes most of a position, and what
    is left of it must not be rounding.
    """

    @wraps(function)
    def call(*inputs: Any, **options: Any) -> Result:
        device = next(value.device.type for value in inputs if isinstance(value, Tensor))
        with torch.autocast(device, enabled=False):
            return function(*map(widen, inputs), **options)

    return call
