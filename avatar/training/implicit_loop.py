"""The training loop of the implicit avatar: named losses, validation, resumable checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError
from avatar.implicit.avatar import ImplicitAvatar
from avatar.implicit.losses import TERMS, ImplicitLossConfig, implicit_loss
from avatar.implicit.probing import ProbeConfig, SpacePoints, probe_field, space_points
from avatar.progress import Progress
from avatar.records import LossTerms
from avatar.training.checkpoints import load_checkpoint, restoring, save_checkpoint
from avatar.training.feeding import Feed, to_device
from avatar.training.implicit_batches import CanonicalBatch, CanonicalFrames
from avatar.training.locks import lock_folder
from avatar.training.logs import TrainingLog
from avatar.training.loop import MAX_BAD_STEPS, Schedule, TrainConfig
from avatar.training.signals import stop_requests

SEED_STRIDE = 1_000_003


@dataclass
class ImplicitTrainConfig:
    """What training an implicit avatar has besides its budget (`TrainConfig`)."""

    probes: ProbeConfig = field(default_factory=ProbeConfig)
    loss: ImplicitLossConfig = field(default_factory=ImplicitLossConfig)
    decay: float = 0.1  # factor on the learning rate, on top of train.schedule, at each of
    decay_at: tuple[float, ...] = (0.5, 0.75)  # these shares of training (the paper's)

    def __post_init__(self):
        if not 0 < self.decay <= 1 or any(not 0 < share < 1 for share in self.decay_at):
            raise AvatarError(
                f"decay: expected above 0 and at most 1, decay_at: shares between 0 and 1, "
                f"got {self.decay} and {self.decay_at}."
            )


class ImplicitTrainer:
    """Trains one implicit avatar in one run folder; running it again goes on where it stopped."""

    def __init__(
        self,
        model: ImplicitAvatar,
        body: Tensor,
        config: TrainConfig,
        settings: ImplicitTrainConfig,
        folder: Path,
    ):
        """Prepares training.

        Args:
            model: the avatar.
            body: ``(V, 3)`` canonical body vertices, about which the field is asked as well.
            config: budget and optimiser; its options on template points and point losses have no meaning here.
            settings: points in space, weights of the terms, decay of the learning rate.
            folder: the run's folder; ``metrics.csv`` and ``checkpoints/`` go there.
        """
        self.model, self.config, self.settings, self.folder = model, config, settings, folder
        self.device = model.box.device
        self.body, self.box = body, model.box.cpu()
        self.learned = [parameter for parameter in model.parameters() if parameter.requires_grad]
        self.optimiser = torch.optim.Adam(self.learned, lr=config.lr, fused=True)
        self.step, self.seconds, self.bad_steps = 0, 0.0, 0

    def fit(self, frames: CanonicalFrames, held_back: CanonicalFrames | None) -> None:
        """Trains until the budget is spent; ``held_back`` frames choose the best checkpoint.

        Raises:
            AvatarError: when losses or gradients stay non-finite.
            Stopped: when asked to stop (`signals`); the state is saved.
        """
        feed = Feed(partial(self.inputs_at, frames), self.config.steps, self.device)
        with lock_folder(self.folder), stop_requests() as stop, feed:
            self.resume()
            log = TrainingLog(self.folder, ["loss", *TERMS, "lr", "grad_norm"], self.step)
            started = time.monotonic() - self.seconds
            budget = 60 * self.config.minutes if self.config.minutes else None
            bar = Progress("train", self.config.steps, "step", self.step, budget, self.seconds)
            while self.progress() < 1 and stop.number is None:
                terms, norm = self.train_step(*feed(self.step))
                self.step, self.seconds = self.step + 1, time.monotonic() - started
                bar.advance()
                epoch = self.step * self.config.batch // len(frames)
                if self.due(self.config.log_every):
                    values = log_values(terms) | {"lr": self.optimiser.param_groups[0]["lr"], "grad_norm": norm}
                    log.write("train", self.step, epoch, self.seconds, values)
                    bar.show(loss=f"{values['loss']:.3f}", surface=f"{values['surface'] * 1e3:.1f}mm")
                score = None
                if held_back and self.due(self.config.validate_every):
                    values = self.validate(held_back.ordered())
                    log.write("validation", self.step, epoch, self.seconds, values)
                    score = values["surface"]
                worth = (self.due(self.config.save_every) or score is not None) and not self.bad_steps
                if worth or self.progress() >= 1 or stop.number is not None:
                    save_checkpoint(self.folder / "checkpoints", self.state(), self.step, score)
            bar.close()
            log.close()
            if stop.number is not None and self.progress() < 1:
                stop.leave(self.folder)

    def progress(self) -> float:
        """Share of the budget that is spent, by steps or by the clock, whichever is further."""
        clock = self.seconds / (60 * self.config.minutes) if self.config.minutes else 0.0
        return max(self.step / self.config.steps, clock)

    def due(self, every: int) -> bool:
        """Whether this step is one of every so many, or the last."""
        return self.step % every == 0 or self.progress() >= 1

    def inputs_at(self, frames: CanonicalFrames, step: int) -> tuple[CanonicalBatch, SpacePoints]:
        """The batch of a step and its points in space; both depend on nothing but the step and the seed."""
        batch = frames.batch_at(step, self.config.batch)
        return batch, self.space_at(batch, step)

    def space_at(self, batch: CanonicalBatch, key: int) -> SpacePoints:
        """The points in space that a key draws for a batch of the CPU."""
        generator = torch.Generator().manual_seed(self.config.seed * SEED_STRIDE + key + 1)
        return space_points(batch.points, self.body, self.box, self.settings.probes, generator)

    def train_step(self, batch: CanonicalBatch, space: SpacePoints) -> tuple[LossTerms, float]:
        """One optimiser step on inputs that are on the device; gives the loss terms and the gradient norm."""
        self.optimiser.param_groups[0]["lr"] = self.config.lr * self.rate_factor()
        terms = self.losses(batch, space)
        self.optimiser.zero_grad(set_to_none=True)
        terms.total.backward()
        norm = nn.utils.clip_grad_norm_(self.learned, self.config.clip or math.inf)
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
        return terms, float(norm)

    def rate_factor(self) -> float:
        """The learning rate's factor: warm-up, the schedule's and the decays that are past."""
        factor = min(1.0, (self.step + 1) / self.config.warmup) if self.config.warmup else 1.0
        progress = min(1.0, self.progress())
        factor *= self.settings.decay ** sum(progress >= share for share in self.settings.decay_at)
        if self.config.schedule is Schedule.cosine:
            factor *= 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress))
        return factor

    def losses(self, batch: CanonicalBatch, space: SpacePoints) -> LossTerms:
        """The field asked at a batch's points and at points in space, and the losses of it."""
        values = probe_field(self.model, batch.points, space, batch.joint_transforms)
        return implicit_loss(values, batch.normals, self.settings.loss, batch.colors)

    @torch.no_grad()
    def validate(self, batches: Iterable[CanonicalBatch]) -> dict[str, float]:
        """Mean loss terms over held-back frames, always at the same points."""
        inputs = (to_device((batch, self.space_at(batch, -1)), self.device) for batch in batches)
        rows = [log_values(self.losses(*each)) for each in inputs]
        return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}

    def state(self) -> dict[str, Any]:
        """Everything a resumed run needs; what a step draws follows from the seed and the step."""
        names = ("model", "optimiser")
        states = {name: getattr(self, name).state_dict() for name in names}
        return states | {"step": self.step, "seconds": self.seconds}

    def resume(self) -> None:
        """Goes back to the newest sound checkpoint, where there is one."""
        state = load_checkpoint(self.folder / "checkpoints")
        if state is not None:
            with restoring(self.folder / "checkpoints"):
                self.model.load_state_dict(state["model"])
                self.optimiser.load_state_dict(state["optimiser"])
                self.step, self.seconds = int(state["step"]), float(state["seconds"])


def log_values(terms: LossTerms) -> dict[str, float]:
    """What the log shows of a step: the objective and every raw term."""
    return {"loss": float(terms.total.detach())} | {name: float(value.detach()) for name, value in terms.raw.items()}
