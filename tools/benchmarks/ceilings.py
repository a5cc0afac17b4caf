"""Ceilings of the machine, measured by matrix products and copies, and the share of them that training reaches."""

from __future__ import annotations

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.avatars import step_comparisons
from benchmarks.comparisons import Figure, Job, time_interleaved, time_once


def ceiling_figures(job: Job, repeats: int) -> list[Figure]:
    """Ceilings, and for every training step its floating-point operations and its share of the first ceiling.

    Operations are torch's count for matrix products and convolutions, forward and backward; the other work of a step
    (normalisation, activations, neighbours) takes time and is not counted, so the share is that of multiplications.
    """
    side, length = job.size(2048, 64), job.size(1 << 26, 1 << 16)
    square, line = torch.rand(side, side, device=job.device), torch.rand(length, device=job.device)
    out = torch.empty_like(line)
    comparison = step_comparisons(job)[0]
    products = {"matrix product": lambda: square @ square, "copy": lambda: out.copy_(line)}
    time_interleaved(products, 1)
    best = {
        name: min(job.cost(timing) for timing in timings)
        for name, timings in time_interleaved(products, repeats).items()
    }
    flops = {}
    for name, prepare in comparison.candidates.items():
        run = prepare()
        with FlopCounterMode(display=False) as counter:
            run()
        flops[name], best[name] = counter.get_total_flops(), job.cost(time_once(run))
    rate = 2 * side**3 / best["matrix product"]
    moved = 2 * line.numel() * line.element_size() / best["copy"]
    figures = [
        Figure("ceilings", f"{side} x {side}", "matrix product", "rate", rate / 1e9, "Gflop/s"),
        Figure("ceilings", f"{length:,} numbers", "copy", "rate", moved / 1e9, "GB/s"),
    ]
    for name in flops:
        figures += [
            Figure("ceilings", comparison.case, name, "work", flops[name] / 1e9, "Gflop", comparison.points),
            Figure("ceilings", comparison.case, name, "share", flops[name] / best[name] / rate, "1", comparison.points),
        ]
    return figures
