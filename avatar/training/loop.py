"""One training loop for all point avatars: stateless data order, named losses, validation, resumable checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from avatar.checks import AvatarError
from avatar.geometry.surface import sample_surface
from avatar.records import Batch, LossTerms, SurfaceSamples
from avatar.training.checkpoints import load_checkpoint, save_checkpoint
from avatar.training.logs import TrainingLog
from avatar.training.losses import TERMS, LossConfig, point_avatar_loss

MAX_BAD_STEPS = 10


class Schedule(Enum):
    """How the learning rate moves over training."""

    constant = "constant"  # POP
    cosine = "cosine"  # falls to a hundredth


class Precision(Enum):
    """Arithmetic of the network's forward pass; distances and losses are always float32."""

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
        """Prepares training of a network on a template.

        Args:
            model: a network called as ``model(batch, samples) -> Prediction``, with its garment codes in ``codes``.
            vertices: ``(V, 3)`` template; faces: ``(F, 3)``: where template points are drawn.
            config: budget and optimiser.
            folder: the run's folder; ``metrics.csv`` and ``checkpoints/`` go there.
        """
        self.model, self.config, self.folder = model, config, folder
        self.surface = (vertices, faces)
        self.device = next(model.parameters()).device
        codes = [parameter for name, parameter in model.named_parameters() if name == "codes"]
        others = [parameter for name, parameter in model.named_parameters() if name != "codes"]
        groups = [{"params": others, "lr": config.lr}, {"params": codes, "lr": config.code_lr}]
        self.optimiser = torch.optim.Adam(groups)
        self.base_rates = [config.lr, config.code_lr]
        self.step, self.seconds, self.bad_steps = 0, 0.0, 0

    def fit(
        self, batch_at: Callable[[int], Batch], epoch_length: int, validation: Callable[[], Iterable[Batch]]
    ) -> None:
        """Trains until the budget is spent.

        Args:
            batch_at: the batch of a step; depends on nothing but the step, so that a resumed run sees the same data.
            epoch_length: steps an epoch.
            validation: the held-back batches, deterministic.

        Raises:
            AvatarError: when losses or gradients stay non-finite.
        """
        self.resume()
        columns = ["loss", "chamfer", *TERMS, "lr", "grad_norm"]
        log = TrainingLog(self.folder, columns, self.step)
        started = time.monotonic() - self.seconds
        bar = tqdm(total=self.config.steps, initial=self.step, desc="train", unit="step", disable=None)
        while self.progress() < 1:
            terms, rate, norm = self.train_step(batch_at(self.step))
            self.step, self.seconds = self.step + 1, time.monotonic() - started
            bar.update()
            done = self.progress() >= 1
            epoch = self.step // epoch_length
            if self.step % self.config.log_every == 0 or done:
                values = log_values(terms) | {"lr": rate, "grad_norm": norm}
                log.write("train", self.step, epoch, self.seconds, values)
                bar.set_postfix(loss=f"{values['loss']:.3f}", chamfer=f"{values['chamfer'] * 1e4:.3f}e-4")
            score = None
            if self.step % self.config.validate_every == 0 or done:
                values = self.validate(validation())
                if values:
                    log.write("validation", self.step, epoch, self.seconds, values)
                    score = values["chamfer"]
            if self.step % self.config.save_every == 0 or score is not None or done:
                save_checkpoint(self.folder / "checkpoints", self.state(), self.step, score)
        bar.close()
        log.close()

    def progress(self) -> float:
        """Share of the budget that is spent, by steps or by the clock, whichever is further."""
        clock = self.seconds / (60 * self.config.minutes) if self.config.minutes else 0.0
        return max(self.step / self.config.steps, clock)

    def samples_at(self, step: int) -> SurfaceSamples:
        """The template points of a step: one fixed set, or a fresh one every step."""
        seed = self.config.seed * 1_000_003 + (step + 1 if self.config.fresh_points else 0)
        generator = torch.Generator().manual_seed(seed)
        return sample_surface(*self.surface, self.config.points, generator).to(self.device)

    def train_step(self, batch: Batch) -> tuple[LossTerms, float, float]:
        """One optimiser step; gives the loss terms, the learning rate and the gradient norm."""
        self.model.train()
        factor = self.rate_factor()
        for group, base in zip(self.optimiser.param_groups, self.base_rates):
            group["lr"] = base * factor
        terms = self.losses(batch.to(self.device), self.samples_at(self.step), self.progress())
        self.optimiser.zero_grad(set_to_none=True)
        terms.total.backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip or math.inf)
        if torch.isfinite(norm) and torch.isfinite(terms.total):
            self.optimiser.step()
            self.bad_steps = 0
        else:
            self.bad_steps += 1
            if self.bad_steps > MAX_BAD_STEPS:
                raise AvatarError(
                    f"loss: not finite for {self.bad_steps} steps in a row (step {self.step}, frames "
                    f"{', '.join(batch.names)}). Lower lr or check these frames; the last checkpoint is sound."
                )
        return terms, self.base_rates[0] * factor, float(norm)

    def losses(self, batch: Batch, samples: SurfaceSamples, progress: float) -> LossTerms:
        """Prediction in the configured precision, then the losses in float32."""
        narrow = self.config.precision is Precision.bf16
        with torch.autocast(self.device.type, torch.bfloat16) if narrow else nullcontext():
            prediction = self.model(batch, samples)
        return point_avatar_loss(prediction, batch, self.config.loss, progress)

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
        for batch in batches:
            count = len(batch.names)
            for name, value in log_values(self.losses(batch.to(self.device), samples, 1.0)).items():
                sums[name] = sums.get(name, 0.0) + value * count
            frames += count
        return {name: value / frames for name, value in sums.items()}

    def state(self) -> dict[str, Any]:
        """Everything a resumed run needs."""
        random = {"cpu": torch.get_rng_state()}
        if self.device.type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(self.device)
        return {
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "random": random,
        }

    def resume(self) -> None:
        """Goes back to the newest sound checkpoint; seeds the random state when there is none."""
        state = load_checkpoint(self.folder / "checkpoints")
        if state is None:
            torch.manual_seed(self.config.seed)
            return
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.seconds = state["step"], state["seconds"]
        torch.set_rng_state(state["random"]["cpu"])
        if "cuda" in state["random"] and self.device.type == "cuda":
            torch.cuda.set_rng_state(state["random"]["cuda"], self.device)


def log_values(terms: LossTerms) -> dict[str, float]:
    """What the log shows of a step: the objective, the unweighted Chamfer distance and every raw term."""
    values = {name: float(value.detach()) for name, value in terms.raw.items()}
    chamfer = values["scan_to_points"] + values["points_to_scan"]
    return {"loss": float(terms.total.detach()), "chamfer": chamfer} | values
