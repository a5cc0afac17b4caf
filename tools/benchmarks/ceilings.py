"""How near the machine's measured ceilings the main job comes: products of matrices, and copies."""

from __future__ import annotations

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.avatars import step_races
from benchmarks.races import Figure, Job, take_turns, time_once


def ceiling_figures(job: Job, repeats: int) -> list[Figure]:
    """The ceilings, and for every training step its multiplications and its share of the first ceiling.

    Multiplications are torch's count of matrix products and convolutions, forward and back; what else a step does
    (normalisation, activations, neighbours) takes time and counts for nothing, so the share says how much of a step
    is multiplying.
    """
    side, length = job.size(2048, 64), job.size(1 << 26, 1 << 16)
    square, line = torch.rand(side, side, device=job.device), torch.rand(length, device=job.device)
    out = torch.empty_like(line)
    race = step_races(job)[0]
    products = {"matrix product": lambda: square @ square, "copy": lambda: out.copy_(line)}
    take_turns(products, 1)
    best = {name: min(job.cost(lap) for lap in laps) for name, laps in take_turns(products, repeats).items()}
    flops = {}
    for name, prepare in race.contenders.items():
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
            Figure("ceilings", race.case, name, "work", flops[name] / 1e9, "Gflop", race.points),
            Figure("ceilings", race.case, name, "share", flops[name] / best[name] / rate, "1", race.points),
        ]
    return figures
