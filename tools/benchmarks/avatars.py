"""Training steps and predictions of point avatars: CloSET and POP at the same points and batch."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import nn

from avatar.data.batches import FrameDataset, name_frames
from avatar.data.layouts import OpenOutfit, find_outfit
from avatar.methods.points import PointTask, draw_samples, predict
from avatar.methods.registry import find_method
from avatar.methods.settings import TrainConfig
from avatar.records import Batch, Template
from avatar.settings import settings_from_dict
from avatar.training.trainer import Trainer
from benchmarks.comparisons import Comparison, Job, Run

EAGER = "compiling needs CUDA here: the main job never compiles, for it would need a C++ compiler on a bare machine"


def sample_outfit() -> OpenOutfit:
    """The embedded dress."""
    return find_outfit(Path("data"), "sample", "dress")


def sample_batch(frames: int, scan_points: int) -> tuple[Template, Batch]:
    """The dress's body and a batch of some of its frames."""
    outfit = sample_outfit()
    names = name_frames([outfit], "train", [outfit.frames("train")[:frames]])
    return outfit.template, FrameDataset([outfit], names, scan_points).batch_at(0, frames)


def make_avatar(job: Job, label: str, template: Template, outfits: int = 1) -> nn.Module:
    """A fresh network by its label: the method's name and a size."""
    name = label.split("_")[0]
    method = find_method(name)
    settings: Any = settings_from_dict(method.Settings, job.avatars[label], f"avatars.{label}.")
    torch.manual_seed(0)
    return method.network(template, outfits, settings).to(job.device)


def make_step(model: nn.Module, template: Template, batch: Batch, points: int) -> Run:
    """One optimiser step on a batch, points fixed as at full size, as the training loop takes it."""
    train = TrainConfig(points=points, batch=len(batch.names))
    task = PointTask(model, template, train, lambda step: batch, len(batch.names))
    trainer = Trainer(task, train, Path("unused"))
    return lambda: trainer.train_step((batch, task.fixed_points))


def make_prediction(model: nn.Module, template: Template, batch: Batch, points: int) -> Run:
    """One frame's cloud, from the posed body to arrays."""
    samples = draw_samples(model, template, points, torch.Generator().manual_seed(0))
    model.eval()
    return lambda: predict(model, batch, samples)


def avatar_candidates(job: Job, make: Any, labels: list[str], points: int, frames: int, scan_points: int):
    """Candidates by label and, on CUDA, their compiled variants; the reasons of those that are absent."""

    def prepare(label: str, compiled: bool) -> Run:
        template, batch = sample_batch(frames, scan_points)
        model = make_avatar(job, label, template)
        if compiled:
            model.forward = torch.compile(model.forward)
        return make(model, template, batch.to(job.device), points)

    candidates = {label: partial(prepare, label, False) for label in labels}
    compiled = {f"{label} compiled": partial(prepare, label, True) for label in labels if label.startswith("closet")}
    if job.device == "cuda":
        return candidates | compiled, {}
    return candidates, dict.fromkeys(compiled, EAGER)


def step_comparisons(job: Job) -> list[Comparison]:
    """Training steps: every avatar at 50,000 points, those of small size at 10,000."""
    comparisons, small = [], [label for label in job.labels if label.endswith("_small")]
    for labels, baseline, points, scan_points in (
        (job.labels, job.largest_pop, job.size(50_000, 400), job.size(40_000, 300)),
        (small, "pop_small", job.size(10_000, 300), job.size(10_000, 200)),
    ):
        frames = job.size(job.frames, 2)
        candidates, absent = avatar_candidates(job, make_step, labels, points, frames, scan_points)
        case = f"{points:,} points, {frames} frames"
        if baseline in candidates:
            comparisons.append(Comparison("step", case, candidates, baseline, None, absent, points))
    return comparisons


def predict_comparisons(job: Job) -> list[Comparison]:
    """Predictions of one frame by every avatar."""
    points = job.size(50_000, 400)
    candidates, absent = avatar_candidates(job, make_prediction, job.labels, points, 1, 1)
    return [Comparison("predict", f"{points:,} points", candidates, job.largest_pop, None, absent, points)]
