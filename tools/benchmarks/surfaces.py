"""Benchmarks beside the point avatars: the canonicalizer's step, surfaces from fields and points, simulated frames."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avatar.canonical.canonicalizer import Canonicalizer, CanonicalizerConfig
from avatar.canonical.scans import prepare_scan
from avatar.export.meshing import PoissonConfig, PoissonMesher
from avatar.implicit.extraction import ExtractionConfig, extract_surface
from avatar.implicit.networks import PosedSdf, SdfConfig
from avatar.methods.base import TrainedAvatar
from avatar.methods.canonicalizer import CanonicalizerTask, CycleConfig
from avatar.methods.layered import LayeredConfig, handle_poses
from avatar.methods.registry import find_method
from avatar.methods.settings import MethodChoice, RunConfig
from avatar.nn.handles import ClothHandles, HandleLayout
from avatar.records import Mesh, PointCloud
from avatar.settings import settings_from_dict
from avatar.simulate.dressing import DressedBody, TravelConfig
from avatar.simulate.outfits import outfit
from avatar.simulate.poses import draw_poses
from avatar.training.trainer import Trainer, to_device
from benchmarks.avatars import sample_outfit
from benchmarks.comparisons import Comparison, Job, Run, absence


def canonicalizer_comparisons(job: Job) -> list[Comparison]:
    """A step of the canonicalizer's two stages, at each size."""
    frames = job.size(4, 2)

    def prepare(label: str, together: bool) -> Run:
        garment = sample_outfit()
        options = job.canonicalizers[label]
        train = settings_from_dict(CycleConfig, options.get("train", {}), f"canonicalizers.{label}.train.")
        sizes = settings_from_dict(CanonicalizerConfig, options.get("canonicalizer", {}))
        names = garment.frames("train")[:frames]
        scans = [prepare_scan(garment.load("train", name), garment.template, train.draw.pool) for name in names]
        torch.manual_seed(0)
        model = Canonicalizer(garment.template, frames, sizes).to(job.device)
        task = CanonicalizerTask(model, garment.template, scans, names, train)
        trainer = Trainer(task, train, Path("unused"))
        trainer.step = train.first_steps + 1 if together else 0
        return lambda: trainer.train_step(to_device(task.inputs_at(trainer.step), trainer.device))

    comparisons = []
    for label in (label for label in job.canonicalizers if label == "small" or not job.quick):
        candidates = {"fields apart": partial(prepare, label, False), "together": partial(prepare, label, True)}
        comparisons.append(Comparison("canonicalizer", label, candidates, "fields apart"))
    return comparisons


def extraction_comparisons(job: Job) -> list[Comparison]:
    """Zero surface of a signed distance network, evaluated coarse to fine or on the dense grid."""
    resolution, coarsest = job.size(128, 32), job.size(16, 8)

    def prepare(config: ExtractionConfig) -> Run:
        torch.manual_seed(0)
        widths = (64, 64, 64, 64)
        box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]], device=job.device)
        sdf = PosedSdf(0, box, SdfConfig(widths=widths, skip=2, orders=0)).to(job.device)

        def field(points: Tensor) -> Tensor:
            return sdf(points[None], points.new_zeros(1, len(points), 0))[0]

        return lambda: extract_surface(field, box, config)

    def gap(mine: Mesh, baseline: Mesh) -> float:
        same = mine.vertices.shape == baseline.vertices.shape
        return float(np.abs(mine.vertices - baseline.vertices).max()) if same else float("inf")

    candidates = {
        "ours": partial(prepare, ExtractionConfig(resolution, coarsest)),
        "dense grid": partial(prepare, ExtractionConfig(resolution, resolution)),
    }
    return [Comparison("extraction", f"{resolution} cells", candidates, "ours", gap)]


def poisson_comparisons(job: Job) -> list[Comparison]:
    """Meshing a scan in the worker process, by octree depth; the worker's memory is not in the table."""
    points, depths = job.size(40_000, 3000), job.size(8, 6)
    if find_spec("open3d") is None:
        return [Comparison("poisson", f"{points:,} points", {}, "", absent={"depth 8": absence("open3d")})]

    candidates = {f"depth {depth}": partial(prepare_poisson, depth, points) for depth in (depths - 1, depths)}
    return [Comparison("poisson", f"{points:,} points", candidates, f"depth {depths}", points=points)]


def prepare_poisson(depth: int, points: int) -> Run:
    """Poisson meshing of a scan's points, of at most as many as it has."""
    garment = sample_outfit()
    scan = garment.load("train", garment.frames("train")[0]).scan
    chosen = np.random.default_rng(0).permutation(len(scan.points))[:points]
    cloud = PointCloud(scan.points[chosen], scan.normals[chosen])
    mesher = PoissonMesher(PoissonConfig(depth=depth, max_hole=0.1))
    return lambda: mesher.mesh(cloud)


def mesh_comparisons(job: Job) -> list[Comparison]:
    """A frame's mesh: the layered avatar's own from a posed body, all of it garment, and Poisson from points."""
    points, depth, frames = job.size(50_000, 3000), job.size(8, 6), job.size(120, 6)
    outfit = sample_outfit()
    method, body = find_method("layered"), outfit.load_body("train", outfit.frames("train")[0])

    def prepare(label: str) -> Run:
        settings = settings_from_dict(LayeredConfig, job.avatars[label], f"avatars.{label}.")
        model = method.untrained(settings, outfit.template)
        parts = model.vertices[: model.garment_count], model.garment_faces, model.clothed_weights
        poses = handle_poses(torch.as_tensor(body.joint_transforms).float().expand(frames, -1, 4, 4), settings)
        model.handles = ClothHandles(HandleLayout.on_mesh(*parts, settings.handles), poses)
        run = RunConfig(method=MethodChoice("layered", "layered"))
        avatar = TrainedAvatar(method, settings, model.to(job.device).eval(), outfit.template, run, 0, 0.0)
        predict = method.predictor(avatar, outfit.name, points, ExtractionConfig())
        return lambda: predict(body).mesh.vertices

    sizes = [label for label in job.avatars if label.startswith("closet_")]  # the layered avatar's sizes are CloSET's
    candidates, absent = {label.replace("closet", "layered"): partial(prepare, label) for label in sizes}, {}
    if find_spec("open3d") is None:
        absent["Poisson"] = absence("open3d")
    else:
        candidates["Poisson"] = partial(prepare_poisson, depth, points)
    return [Comparison("mesh", f"{points:,} points", candidates, "layered_small", absent=absent, points=points)]


def simulation_comparisons(job: Job) -> list[Comparison]:
    """A settled frame of the tee and of the dress, from the bind pose to rest."""
    if find_spec("newton") is None:
        return [Comparison("simulation", "settled frame", {}, "", absent={"newton": absence("newton")})]
    travel = TravelConfig(stride=0.3, hold=3, least_hold=1) if job.quick else TravelConfig()

    def prepare(name: str) -> Run:
        dressed = DressedBody(outfit(name), travel)
        pose = draw_poses(1, 0, "train")[0].pose
        return lambda: dressed.settle(pose).cloth

    candidates = {name: partial(prepare, name) for name in ("tee", "dress")}
    return [Comparison("simulation", "settled frame", candidates, "tee")]
