"""`poison`: numbers that are none in losses, gradients, scans and weights; none may reach the disk."""

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

from avatar.training import cycles, implicit_loop, loop
from avatar.training.checkpoints import named_tensors
from reliability.findings import Finding, all_of, none_of
from reliability.small_jobs import JOBS, STEPS, folder_of, prepare, train_job, weights_digest
from reliability.validators import bits
from reliability.workers import run_victim, work_alone

PLACES = ("loss", "gradient", "scan point", "weight")
TRAINERS = (loop.Trainer, implicit_loop.ImplicitTrainer, cycles.CycleTrainer)
LOSSES = (
    (loop, "point_avatar_loss"),
    (implicit_loop, "implicit_loss"),
    (cycles, "canonicalization_loss"),
)


def poison_trial(root: Path, poisons: int, seed: int) -> list[Finding]:
    """Poisons miniature trainings of all four kinds, in four places, at one step or from there on."""
    work_alone(prepare, root)
    whole = {}
    for job in JOBS:
        work_alone(train_job, job, root, "whole")
        whole[job] = weights_digest(folder_of(job, root, "whole"))
    rng = random.Random(seed)
    cases = list(product(JOBS, PLACES, (False, True)))  # the last: once, or from then on
    caught = ended = written = equal = lasting = 0
    for number in range(poisons):
        job, place, once = cases[number % len(cases)]
        name, folder = f"poisoned-{number}", folder_of(job, root, f"poisoned-{number}")
        outcome = run_victim(train_poisoned, job, root, name, place, once, rng.randrange(2, STEPS - 12))
        given, spread = (root / f"{name}.{what}" for what in ("given", "spread"))
        caught += given.exists() and not spread.exists()
        ended += outcome.code in (0, 2)
        written += not all_finite(folder)
        if outcome.code == 2:
            lasting += 1
            run_victim(train_job, job, root, name)
            equal += weights_digest(folder) == whole[job]
    return [
        all_of("poison", "poisoned steps that left all other weights as they were", caught, poisons),
        all_of("poison", "trainings that went on or ended with a named error", ended, poisons),
        none_of("poison", "runs with a number on disk that is none", written, poisons),
        all_of("poison", "of those that ended, finished from the last checkpoint as if unpoisoned", equal, lasting),
    ]


def train_poisoned(job: str, root: Path, name: str, place: str, once: bool, step: int) -> None:
    """Trains with poison in one place at a step, or from it on.

    Leaves ``<root>/<name>.given`` where a step was poisoned: its loss or gradients were not finite; and
    ``<root>/<name>.spread`` where such a step changed a weight, a statistic or a moment.
    """
    state = {"step": -1, "trainer": None}

    def due() -> bool:
        return state["step"] == step or (not once and state["step"] > step)

    def watched(real: Callable[..., Any]) -> Callable[..., Any]:
        def train_step(trainer: Any, *batch: Any) -> Any:
            state.update(step=trainer.step, trainer=trainer)
            if place == "weight" and trainer.step == step:
                largest = max((p for p in trainer.model.parameters() if p.requires_grad), key=Tensor.numel)
                largest.data.view(-1)[0] = math.nan  # a small one, such as a frame's code, is in few batches
            if place == "scan point" and due() and batch:
                batch = (poison_points(batch[0]),)
            before = bits(held_by(trainer)) if due() else {}
            result = real(trainer, *batch)
            if before:
                if not math.isfinite(float(result[-1]) + float(result[0].total.detach())):
                    (root / f"{name}.given").touch()
                after = bits(held_by(trainer))
                if any(after.get(place, old) != old for place, old in before.items()):
                    (root / f"{name}.spread").touch()
            return result

        return train_step

    for kind in TRAINERS:
        kind.train_step = watched(kind.train_step)
    poison_functions(place, due, state)
    train_job(job, root, name)


def held_by(trainer: Any) -> dict[str, Any]:
    """What a step may change: weights and statistics of a trainer's network, and its optimiser's moments."""
    return {"model": trainer.model.state_dict(), "moments": trainer.optimiser.state_dict()["state"]}


def poison_functions(place: str, due: Callable[[], bool], state: dict[str, Any]) -> None:
    """Puts poison into what training calls: the losses, the gradients, or the batches that a trainer draws itself."""

    def poisoned_loss(real: Callable[..., Any]) -> Callable[..., Any]:
        def loss(*arguments: Any) -> Any:
            terms = real(*arguments)
            spoilt = {key: value * math.nan for key, value in terms.weighted.items()}
            return replace(terms, weighted=spoilt) if due() and torch.is_grad_enabled() else terms

        return loss

    if place == "loss":
        for module, name in LOSSES:
            setattr(module, name, poisoned_loss(getattr(module, name)))
    if place == "gradient":
        clip = nn.utils.clip_grad_norm_

        def poisoned_clip(parameters: Any, *limits: Any) -> Tensor:
            parameters = list(parameters)
            if due():
                next(p.grad for p in parameters if p.grad is not None).view(-1)[0] = math.inf
            return clip(parameters, *limits)

        nn.utils.clip_grad_norm_ = poisoned_clip
    if place == "scan point":
        draw = cycles.CycleTrainer.batch_at
        cycles.CycleTrainer.batch_at = lambda trainer, step: (
            poison_points(draw(trainer, step)) if due() else draw(trainer, step)
        )


def poison_points(batch: Any) -> Any:
    """A batch whose first scan point has no place."""
    name = "scan_points" if "scan_points" in {f.name for f in fields(batch)} else "points"
    points = getattr(batch, name).clone()
    points[0, 0] = math.nan
    return replace(batch, **{name: points})


def all_finite(folder: Path) -> bool:
    """Whether every tensor a run has on disk is finite, as torch and safetensors alone read them."""
    tensors: list[Tensor] = []
    for path in folder.rglob("*.pt"):
        tensors += [value for _, value in named_tensors(torch.load(path, map_location="cpu", weights_only=True))]
    for path in folder.rglob("*.safetensors"):
        tensors += load_file(path).values()
    return all(bool(torch.isfinite(value).all()) for value in tensors if value.is_floating_point())
