"""One training loop for all point avatars: stateless data order, named losses, validation, resumable checkpoints."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError
from avatar.nn.methods import draw_samples
from avatar.progress import Progress
from avatar.records import Batch, LossTerms, SurfaceSamples
from avatar.training.checkpoints import load_checkpoint, restoring, save_checkpoint
from avatar.training.distributed import (
    average,
    current_team,
    from_lead,
    gather,
    gradients_of,
    share_norms,
    step_outfits,
)
from avatar.training.feeding import Feed
from avatar.training.locks import lock_folder
from avatar.training.logs import TrainingLog
from avatar.training.losses import TERMS, LossConfig, point_avatar_loss
from avatar.training.signals import StopRequest, stop_requests

MAX_BAD_STEPS = 10
report = logging.getLogger(__name__)


class Schedule(Enum):
    """How the learning rate moves over training."""

    constant = "constant"  # POP
    cosine = "cosine"  # falls to a hundredth


class Precision(Enum):
    """Arithmetic of the network's forward pass; positions, distances and losses are always float32."""

    fp32 = "fp32"
    bf16 = "bf16"


@dataclass
class TrainConfig:
    """Budget, optimiser and bookkeeping of one training run."""

    steps: int = 20000  # optimiser steps; the schedule's end unless minutes says otherwise
    minutes: float | None = None  # wall-clock budget; training ends at whichever comes first
    batch: int = 4  # frames a step
    points: int = 50000  # template points predicted for each frame
    fresh_points: bool = False  # draw new template points every step, instead of one fixed set
    mirror: bool = False  # show half of the frames mirrored: for symmetric clothes, twice the poses
    scan_points: int = 40000  # scan points a frame, drawn anew every epoch from those there are
    lr: float = 3e-4  # networks
    code_lr: float = 5e-4  # garment codes
    schedule: Schedule = Schedule.constant
    warmup: int = 0  # steps over which the learning rate rises from zero
    clip: float | None = None  # largest gradient norm
    precision: Precision = Precision.fp32
    validate_every: int = 500  # steps
    save_every: int = 500  # steps
    log_every: int = 20  # steps
    seed: int = 0
    loss: LossConfig = field(default_factory=LossConfig)

    def __post_init__(self):
        for name in ("steps", "batch", "points", "scan_points", "validate_every", "save_every", "log_every"):
            if getattr(self, name) < 1:
                raise AvatarError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        if self.lr <= 0 or self.code_lr <= 0 or self.warmup < 0:
            raise AvatarError("lr, code_lr: expected above 0; warmup: at least 0.")
        if (self.minutes is not None and self.minutes <= 0) or (self.clip is not None and self.clip <= 0):
            raise AvatarError(f"minutes, clip: expected above 0 or null, got {self.minutes} and {self.clip}.")


class Trainer:
    """Trains one point avatar in one run folder; running it again goes on where it stopped."""

    def __init__(self, model: nn.Module, vertices: Tensor, faces: Tensor, config: TrainConfig, folder: Path):
        """Prepares training of a network on a template; under torchrun, as one of a team.

        Args:
            model: a network called as ``model(batch, samples) -> Prediction``, with its garment codes in ``codes``.
            vertices: ``(V, 3)`` template; faces: ``(F, 3)``: where template points are drawn.
            config: budget and optimiser.
            folder: the run's folder; ``metrics.csv`` and ``checkpoints/`` go there.
        """
        self.model, self.config, self.folder = model, config, folder
        self.surface = (vertices, faces)
        self.device = next(model.parameters()).device
        self.team = current_team()
        if self.team.size > 1:
            share_norms(model)
        kept = model.state_dict().keys()
        self.statistics = [buffer for name, buffer in model.named_buffers() if name in kept]
        codes = [parameter for name, parameter in model.named_parameters() if name == "codes"]
        others = [parameter for name, parameter in model.named_parameters() if name != "codes"]
        groups = [{"params": others, "lr": config.lr}, {"params": codes, "lr": config.code_lr}]
        self.optimiser = torch.optim.Adam(groups, fused=True)
        self.base_rates = [config.lr, config.code_lr]
        self.step, self.seconds, self.bad_steps = 0, 0.0, 0

    def fit(
        self, batch_at: Callable[[int], Batch], epoch_length: int, validation: Callable[[], Iterable[Batch]]
    ) -> None:
        """Trains until the budget is spent; holds the lock of the run's folder while it does.

        Args:
            batch_at: the batch of a step (in a team: this process's share of it); depends on nothing but the step,
                so that a resumed run sees the same data.
            epoch_length: steps an epoch.
            validation: the held-back batches, deterministic, the same in every process.

        Raises:
            AvatarError: when losses or gradients stay non-finite, or another job holds the folder.
            Stopped: after SIGTERM or SIGUSR1, with everything saved.
        """
        with lock_folder(self.folder) if self.team.leads else nullcontext(), stop_requests() as stop:
            self.resume()
            columns = ["loss", "chamfer", *TERMS, "lr", "grad_norm"]
            log = TrainingLog(self.folder, columns, self.step) if self.team.leads else None
            try:
                self.run(batch_at, epoch_length, validation, log, stop)
            finally:
                if log:
                    log.close()

    def run(
        self,
        batch_at: Callable[[int], Batch],
        epoch_length: int,
        validation: Callable[[], Iterable[Batch]],
        log: TrainingLog | None,
        stop: StopRequest,
    ) -> None:
        """The steps from here to the end of the budget, with what is logged, validated and saved between them."""
        started, config = time.monotonic() - self.seconds, self.config
        budget = 60 * config.minutes if config.minutes else None
        feed = Feed(lambda step: (batch_at(step), self.samples_at(step)), config.steps, self.device)
        bar = Progress("train", config.steps, "step", self.step, budget, self.seconds, silent=log is None)
        with feed, bar:
            while self.progress() < 1:
                terms, rate, norm = self.train_step(*feed(self.step))
                self.step += 1
                stopping = self.tell_time(time.monotonic() - started, stop)
                bar.advance()
                done = self.progress() >= 1
                epoch, score = self.step // epoch_length, None
                if self.step % config.log_every == 0 or done:
                    values = self.team_mean(log_values(terms)) | {"lr": rate, "grad_norm": float(norm)}
                    bar.show(loss=f"{values['loss']:.3f}", chamfer=f"{values['chamfer'] * 1e4:.3f}e-4")
                    if log:
                        log.write("train", self.step, epoch, self.seconds, values)
                if self.step % config.validate_every == 0 or done:
                    values = self.validate(validation())
                    score = values.get("chamfer")
                    if log and values:
                        log.write("validation", self.step, epoch, self.seconds, values)
                if (
                    ((self.step % config.save_every == 0 or score is not None) and not self.bad_steps)
                    or done
                    or stopping
                ):
                    self.save(score)
                if stopping and not done:
                    stop.leave(self.folder)

    def tell_time(self, seconds: float, stop: StopRequest) -> bool:
        """Sets the clock, one for the whole team, and says whether anyone in it was asked to stop."""
        told = torch.tensor([seconds, float(stop.number is not None)], dtype=torch.float64)
        average([told], self.team)
        self.seconds = float(told[0])
        return bool(told[1] > 0)

    def team_mean(self, values: dict[str, float]) -> dict[str, float]:
        """The mean of named values over the team."""
        told = gather(values, self.team)
        return {name: sum(each[name] for each in told) / len(told) for name in values}

    def progress(self) -> float:
        """Share of the budget that is spent, by steps or by the clock, whichever is further."""
        clock = self.seconds / (60 * self.config.minutes) if self.config.minutes else 0.0
        return max(self.step / self.config.steps, clock)

    def samples_at(self, step: int) -> SurfaceSamples:
        """The template points of a step: one fixed set, or a fresh one every step; those of step -1 are the fixed."""
        return self.draw_points(step + 1) if self.config.fresh_points and step >= 0 else self.fixed_points

    @cached_property
    def fixed_points(self) -> SurfaceSamples:
        """The template points that stay the same, on the device."""
        return self.draw_points(0).to(self.device)

    def draw_points(self, key: int) -> SurfaceSamples:
        """The template points that a key draws."""
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + key)
        return draw_samples(self.model, *self.surface, self.config.points, generator)

    def train_step(self, batch: Batch, samples: SurfaceSamples) -> tuple[LossTerms, float, Tensor]:
        """One optimiser step on inputs that are on the device; gives loss terms, learning rate and gradient norm.

        A step whose loss or gradients are not finite leaves weights, moments and running statistics as they were.
        """
        self.model.train()
        factor = self.rate_factor()
        for group, base in zip(self.optimiser.param_groups, self.base_rates):
            group["lr"] = base * factor
        before = [statistic.clone() for statistic in self.statistics]
        if self.team.size > 1 and hasattr(self.model, "codes"):
            batch = replace(batch, step_outfits=step_outfits(batch.outfit_ids, len(self.model.codes), self.team))
        terms = self.losses(batch, samples, self.progress())
        self.optimiser.zero_grad(set_to_none=True)
        terms.total.backward()
        total = terms.total.detach().clone()
        if self.team.size > 1:
            average([*gradients_of(self.model, self.team), total], self.team)
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip or math.inf)
        if bool(torch.isfinite(norm + total)):
            self.optimiser.step()
            self.bad_steps = 0
            return terms, self.base_rates[0] * factor, norm
        for statistic, value in zip(self.statistics, before):
            statistic.copy_(value)
        self.bad_steps += 1
        if self.bad_steps > MAX_BAD_STEPS:
            raise AvatarError(
                f"loss: not finite for {self.bad_steps} steps in a row (step {self.step}, frames "
                f"{', '.join(batch.names)}). Lower lr or check these frames; the last checkpoint is sound."
            )
        return terms, self.base_rates[0] * factor, norm

    def losses(self, batch: Batch, samples: SurfaceSamples, progress: float) -> LossTerms:
        """Prediction in the configured precision, then the losses in float32."""
        narrow = self.config.precision is Precision.bf16
        with torch.autocast(self.device.type, torch.bfloat16) if narrow else nullcontext():
            prediction = self.model(batch, samples)
        if prediction.points.device.type != "cpu" or torch.isfinite(prediction.points).all():
            return point_avatar_loss(prediction, batch, self.config.loss, progress)
        # as on devices, where neighbours of NaN are not refused; by the graph of all processes, which wait for it
        defined = replace(prediction, points=prediction.points.nan_to_num(0.0, 0.0, 0.0))
        terms = point_avatar_loss(defined, batch, self.config.loss, progress)
        parts = (terms.raw, terms.weighted)
        return LossTerms(*({name: value * math.nan for name, value in part.items()} for part in parts))

    def rate_factor(self) -> float:
        """The learning rate's factor at this point of the budget."""
        rise = min(1.0, (self.step + 1) / self.config.warmup) if self.config.warmup else 1.0
        if self.config.schedule is Schedule.cosine:
            return rise * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, self.progress()))))
        return rise

    @torch.no_grad()
    def validate(self, batches: Iterable[Batch]) -> dict[str, float]:
        """Mean loss terms over held-back frames, with all terms on and fixed template points; empty without frames."""
        self.model.eval()
        samples = self.samples_at(-1)
        sums: dict[str, float] = {}
        frames = 0
        for batch in islice(batches, self.team.rank, None, self.team.size):
            count = len(batch.names)
            for name, value in log_values(self.losses(batch.to(self.device), samples, 1.0)).items():
                sums[name] = sums.get(name, 0.0) + value * count
            frames += count
        told = gather((sums, frames), self.team)
        frames = sum(count for _, count in told)
        return {name: sum(each.get(name, 0.0) for each, _ in told) / frames for name in told[0][0]}

    def save(self, score: float | None) -> None:
        """Writes a checkpoint; in a team the leading process does, with everyone's random state."""
        state = self.state()
        if self.team.leads:
            save_checkpoint(self.folder / "checkpoints", state, self.step, score)

    def state(self) -> dict[str, Any]:
        """Everything a resumed run needs: tensors and plain values."""
        random = {"cpu": torch.get_rng_state()}
        if self.device.type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(self.device)
        return {
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "random": gather(random, self.team),
            "threads": torch.get_num_threads(),
        }

    def resume(self) -> None:
        """Goes back to the newest sound checkpoint; seeds the random state when there is none."""
        team = self.team
        state = from_lead(load_checkpoint(self.folder / "checkpoints") if team.leads else None, team)
        torch.manual_seed(self.config.seed + 1_000_003 * team.rank)
        if state is None:
            weights = {name: value.cpu() for name, value in self.model.state_dict().items()}
            self.model.load_state_dict(from_lead(weights, team))
            return
        with restoring(self.folder / "checkpoints"):
            self.restore(state)

    def restore(self, state: dict[str, Any]) -> None:
        """Takes a checkpoint's state over."""
        team = self.team
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.seconds = int(state["step"]), float(state["seconds"])
        before = (state["threads"], len(state["random"]))
        if before != (torch.get_num_threads(), team.size):
            report.info("Going on with other threads or processes than before: equal to rounding, not to the bit.")
        if len(state["random"]) == team.size:
            random = state["random"][team.rank]
            torch.set_rng_state(random["cpu"])
            if "cuda" in random and self.device.type == "cuda":
                torch.cuda.set_rng_state(random["cuda"], self.device)


def log_values(terms: LossTerms) -> dict[str, float]:
    """What the log shows of a step: the objective, the unweighted Chamfer distance and every raw term."""
    values = {name: float(value.detach()) for name, value in terms.raw.items()}
    chamfer = values["scan_to_points"] + values["points_to_scan"]
    return {"loss": float(terms.total.detach()), "chamfer": chamfer} | values
