"""The trainer of every method: stages, budget, bad steps, inputs, validation, checkpoints, signals, ranks."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from itertools import islice
from pathlib import Path
from typing import Protocol, Self

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, DataError
from avatar.io.checkpoints import load_checkpoint, restoring, save_checkpoint
from avatar.io.locks import lock_folder
from avatar.methods.base import SEED_STRIDE, Inputs, Position, Task
from avatar.methods.settings import Clock
from avatar.nn.layers import synchronize_norms
from avatar.progress import Progress
from avatar.records import LossTerms, map_tensors
from avatar.training.logs import TrainingLog
from avatar.training.signals import StopRequest, stop_requests
from avatar.world import average, broadcast, current_world, gather, gradients_of

FORMAT = 2  # of checkpoints; those of trainers before this one are refused
MAX_BAD_STEPS = 10
report = logging.getLogger(__name__)


class Budget(Protocol):
    """Settings of training of any method; ``minutes``, if not None, may end it before ``steps``."""

    steps: int
    minutes: float | None
    clock: Clock
    clip: float | None
    validate_every: int
    save_every: int
    log_every: int
    seed: int


class Trainer:
    """Trains a task in a run's folder; started again, it resumes from the newest valid checkpoint, equal to the bit."""

    def __init__(self, task: Task, budget: Budget, folder: Path):
        """Prepares training, under torchrun as one rank of several; the run's files go to ``folder``."""
        self.task, self.budget, self.folder, self.model = task, budget, folder, task.model
        self.device = next(self.model.parameters()).device
        self.world = current_world()
        if budget.minutes and budget.clock is Clock.processor and self.device.type != "cpu":
            hint = "train.clock=wall, with no other job on the machine."
            raise AvatarError(f"train.clock: processor time leaves out the work of {self.device.type}. Hint: {hint}")
        if self.world.size > 1:
            synchronize_norms(self.model, task.replicated)
        kept = self.model.state_dict().keys()
        self.statistics = [buffer for name, buffer in self.model.named_buffers() if name in kept]
        groups = [{"params": group, "lr": rate} for group, rate in zip(task.groups, task.stages[0].rates)]
        self.optimiser = torch.optim.Adam(groups, fused=True)
        self.step, self.seconds, self.stage, self.bad_steps = 0, 0.0, 0, 0

    def fit(self) -> None:
        """Trains until the budget is spent, holding the lock of the run's folder.

        Raises `AvatarError` when losses or gradients stay non-finite or another job holds the folder, and `Stopped`
        after SIGTERM or SIGUSR1, with everything saved.
        """
        with lock_folder(self.folder) if self.world.is_main else nullcontext(), stop_requests() as stop:
            self.resume()
            columns = ["loss", *self.task.terms, "lr", "grad_norm"]
            log = TrainingLog(self.folder, columns, self.step) if self.world.is_main else None
            try:
                self.run(log, stop)
            finally:
                if log and log.board:
                    log.board.close()

    def run(self, log: TrainingLog | None, stop: StopRequest) -> None:
        """The steps from here to the end of the budget, with what is logged, validated and saved between them."""
        budget = self.budget
        clock = budget.clock.seconds
        started, limit = clock() - self.seconds, 60 * budget.minutes if budget.minutes else None
        bar = Progress(self.task.label, budget.steps, "step", self.step, limit, self.seconds, log is None, clock)
        with bar, Feed(self.task.inputs_at, budget.steps, self.device) as feed:
            while self.progress() < 1:
                terms, rate, norm = self.train_step(feed(self.step))
                self.step += 1
                stopping = self.sync_clock(clock() - started, stop)
                bar.advance()
                done, score = self.progress() >= 1, None
                if self.step % budget.log_every == 0 or done:
                    values = self.world_mean(self.task.log_values(terms)) | {"lr": rate, "grad_norm": float(norm)}
                    bar.show(**self.task.shown(values))
                    self.write(log, "train", values)
                if self.step % budget.validate_every == 0 or done:
                    values = self.validate()
                    score = values.get(self.task.criterion)
                    self.write(log, "validation", values)
                due = self.step % budget.save_every == 0 or score is not None
                if (due and not self.bad_steps) or done or stopping:
                    self.save(score)
                if stopping and not done:
                    stop.leave(self.folder)

    def write(self, log: TrainingLog | None, split: str, values: dict[str, float]) -> None:
        """Writes one row of the log on the main rank."""
        if log:
            log.write(split, self.step, self.step * self.task.batch // self.task.frames, self.seconds, values)

    def sync_clock(self, seconds: float, stop: StopRequest) -> bool:
        """Averages the elapsed time over all ranks; True if any rank received a stop signal."""
        shared = torch.tensor([seconds, float(stop.number is not None)], dtype=torch.float64)
        average([shared], self.world)
        self.seconds = float(shared[0])
        return bool(shared[1] > 0)

    def world_mean(self, values: dict[str, float]) -> dict[str, float]:
        """The mean of named values over all ranks."""
        every = gather(values, self.world)
        return {name: sum(each[name] for each in every) / len(every) for name in values}

    def progress(self) -> float:
        """Share of the budget that is spent, by steps or by the clock, whichever is further."""
        return spent(self.budget, self.step, self.seconds)

    def position(self) -> Position:
        """The stage that the next step belongs to, and how far in it that is."""
        progress, start, last = self.progress(), 0.0, len(self.task.stages) - 1
        for index, stage in enumerate(self.task.stages):
            end = start + stage.share
            if progress < end or index == last:
                break
            start = end
        return Position(index, min(1.0, round((progress - start) / (end - start), 12)))

    def train_step(self, inputs: Inputs) -> tuple[LossTerms, float, Tensor]:
        """One optimiser step on inputs that are on the device; gives loss terms, learning rate and gradient norm.

        A step whose loss or gradients are not finite leaves weights, moments and running statistics as they were; too
        many of them in a row raise `AvatarError`.
        """
        self.model.train()
        position = self.position()
        if position.stage != self.stage:
            self.optimiser.state.clear()
            self.stage = position.stage
        stage = self.task.stages[position.stage]
        factor = stage.factor(self.step, position.progress)
        for group, rate in zip(self.optimiser.param_groups, stage.rates):
            group["lr"] = rate * factor
        before = [statistic.clone() for statistic in self.statistics]
        try:
            terms = self.task.loss(inputs, position)
        except AvatarError:  # of a search among points that are not finite
            self.restore_statistics(before)
            raise
        self.optimiser.zero_grad(set_to_none=True)
        terms.total.backward()
        total = terms.total.detach().clone()
        if self.world.size > 1:
            average([*gradients_of(self.model, self.world), total], self.world)
        learned = [parameter for group in self.task.groups for parameter in group]
        norm = nn.utils.clip_grad_norm_(learned, self.budget.clip or math.inf)
        if bool(torch.isfinite(norm + total)):
            self.optimiser.step()
            self.bad_steps = 0
        else:
            self.restore_statistics(before)
            self.bad_steps += 1
        if self.bad_steps > MAX_BAD_STEPS:
            where = f"(step {self.step}, frames {', '.join(self.task.frame_names(inputs))})"
            hint = "lower the learning rate or check these frames; the last checkpoint is valid."
            raise AvatarError(f"loss: not finite for {self.bad_steps} steps in a row {where}. Hint: {hint}")
        return terms, stage.rates[0] * factor, norm

    def restore_statistics(self, values: list[Tensor]) -> None:
        """Puts back the running statistics from before a step that was not finite."""
        for statistic, value in zip(self.statistics, values):
            statistic.copy_(value)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Mean loss terms over held-back frames at the end of training's schedule; empty without frames."""
        self.model.eval()
        self.task.settle()
        sums: dict[str, float] = {}
        frames, end = 0, Position(len(self.task.stages) - 1, 1.0)
        for inputs in islice(self.task.held_back(), self.world.rank, None, self.world.size):
            count = len(self.task.frame_names(inputs))
            terms = self.task.loss(to_device(inputs, self.device), end)
            for name, value in self.task.log_values(terms).items():
                sums[name] = sums.get(name, 0.0) + value * count
            frames += count
        every = gather((sums, frames), self.world)
        frames = sum(count for _, count in every)
        return {name: sum(each.get(name, 0.0) for each, _ in every) / frames for name in every[0][0]}

    def save(self, score: float | None) -> None:
        """Writes a checkpoint of all that a resumed run needs; the main rank does, with the random state of all."""
        random = {"cpu": torch.get_rng_state()}
        if self.device.type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(self.device)
        state = {"format": FORMAT, "model": self.model.state_dict(), "optimiser": self.optimiser.state_dict()}
        state |= {"step": self.step, "stage": self.stage, "seconds": self.seconds}
        state |= {"random": gather(random, self.world), "threads": torch.get_num_threads()}
        if self.world.is_main:
            save_checkpoint(self.folder / "checkpoints", state, self.step, score)

    def resume(self) -> None:
        """Goes back to the newest valid checkpoint, else seeds the random state; `DataError` for one of another run."""
        world, folder = self.world, self.folder / "checkpoints"
        state = broadcast(load_checkpoint(folder) if world.is_main else None, world)
        torch.manual_seed(self.budget.seed + SEED_STRIDE * world.rank)
        if state is None:
            weights = {name: value.cpu() for name, value in self.model.state_dict().items()}
            self.model.load_state_dict(broadcast(weights, world))
            return
        if state.get("format") != FORMAT:
            problem = f"expected checkpoints of format {FORMAT}, got {state.get('format', 1)}, of an earlier version."
            hint = "Train it anew under another name (name=...); finished weights are still read."
            raise DataError(folder, problem, hint)
        with restoring(folder):
            self.model.load_state_dict(state["model"])
            self.optimiser.load_state_dict(state["optimiser"])
            self.step, self.stage, self.seconds = int(state["step"]), int(state["stage"]), float(state["seconds"])
            if (state["threads"], len(state["random"])) != (torch.get_num_threads(), world.size):
                report.info("Resuming with other threads or processes than before: equal to rounding, not to the bit.")
            if len(state["random"]) == world.size:
                random = state["random"][world.rank]
                torch.set_rng_state(random["cpu"])
                if "cuda" in random and self.device.type == "cuda":
                    torch.cuda.set_rng_state(random["cuda"], self.device)


def spent(budget: Budget, steps: int, seconds: float) -> float:
    """Share of a budget that steps and seconds of training have used, by whichever is further."""
    clock = seconds / (60 * budget.minutes) if budget.minutes else 0.0
    return max(steps / budget.steps, clock)


class Feed:
    """The inputs of training steps on a device: while a step trains there, a thread prepares those of the next one.

    Used as a ``with`` block, at whose end nothing goes on in the background. For CUDA they are copied from pinned
    memory. On the CPU they are prepared on request: a thread with work of its own would have OpenMP threads of its own,
    and OpenMP then lets all of them sleep at once (docs/performance.md).
    """

    def __init__(self, make: Callable[[int], Inputs], steps: int, device: torch.device):
        """Prepares nothing yet; ``make`` gives the inputs of a step, by one call at a time, at most one step ahead."""
        self.make, self.steps, self.device = make, steps, device
        self.pinned = device.type == "cuda"
        options = {"initializer": torch.cuda.set_device, "initargs": (device,)} if self.pinned else {}
        self.thread = ThreadPoolExecutor(1, "feed", **options) if device.type != "cpu" else None
        self.ahead: dict[int, Future[Inputs]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self.thread:
            self.thread.shutdown(cancel_futures=True)

    def __call__(self, step: int) -> Inputs:
        """The inputs of a step, on the device. What `make` raises for a step is raised here, at that step."""
        if not self.thread:
            return to_device(self.make(step), self.device)
        ready = self.ahead.pop(step, None) or self.thread.submit(self._prepare, step)
        records = ready.result()
        self.ahead = {step + 1: self.thread.submit(self._prepare, step + 1)} if step + 1 < self.steps else {}
        return to_device(records, self.device)

    def _prepare(self, step: int) -> Inputs:
        records = self.make(step)
        return tuple(map_tensors(record, pin) for record in records) if self.pinned else records


def pin(tensor: Tensor) -> Tensor:
    """A CPU tensor in page-locked memory; others, such as constant samples on the device, as they are."""
    return tensor.pin_memory() if tensor.device.type == "cpu" else tensor


def to_device(records: Inputs, device: torch.device) -> Inputs:
    """Inputs with their tensors on a device; from pinned memory without waiting for the copy."""
    return tuple(map_tensors(record, lambda tensor: tensor.to(device, non_blocking=True)) for record in records)
