"""Inputs of training steps prepared ahead, so that a device does not wait for the disk and the processor."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Self

import torch
from torch import Tensor

from avatar.records import map_tensors

Records = tuple[Any, ...]  # dataclasses of tensors


class Feed:
    """The inputs of training steps on a device: while a step trains there, a thread prepares those of the next one.

    They are the same as without it, for they follow from the step alone. Used as a ``with`` block, at whose end nothing
    goes on in the background. For CUDA they are copied from pinned memory, beside the work of the step before. On the
    CPU they are prepared on request: a thread with work of its own would have OpenMP threads of its own, and OpenMP
    then lets all of them sleep at once (docs/performance.md).
    """

    def __init__(self, make: Callable[[int], Records], steps: int, device: torch.device):
        """Prepares nothing yet; ``make`` gives the inputs of a step, by one call at a time, at most one step ahead."""
        self.make, self.steps, self.device = make, steps, device
        self.pinned = device.type == "cuda"
        options = {"initializer": torch.cuda.set_device, "initargs": (device,)} if self.pinned else {}
        self.thread = ThreadPoolExecutor(1, "feed", **options) if device.type != "cpu" else None
        self.ahead: dict[int, Future[Records]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self.thread:
            self.thread.shutdown(cancel_futures=True)

    def __call__(self, step: int) -> Records:
        """The inputs of a step, on the device. What `make` raises for a step is raised here, at that step."""
        if not self.thread:
            return to_device(self.make(step), self.device)
        ready = self.ahead.pop(step, None) or self.thread.submit(self._prepare, step)
        records = ready.result()
        self.ahead = {step + 1: self.thread.submit(self._prepare, step + 1)} if step + 1 < self.steps else {}
        return to_device(records, self.device)

    def _prepare(self, step: int) -> Records:
        records = self.make(step)
        return tuple(map_tensors(record, pin) for record in records) if self.pinned else records


def pin(tensor: Tensor) -> Tensor:
    """A CPU tensor in page-locked memory; others as they are."""
    return tensor.pin_memory() if tensor.device.type == "cpu" else tensor


def to_device(records: Records, device: torch.device) -> Records:
    """Records with their tensors on a device; from pinned memory without waiting for the copy."""
    return tuple(map_tensors(record, lambda tensor: tensor.to(device, non_blocking=True)) for record in records)
