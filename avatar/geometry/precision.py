"""Full precision for positions: bfloat16 keeps 8 bits of a number, so a place on a body is 1 to 4 mm off."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor


def widen(value: Any) -> Any:
    """A tensor of half precision in float32; anything else as it is."""
    return value.float() if getattr(value, "dtype", None) in (torch.bfloat16, torch.float16) else value


def full_precision(function: Callable[..., Any]) -> Callable[..., Any]:
    """Has a function with tensors among its positional arguments compute in float32 or wider under autocast, too.

    For layers that are linear in positions, of which a later difference or normalisation leaves little.
    """

    @wraps(function)
    def call(*inputs: Any, **options: Any) -> Any:
        device = next(value.device.type for value in inputs if isinstance(value, Tensor))
        with torch.autocast(device, enabled=False):
            return function(*map(widen, inputs), **options)

    return call
