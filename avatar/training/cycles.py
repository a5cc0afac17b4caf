"""Learning skinning fields from posed scans: fields apart, then together through the cycle; and codes of new frames."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from avatar.canonical.canonicalizer import Canonicalizer, Latent
from avatar.canonical.losses import TERMS, CanonicalLossConfig, NearestWeights, canonicalization_loss
from avatar.canonical.posed import DrawConfig, PosedScan, ScanBatch, draw_batch
from avatar.checks import AvatarError
from avatar.progress import Progress
from avatar.records import LossTerms, Template
from avatar.training.checkpoints import load_checkpoint, restoring, save_checkpoint
from avatar.training.feeding import Feed
from avatar.training.locks import lock_folder
from avatar.training.logs import TrainingLog
from avatar.training.signals import StopRequest, stop_requests

MAX_BAD_STEPS = 10
SEED_STRIDE = 1_000_003


@dataclass
class CycleConfig:
    """Budget and optimiser of both stages; the defaults are the paper's for 500 scans (80 and 200 epochs)."""

    first_steps: int = 10_000  # optimiser steps with the fields apart
    second_steps: int = 25_000  # and together
    batch: int = 4  # frames a step
    first_lr: float = 0.004
    second_lr: float = 0.001
    decay: float = 0.1  # factor on both at half, and again at three quarters, of each stage
    clip: float | None = None  # largest gradient norm
    code_steps: int = 200  # to find the code of a frame that was not learned from
    code_lr: float = 0.02
    draw: DrawConfig = field(default_factory=DrawConfig)
    loss: CanonicalLossConfig = field(default_factory=CanonicalLossConfig)
    save_every: int = 500  # steps
    log_every: int = 20  # steps
    seed: int = 0

    def __post_init__(self):
        for name in ("first_steps", "batch", "code_steps", "save_every", "log_every"):
            if getattr(self, name) < 1:
                raise AvatarError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        if self.second_steps < 0 or (self.clip is not None and self.clip <= 0):
            raise AvatarError(
                f"second_steps: expected at least 0, clip: above 0; got {self.second_steps}, {self.clip}."
            )
        if min(self.first_lr, self.second_lr, self.code_lr) <= 0 or not 0 < self.decay <= 1:
            raise AvatarError("first_lr, second_lr, code_lr: expected above 0, decay: in (0, 1].")

    @property
    def steps(self) -> int:
        """Both stages' steps."""
        return self.first_steps + self.second_steps


class CycleTrainer:
    """Trains a canonicalizer in a run folder; running it again goes on where it stopped, in either stage."""

    def __init__(
        self,
        model: Canonicalizer,
        template: Template,
        scans: Sequence[PosedScan],
        names: Sequence[str],
        config: CycleConfig,
        folder: Path,
    ):
        """Prepares training of a canonicalizer on its scans; ``names`` are theirs, for messages."""
        self.device = next(model.parameters()).device
        self.model, self.config, self.folder = model, config, folder
        self.nearest = NearestWeights(template, self.device)
        self.scans, self.names, self.weights = scans, names, template.weights
        self.optimiser = torch.optim.Adam(model.parameters(), lr=config.first_lr, fused=True)
        self.step, self.seconds, self.bad_steps = 0, 0.0, 0

    def fit(self) -> None:
        """Trains both stages to their end; holds the lock of the run's folder while it does.

        Raises:
            AvatarError: when losses or gradients stay non-finite, or another job holds the folder.
            Stopped: when asked to stop (`signals`), with everything saved.
        """
        with lock_folder(self.folder), stop_requests() as stop:
            self.resume()
            log = TrainingLog(self.folder, ["loss", *TERMS, "lr", "grad_norm"], self.step)
            try:
                self.run(log, stop)
            finally:
                log.close()

    def run(self, log: TrainingLog, stop: StopRequest) -> None:
        """The steps from here to the end, with what is logged and saved between them."""
        started, config = time.monotonic() - self.seconds, self.config
        bar = Progress("canonicalizer", config.steps, "step", self.step, spent=self.seconds)
        with bar, Feed(lambda step: (self.batch_at(step),), config.steps, self.device) as feed:
            while self.step < config.steps:
                terms, norm = self.train_step(*feed(self.step))
                self.step, self.seconds = self.step + 1, time.monotonic() - started
                bar.advance()
                done, stopping = self.step == config.steps, stop.number is not None
                if self.step % config.log_every == 0 or done:
                    values = {name: float(value.detach()) for name, value in terms.raw.items()}
                    values |= {"loss": float(terms.total.detach()), "grad_norm": norm}
                    values["lr"] = self.optimiser.param_groups[0]["lr"]
                    log.write("train", self.step, self.epoch(), self.seconds, values)
                    cycle = f"{1e3 * values.get('cycle_points', 0):.1f}mm"
                    bar.show(loss=f"{values['loss']:.3f}", cycle=cycle)
                if (self.step % config.save_every == 0 and not self.bad_steps) or done or stopping:
                    save_checkpoint(self.folder / "checkpoints", self.state(), self.step)
                if stopping and not done:
                    stop.leave(self.folder)

    def epoch(self) -> int:
        """How often every scan has been seen."""
        return self.step * self.config.batch // len(self.scans)

    def batch_at(self, step: int) -> ScanBatch:
        """The batch of a step; depends on nothing but the step and the seed, so that a resumed run sees the same."""
        places = torch.arange(step * self.config.batch, (step + 1) * self.config.batch)
        frames = [self.frame_at(int(place)) for place in places]
        generator = torch.Generator().manual_seed(self.config.seed * SEED_STRIDE + step)
        return draw_batch(self.scans, frames, self.weights, self.config.draw, generator)

    def frame_at(self, place: int) -> int:
        """The scan at a place in the endless row of epochs, each of which is a permutation of them all."""
        epoch, offset = divmod(place, len(self.scans))
        generator = torch.Generator().manual_seed((self.config.seed + 1) * SEED_STRIDE + epoch)
        return int(torch.randperm(len(self.scans), generator=generator)[offset])

    def train_step(self, batch: ScanBatch) -> tuple[LossTerms, float]:
        """One optimiser step on a batch that is on the device; gives the loss terms and the gradient norm."""
        stage = self.step - self.config.first_steps
        if stage == 0:
            self.optimiser.state.clear()  # the stages have an optimiser each
        steps, rate = (
            (self.config.second_steps, self.config.second_lr)
            if stage >= 0
            else (self.config.first_steps, self.config.first_lr)
        )
        progress = (stage if stage >= 0 else self.step) / steps
        self.optimiser.param_groups[0]["lr"] = rate * rate_factor(progress, self.config.decay)
        codes = self.model.batch_codes(batch)
        cycle = self.model(batch, codes, together=stage >= 0)
        terms = canonicalization_loss(cycle, batch, self.nearest, self.config.loss, progress if stage >= 0 else 0.0)
        self.optimiser.zero_grad(set_to_none=True)
        terms.total.backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip or math.inf)
        if torch.isfinite(norm) and torch.isfinite(terms.total):
            self.optimiser.step()
            self.bad_steps = 0
        else:
            self.refuse_endless_failure(batch)
        return terms, float(norm)

    def refuse_endless_failure(self, batch: ScanBatch) -> None:
        """Counts a step whose loss was not finite, and ends training after too many in a row."""
        self.bad_steps += 1
        if self.bad_steps > MAX_BAD_STEPS:
            names = ", ".join(self.names[frame] for frame in batch.frames.tolist())
            raise AvatarError(
                f"loss: not finite for {self.bad_steps} steps in a row (step {self.step}, frames {names}). "
                "Lower the learning rate or check these frames; the last checkpoint is sound."
            )

    def state(self) -> dict[str, Any]:
        """Everything a resumed run needs."""
        return {
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
        }

    def resume(self) -> None:
        """Goes back to the newest sound checkpoint, where there is one."""
        state = load_checkpoint(self.folder / "checkpoints")
        if state is not None:
            with restoring(self.folder / "checkpoints"):
                self.model.load_state_dict(state["model"])
                self.optimiser.load_state_dict(state["optimiser"])
                self.step, self.seconds = int(state["step"]), float(state["seconds"])


def rate_factor(progress: float, decay: float) -> float:
    """The learning rate's factor at a share of a stage: it falls at half and at three quarters."""
    return decay ** ((progress >= 0.5) + (progress >= 0.75))


def find_code(model: Canonicalizer, template: Template, scan: PosedScan, start: Tensor, config: CycleConfig) -> Tensor:
    """The code ``(L,)`` of a frame that was not learned from: found with frozen networks (auto-decoding).

    Args:
        model: a trained canonicalizer with codes.
        template: the body at rest.
        scan: the frame.
        start: ``(L,)`` where to begin: the code of a learned frame in a similar pose.
        config: steps, rate, points and loss weights.
    """
    if model.config.latent is Latent.pose:
        return scan.pose.to(start)
    code = start.detach().clone().requires_grad_()
    nearest, weights = NearestWeights(template, code.device), template.weights.cpu()
    optimiser = torch.optim.Adam([code], lr=config.code_lr)
    for step in range(config.code_steps):
        optimiser.param_groups[0]["lr"] = config.code_lr * rate_factor(step / config.code_steps, config.decay)
        generator = torch.Generator().manual_seed(config.seed * SEED_STRIDE + step)
        batch = draw_batch([scan], [0], weights, config.draw, generator).to(code.device)
        cycle = model(batch, code[None], together=True)
        loss = canonicalization_loss(cycle, batch, nearest, config.loss, step / config.code_steps).total
        (code.grad,) = torch.autograd.grad(loss, [code])
        optimiser.step()
    return code.detach()
