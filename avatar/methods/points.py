"""Point methods: networks that predict oriented points at places of the body, trained by Chamfer and normal losses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, check_shape
from avatar.data.batches import FrameDataset, mirror_batch, mirror_coins, mirror_map, name_frames
from avatar.data.outfits import Outfit
from avatar.data.splits import split_outfit
from avatar.environment import choose_device
from avatar.geometry.chunks import UNIT, in_chunks
from avatar.geometry.surface import sample_surface
from avatar.implicit.extraction import ExtractionConfig
from avatar.methods.base import CANONICALIZER, SEED_STRIDE, Inputs, Method, Position, Stage, Task, TrainedAvatar
from avatar.methods.canonicalizer import canonical_outfits
from avatar.methods.losses import TERMS, point_avatar_loss
from avatar.methods.settings import FitConfig, Precision, RunConfig, Space, TrainConfig
from avatar.progress import tracked
from avatar.records import (
    Batch,
    BodyFit,
    LossTerms,
    PointCloud,
    Prediction,
    Surface,
    SurfaceSamples,
    Template,
    map_tensors,
)
from avatar.world import current_world, step_outfits

MAX_POINTS = 400_000
CHUNK = 100_000  # points decoded at once, or fewer where memory runs out; the networks are pointwise


def check_count(points: int) -> None:
    """Check a number of points a frame. Raises `AvatarError` for a count out of 1,000 to 400,000."""
    if not 1000 <= points <= MAX_POINTS:
        raise AvatarError(f"points: expected 1,000 to {MAX_POINTS:,}, got {points}.")


def draw_samples(model: nn.Module, template: Template, points: int, generator: torch.Generator) -> SurfaceSamples:
    """Where on the body a network predicts: evenly by area, or at about as many points of its own.

    A network on UV maps has the pixels or patches of its grid (``template_samples(points)``); one with a surface of its
    own draws from that (``draw_samples(points, generator)``).
    """
    if hasattr(model, "draw_samples"):
        return model.draw_samples(points, generator)
    own = getattr(model, "template_samples", None)
    samples = own(points) if own else None
    return sample_surface(template.vertices, template.faces, points, generator) if samples is None else samples


class PointTask(Task):
    """Training of a point method: batches, template points and the losses of a prediction, in its precision."""

    terms: tuple[str, ...] = ("chamfer", *TERMS)
    criterion = "chamfer"

    def __init__(
        self,
        model: nn.Module,
        template: Template,
        config: TrainConfig,
        batch_at: Callable[[int], Batch],
        frames: int,
        validation: Callable[[], Iterable[Batch]] = tuple,
    ):
        """Prepares training of a network that is called as ``model(batch, samples) -> Prediction``.

        Its garment codes, if any, are in ``codes``. ``batch_at`` gives this rank's shard of a step's batch, which
        follows from the step alone; ``frames`` is the number of training frames; ``validation`` gives the held-back
        batches of all ranks.
        """
        self.model, self.template, self.config = model, template, config
        self.batch_at, self.validation, self.frames, self.batch = batch_at, validation, frames, config.batch
        self.device, self.world = next(model.parameters()).device, current_world()
        named = dict(model.named_parameters())
        codes = [named.pop("codes")] if "codes" in named else []
        self.groups = (list(named.values()), codes)
        self.stages = (Stage(1.0, (config.lr, config.code_lr), config.rate_factor),)
        self.replicated = getattr(model, "outfit_modules", ())

    def inputs_at(self, step: int) -> tuple[Batch, SurfaceSamples]:
        return self.batch_at(step), self.samples_at(step)

    def held_back(self) -> Iterator[tuple[Batch, SurfaceSamples]]:
        return ((batch, self.fixed_points) for batch in self.validation())

    def samples_at(self, step: int) -> SurfaceSamples:
        """The template points of a step: one fixed set, or a fresh one every step."""
        return self.draw_points(step + 1) if self.config.fresh_points else self.fixed_points

    @cached_property
    def fixed_points(self) -> SurfaceSamples:
        """The template points that stay the same, on the device."""
        return self.draw_points(0).to(self.device)

    def draw_points(self, key: int) -> SurfaceSamples:
        generator = torch.Generator().manual_seed(self.config.seed * SEED_STRIDE + key)
        return draw_samples(self.model, self.template, self.config.points, generator)

    def loss(self, inputs: Inputs, position: Position) -> LossTerms:
        """Prediction in the configured precision, then the losses in float32."""
        batch, samples = inputs
        if self.world.size > 1 and self.model.training and hasattr(self.model, "codes"):
            batch = replace(batch, step_outfits=step_outfits(batch.outfit_ids, len(self.model.codes), self.world))
        narrow = self.config.precision is Precision.bf16
        with torch.autocast(self.device.type, torch.bfloat16) if narrow else nullcontext():
            prediction = self.model(batch, samples)
        if prediction.points.device.type != "cpu" or torch.isfinite(prediction.points).all():
            return self.objective(prediction, batch, position.progress)
        # as on devices, where neighbours of NaN are not refused; by the graph of all processes, which wait for it
        defined = map_tensors(prediction, lambda values: values.nan_to_num(0.0, 0.0, 0.0))
        terms = self.objective(defined, batch, position.progress)
        undefined = {name: value * math.nan for name, value in terms.weighted.items()}
        return LossTerms(dict.fromkeys(terms.raw, torch.tensor(math.nan)), undefined)

    def objective(self, prediction: Prediction, batch: Batch, progress: float) -> LossTerms:
        """The loss terms of a prediction."""
        return point_avatar_loss(prediction, batch, self.config.loss, progress)

    def log_values(self, terms: LossTerms) -> dict[str, float]:
        values = super().log_values(terms)
        return values | {"chamfer": values["scan_to_points"] + values["points_to_scan"]}

    def shown(self, values: dict[str, float]) -> dict[str, str]:
        return super().shown(values) | {"chamfer": f"{values['chamfer'] * 1e4:.3f}e-4"}


class PointMethod(Method):
    """Base of the point methods: a ``network`` class, built as ``network(template, outfits, settings)``."""

    network: ClassVar[type[nn.Module]]
    task: ClassVar[type[PointTask]] = PointTask
    on_body = True

    def needs(self, run: RunConfig, settings: Any) -> frozenset[str]:
        return frozenset({CANONICALIZER}) if run.space is Space.canonical else frozenset()

    def build(self, run: RunConfig, settings: Any, template: Template, outfits: list[Outfit]) -> nn.Module:
        """The untrained network of a run, on the CPU."""
        return self.network(template, len(outfits), settings)

    def untrained(self, settings: Any, template: Template) -> nn.Module:
        return self.network(template, 1, settings)

    def prepare(self, run: RunConfig, settings: Any, template: Template) -> PointTask:
        outfits, train, world = run.outfits(), run.train, current_world()
        splits = [split_outfit(outfit, run.split) for outfit in outfits]
        canonical, size, shard = run.space is Space.canonical, train.batch, world.shard(train.batch)
        seen = canonical_outfits(run.runs_root, outfits, run.canonical) if canonical else outfits
        scans = (train.scan_points, train.seed)
        frames = FrameDataset(seen, name_frames(outfits, "train", [split.train for split in splits]), *scans)
        held_back = name_frames(outfits, "train", [split.validation for split in splits])
        checks = FrameDataset(seen, held_back, *scans) if held_back else None
        symmetry = mirror_map(template) if train.mirror else None

        def batch_at(step: int) -> Batch:
            batch = frames.batch_at(step * world.size + world.rank, size // world.size)
            batch = replace(batch, canonical=canonical)
            if symmetry is None:
                return batch
            coins = mirror_coins(train.seed, step, size)[shard]
            batch = replace(batch, frame_ids=batch.frame_ids + coins * len(frames))
            return mirror_batch(batch, coins, symmetry)

        def validation() -> Iterable[Batch]:
            batches = checks.ordered_batches(size) if checks else ()
            return (replace(batch, canonical=canonical) for batch in batches)

        torch.manual_seed(train.seed)
        model = self.build(run, settings, template, outfits).to(choose_device(run.device))
        return self.task(model, template, train, batch_at, len(frames), validation)

    def rebuild(self, settings: Any, template: Template, outfits: int, facts: dict, weights: dict) -> nn.Module:
        return self.network(template, outfits, settings)

    def predictor(self, avatar: TrainedAvatar, outfit: str, points: int, surface: ExtractionConfig) -> Callable:
        samples = template_samples(avatar, points)
        return lambda body: Surface(self.predict_at(avatar, outfit, body, samples))

    def predict_at(
        self, avatar: TrainedAvatar, outfit: str, body: BodyFit, samples: SurfaceSamples, **switches: bool
    ) -> PointCloud:
        batch = body_batch([body], avatar.outfit_index(outfit), (outfit,))
        return predict(avatar.model, batch, samples, **switches)

    def garment(
        self, avatar: TrainedAvatar, outfit: str, points: int, body: BodyFit | None = None
    ) -> PointCloud | None:
        if not getattr(avatar.settings, "template", False):
            return None
        samples = template_samples(avatar, points)
        if body is not None:
            return self.predict_at(avatar, outfit, body, samples, wrinkles=False)
        device = next(avatar.model.parameters()).device
        return join_clouds([avatar.model.garment_template(avatar.outfit_index(outfit), samples.to(device))])

    def fit_code(self, avatar: TrainedAvatar, batch: Batch, options: FitConfig) -> Tensor:
        """The garment code ``(1, ...)`` that explains one scan best, begun at the mean of the trained codes.

        The network is frozen; the rate is a tenth of itself for the second half of the steps. Raises `AvatarError` for
        a network without codes.
        """
        model, device = avatar.model.eval().requires_grad_(False), next(avatar.model.parameters()).device
        if not hasattr(model, "codes"):
            return super().fit_code(avatar, batch, options)
        model.codes = nn.Parameter(model.codes.mean(dim=0, keepdim=True))
        optimiser = torch.optim.Adam([model.codes], lr=options.code_lr)
        half = torch.optim.lr_scheduler.StepLR(optimiser, max(1, options.steps // 2), 0.1)
        batch = replace(batch, outfit_ids=torch.zeros_like(batch.outfit_ids)).to(device)
        generator = torch.Generator().manual_seed(options.seed)
        samples = draw_samples(model, avatar.template, options.points, generator).to(device)
        for step in tracked(range(options.steps), "fit", unit="step"):
            terms = point_avatar_loss(model(batch, samples), batch, options.loss, step / options.steps)
            optimiser.zero_grad()
            terms.total.backward()
            optimiser.step()
            half.step()
        return model.codes.detach()


def template_samples(avatar: TrainedAvatar, points: int) -> SurfaceSamples:
    """The template points a prediction is made at: spread evenly by area, always the same, or the network's own.

    Raises `AvatarError` for a count out of 1,000 to 400,000.
    """
    check_count(points)
    return draw_samples(avatar.model, avatar.template, points, torch.Generator().manual_seed(0))


def body_batch(bodies: list[BodyFit], outfit: int, names: tuple[str, ...]) -> Batch:
    """Bodies without scans as a batch for prediction."""
    stacked = {
        name: torch.stack([torch.as_tensor(getattr(body, name), dtype=torch.float32) for body in bodies])
        for name in ("pose_vertices", "vertices", "vertex_transforms", "joint_transforms")
    }
    nothing = torch.zeros(len(bodies), 0, 3)
    ids = torch.full((len(bodies),), outfit)
    return Batch(**stacked, scan_points=nothing, scan_normals=nothing, outfit_ids=ids, names=names)


@torch.no_grad()
def predict(model: nn.Module, batch: Batch, samples: SurfaceSamples, **switches: bool) -> PointCloud:
    """The dressed surface of one body (a batch of one) at any number of template points.

    ``switches`` go to the network, such as CloSET's ``wrinkles=False`` for the garment template alone.
    """
    check_shape("vertices", batch.vertices, "1 V 3")
    device = next(model.parameters()).device
    batch, count = batch.to(device), len(samples.face_ids)
    rows = torch.arange(-(-count // UNIT) * UNIT).clamp(max=count - 1)  # no leftover: each chunk encodes the body anew

    def decode(chunk: slice) -> Prediction:
        ids = rows[chunk]
        part = SurfaceSamples(samples.vertex_ids[ids], samples.barycentric[ids], samples.face_ids[ids])
        return model(batch, part.to(device), **switches)

    cloud = join_clouds(in_chunks(decode, len(rows), CHUNK))
    return PointCloud(cloud.points[:count], cloud.normals[:count])


def join_clouds(parts: list[Prediction]) -> PointCloud:
    """Chunks of one frame's prediction as one cloud."""
    points = torch.cat([part.points[0] for part in parts])
    normals = torch.cat([part.normals[0] for part in parts])
    return PointCloud(points.float().cpu().numpy(), normals.float().cpu().numpy())
