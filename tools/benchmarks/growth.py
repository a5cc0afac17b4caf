"""Scaling exponents of a training step's cost with points, vertices, outfits and frames."""

from __future__ import annotations

from dataclasses import replace
from statistics import median

import numpy as np
import torch

from avatar.checks import require
from avatar.records import Batch, Template
from benchmarks.avatars import make_avatar, make_step
from benchmarks.comparisons import Figure, Job, Run, time_interleaved

LABEL = "closet_small"


def ball(subdivisions: int) -> Template:
    """A unit sphere as a body of one joint."""
    sphere = require("trimesh").creation.icosphere(subdivisions)
    vertices = torch.from_numpy(sphere.vertices).float()
    faces, weights = torch.from_numpy(sphere.faces).long(), torch.ones(len(vertices), 1)
    return Template(vertices, faces, weights, torch.zeros(1, 3), (-1,), ("root",))


def ball_batch(template: Template, frames: int, outfits: int, scan_points: int) -> Batch:
    """Batch of frames of a constant sphere, in alternating outfits, with scans on it."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(frames, scan_points, 3, generator=generator)
    scans = torch.nn.functional.normalize(directions, dim=-1)
    vertices = template.vertices.expand(frames, -1, -1)
    return Batch(
        pose_vertices=vertices,
        vertices=vertices,
        vertex_transforms=torch.eye(4).repeat(frames, len(template.vertices), 1, 1),
        joint_transforms=torch.eye(4).repeat(frames, 1, 1, 1),
        scan_points=scans,
        scan_normals=scans,
        outfit_ids=torch.arange(frames) % outfits,
        names=("ball.00000",) * frames,
    )


def prepare_step(job: Job, points: int, subdivisions: int, outfits: int, frames: int) -> tuple[Run, int]:
    """Step of the small CloSET on a sphere, and the number of the sphere's vertices."""
    template = ball(subdivisions)
    batch = ball_batch(template, frames, outfits, points).to(job.device)
    return make_step(make_avatar(job, LABEL, template, outfits), template, batch, points), len(template.vertices)


def growth_figures(job: Job, repeats: int) -> list[Figure]:
    """Exponents of log processor seconds over log size, one size varied at a time; 1 is linear, 0 constant.

    Scan points vary with the points. The sizes are timed in interleaved order, as candidates are.
    """
    usual = {"points": job.size(5000, 200), "subdivisions": job.size(5, 3), "outfits": 1, "frames": 4}
    varied = {
        "points": [job.size(count, count // 50) for count in (5000, 10_000, 20_000, 40_000)],
        "subdivisions": [job.size(5, 3), job.size(6, 4)],
        "outfits": [1, 2, 4],
        "frames": [1, 2, 4, 8],
    }
    figures = []
    for what, sizes in varied.items():
        prepared = [prepare_step(job, **(usual | {what: size})) for size in sizes]
        if what == "subdivisions":
            what, sizes = "vertices", [vertices for _, vertices in prepared]
        runs = {str(size): run for size, (run, _) in zip(sizes, prepared)}
        time_interleaved(runs, 1)
        seconds = {
            name: median(job.cost(timing) for timing in timings)
            for name, timings in time_interleaved(runs, repeats).items()
        }
        slope = np.polyfit(np.log(sizes), np.log(list(seconds.values())), 1)[0]
        baseline = Figure("growth", f"{what} {sizes[0]:,} to {sizes[-1]:,}", LABEL, "exponent", float(slope), "1")
        figures += [baseline, replace(baseline, metric="processor_seconds", value=seconds[str(sizes[-1])], unit="s")]
    return figures
