"""`nan`: NaN and infinity injected into losses, gradients, scans and weights; none may reach the disk."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from avatar.checks import AvatarError
from avatar.io.checkpoints import named_tensors
from avatar.methods.canonicalizer import CanonicalizerTask
from avatar.methods.points import PointTask
from avatar.methods.scanimate import ImplicitTask
from avatar.training.trainer import Trainer
from reliability.findings import Finding, all_of, none_of
from reliability.small_jobs import JOBS, STEPS, folder_of, prepare, train_job, weights_digest
from reliability.validators import bits
from reliability.workers import call_in_process, run_worker

PLACES = ("loss", "gradient", "scan point", "weight")
TASKS = (PointTask, ImplicitTask, CanonicalizerTask)


def nan_trial(root: Path, injections: int, seed: int) -> list[Finding]:
    """Injects NaN or infinity into small trainings of all four kinds, in four places, at one step or from it on."""
    call_in_process(prepare, root)
    expected = {}
    for job in JOBS:
        call_in_process(train_job, job, root, "uninterrupted")
        expected[job] = weights_digest(folder_of(job, root, "uninterrupted"))
    rng = random.Random(seed)
    cases = list(product(JOBS, PLACES, (False, True)))  # the last: once, or from then on
    contained = ended = written = equal = stopped = 0
    for number in range(injections):
        job, place, once = cases[number % len(cases)]
        name, folder = f"nan-{number}", folder_of(job, root, f"nan-{number}")
        outcome = run_worker(train_with_nan, job, root, name, place, once, rng.randrange(2, STEPS - 12))
        injected, spread = (root / f"{name}.{what}" for what in ("injected", "spread"))
        contained += injected.exists() and not spread.exists()
        ended += outcome.code in (0, 2)
        written += not all_finite(folder)
        if outcome.code == 2:
            stopped += 1
            run_worker(train_job, job, root, name)
            equal += weights_digest(folder) == expected[job]
    return [
        all_of("nan", "injected steps that left all other weights unchanged", contained, injections),
        all_of("nan", "trainings that continued or ended with a typed error", ended, injections),
        none_of("nan", "runs with a NaN or infinity on disk", written, injections),
        all_of("nan", "of those that ended, resumed to the uninterrupted run's weights", equal, stopped),
    ]


def train_with_nan(job: str, root: Path, name: str, place: str, once: bool, step: int) -> None:
    """Trains with NaN or infinity injected in one place at a step, or from it on.

    Writes ``<root>/<name>.injected`` where a step's loss or gradients were not finite or it was refused, and
    ``<root>/<name>.spread`` where such a step changed a weight, a statistic or a moment.
    """
    state = {"step": -1, "trainer": None}

    def due() -> bool:
        return state["step"] == step or (not once and state["step"] > step)

    def watched(real: Callable[..., Any]) -> Callable[..., Any]:
        def train_step(trainer: Any, inputs: Any) -> Any:
            state.update(step=trainer.step, trainer=trainer)
            if place == "weight" and trainer.step == step:
                largest = max((p for p in trainer.model.parameters() if p.requires_grad), key=Tensor.numel)
                largest.data.view(-1)[0] = math.nan  # a small one, such as a frame's code, is in few batches
            if place == "scan point" and due():
                inputs = (inject_into_points(inputs[0]), *inputs[1:])
            before, refused = bits(state_of(trainer)) if due() else {}, False
            try:
                result = real(trainer, inputs)
                refused = not math.isfinite(float(result[-1]) + float(result[0].total.detach()))
            except AvatarError:  # as searches give for points that are not finite, or the trainer after many such steps
                refused = True
                raise
            finally:
                if before:
                    if refused:
                        (root / f"{name}.injected").touch()
                    after = bits(state_of(trainer))
                    if any(after.get(place, old) != old for place, old in before.items()):
                        (root / f"{name}.spread").touch()
            return result

        return train_step

    Trainer.train_step = watched(Trainer.train_step)
    inject_into_functions(place, due, state)
    train_job(job, root, name)


def state_of(trainer: Any) -> dict[str, Any]:
    """Weights and statistics of a trainer's network, and its optimiser's moments: all that a step changes."""
    return {"model": trainer.model.state_dict(), "moments": trainer.optimiser.state_dict()["state"]}


def inject_into_functions(place: str, due: Callable[[], bool], state: dict[str, Any]) -> None:
    """Injects NaN or infinity into what a training step computes: losses or gradients."""

    def loss_with_nan(real: Callable[..., Any]) -> Callable[..., Any]:
        def loss(*arguments: Any) -> Any:
            terms = real(*arguments)
            mutated = {key: value * math.nan for key, value in terms.weighted.items()}
            return replace(terms, weighted=mutated) if due() and torch.is_grad_enabled() else terms

        return loss

    if place == "loss":
        for task in TASKS:
            task.loss = loss_with_nan(task.loss)
    if place == "gradient":
        clip = nn.utils.clip_grad_norm_

        def clip_with_infinity(parameters: Any, *limits: Any) -> Tensor:
            parameters = list(parameters)
            if due():
                next(p.grad for p in parameters if p.grad is not None).view(-1)[0] = math.inf
            return clip(parameters, *limits)

        nn.utils.clip_grad_norm_ = clip_with_infinity


def inject_into_points(batch: Any) -> Any:
    """Batch whose first scan point is NaN."""
    name = "scan_points" if "scan_points" in {f.name for f in fields(batch)} else "points"
    points = getattr(batch, name).clone()
    points[0, 0] = math.nan
    return replace(batch, **{name: points})


def all_finite(folder: Path) -> bool:
    """Whether every tensor of a run on disk is finite, read by torch and safetensors alone."""
    tensors: list[Tensor] = []
    for path in folder.rglob("*.pt"):
        tensors += [value for _, value in named_tensors(torch.load(path, map_location="cpu", weights_only=True))]
    for path in folder.rglob("*.safetensors"):
        tensors += load_file(path).values()
    return all(bool(torch.isfinite(value).all()) for value in tensors if value.is_floating_point())
