"""SCANimate: a pose-aware signed distance on T-pose scans, extracted and posed by learned skinning (CVPR 2021)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avatar.canonical.fields import BodyField, SkinningField, SkinningFieldConfig, bounding_box
from avatar.checks import AvatarError, DataError, check_range
from avatar.data.batches import (
    CanonicalBatch,
    CanonicalFrame,
    CanonicalFrames,
    LruSequence,
    canonical_frame,
    mirror_map,
)
from avatar.data.outfits import Outfit
from avatar.data.splits import split_outfit
from avatar.environment import choose_device
from avatar.implicit import losses
from avatar.implicit.avatar import ImplicitAvatar, ImplicitConfig, sample_mesh
from avatar.implicit.extraction import ExtractionConfig
from avatar.implicit.losses import ImplicitLossConfig, QueryConfig, QueryPoints
from avatar.methods.base import CANONICALIZER, SEED_STRIDE, Inputs, Method, Position, Stage, Task, TrainedAvatar
from avatar.methods.canonicalizer import canonical_outfits, canonicalizer_folder, find_field
from avatar.methods.points import check_count
from avatar.methods.settings import Precision, RunConfig, TrainConfig
from avatar.records import BodyFit, LossTerms, Surface, Template
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.world import require_single_process

FIELD = "field."  # prefix of the forward field's weights among the avatar's
BOX_MARGIN = 0.05  # of the longest side: space around scans and body, so that no surface meets the box's sides


@dataclass
class ImplicitTrainConfig:
    """What training an implicit avatar has besides its budget (`TrainConfig`)."""

    queries: QueryConfig = field(default_factory=QueryConfig)
    loss: ImplicitLossConfig = field(default_factory=ImplicitLossConfig)
    decay: float = 0.1  # factor on the learning rate, on top of train.schedule, at each of
    decay_at: tuple[float, ...] = (0.5, 0.75)  # these shares of training (the paper's)

    def __post_init__(self):
        check_range(self, "decay", above=0, high=1)
        if any(not 0 < share < 1 for share in self.decay_at):
            raise AvatarError(f"decay_at: expected shares between 0 and 1, got {self.decay_at}.")


@dataclass
class ScanimateConfig:
    """Options of the `scanimate` method; of a run's ``train``, template points and point losses have no part in it."""

    avatar: ImplicitConfig = field(default_factory=ImplicitConfig)
    train: ImplicitTrainConfig = field(default_factory=ImplicitTrainConfig)


class ImplicitTask(Task):
    """Training of a signed distance: points on T-pose scans and in space, and a second-order loss (eqs. 14-17)."""

    terms = losses.TERMS
    criterion = "surface"

    def __init__(
        self,
        model: ImplicitAvatar,
        body: Tensor,
        config: TrainConfig,
        settings: ImplicitTrainConfig,
        frames: CanonicalFrames,
        checks: CanonicalFrames | None = None,
    ):
        """Prepares training on ``frames``, with ``checks`` held back; ``body (V, 3)`` are canonical body vertices."""
        self.model, self.body, self.box = model, body, model.box.cpu()
        self.config, self.settings, self.data, self.checks = config, settings, frames, checks
        self.frames, self.batch = len(frames), config.batch
        self.groups = ([parameter for parameter in model.parameters() if parameter.requires_grad],)
        self.stages = (Stage(1.0, (config.lr,), self.rate_factor),)

    def rate_factor(self, step: int, progress: float) -> float:
        """The learning rate's factor: warm-up, the schedule's and the decays that are past."""
        past = sum(progress >= share for share in self.settings.decay_at)
        return self.config.rate_factor(step, progress) * self.settings.decay**past

    def inputs_at(self, step: int) -> tuple[CanonicalBatch, QueryPoints]:
        batch = self.data.batch_at(step, self.config.batch)
        return batch, self.space_at(batch, step)

    def held_back(self) -> Iterator[tuple[CanonicalBatch, QueryPoints]]:
        for batch in self.checks.ordered() if self.checks else ():
            yield batch, self.space_at(batch, -1)

    def space_at(self, batch: CanonicalBatch, key: int) -> QueryPoints:
        """The points in space that a key draws for a batch on the CPU."""
        generator = torch.Generator().manual_seed(self.config.seed * SEED_STRIDE + key + 1)
        return losses.sample_queries(batch.points, self.body, self.box, self.settings.queries, generator)

    def loss(self, inputs: Inputs, position: Position) -> LossTerms:
        batch, space = inputs
        values = losses.query_field(self.model, batch.points, space, batch.joint_transforms)
        return losses.implicit_loss(values, batch.normals, self.settings.loss, batch.colors)

    def shown(self, values: dict[str, float]) -> dict[str, str]:
        return super().shown(values) | {"surface": f"{values['surface'] * 1e3:.1f}mm"}


class Scanimate(Method):
    """SCANimate's implicit avatar of one outfit, trained on its canonicalizer's T-pose scans."""

    name = "scanimate"
    Settings = ScanimateConfig
    makes_meshes = True

    def needs(self, run: RunConfig, settings: ScanimateConfig) -> frozenset[str]:
        return frozenset({CANONICALIZER})

    def check(self, run: RunConfig, settings: ScanimateConfig) -> None:
        require_single_process(self.name)
        if run.train.precision is not Precision.fp32:
            raise AvatarError(f"train.precision: expected fp32 for {self.name}, got {run.train.precision.value}.")
        if len(run.outfit) != 1:
            raise AvatarError(f"outfit: {self.name} learns one outfit at a time, got {', '.join(run.outfit)}.")

    def prepare(self, run: RunConfig, settings: ScanimateConfig, template: Template) -> ImplicitTask:
        outfits, train = run.outfits(), run.train
        outfit = canonical_outfits(run.runs_root, outfits, run.canonical)[0]
        skinning = find_field(canonicalizer_folder(run.runs_root, outfits[0], run.canonical), template)
        split = split_outfit(outfit, run.split)
        colored = settings.avatar.colored
        seen, held_back = (read_frames(outfit, names, colored) for names in (split.train, split.validation))
        corners = [torch.stack([frame.points.amin(dim=0), frame.points.amax(dim=0)]) for frame in seen]
        box = bounding_box(torch.cat([*corners, template.vertices]), BOX_MARGIN)
        torch.manual_seed(train.seed)
        model = ImplicitAvatar(template, skinning, box, settings.avatar).to(choose_device(run.device))
        symmetry = mirror_map(template) if train.mirror else None
        frames = CanonicalFrames(seen, train.scan_points, train.seed, symmetry)
        checks = CanonicalFrames(held_back, train.scan_points, train.seed) if held_back else None
        return ImplicitTask(model, template.vertices, train, settings.train, frames, checks)

    def untrained(self, settings: ScanimateConfig, template: Template) -> ImplicitAvatar:
        box = torch.stack([template.vertices.amin(dim=0), template.vertices.amax(dim=0)])
        return ImplicitAvatar(template, BodyField(template), box, settings.avatar)

    def describe(self, model: ImplicitAvatar) -> dict[str, Any]:
        learned = not isinstance(model.field, BodyField)
        field = {"learned": settings_to_dict(model.field.config)} if learned else {"neighbours": model.field.neighbours}
        return {"box": model.box.tolist(), "field": field}

    def rebuild(self, settings: Any, template: Template, outfits: int, facts: dict, weights: dict) -> ImplicitAvatar:
        if "neighbours" in facts["field"]:
            skinning = BodyField(template, facts["field"]["neighbours"])
        else:
            field_settings = settings_from_dict(SkinningFieldConfig, facts["field"]["learned"])
            skinning = SkinningField(len(template.parents), field_settings, template.vertices[:2])
            own = {name.removeprefix(FIELD): value for name, value in weights.items() if name.startswith(FIELD)}
            skinning.load_state_dict(own)
        return ImplicitAvatar(template, skinning, torch.tensor(facts["box"]), settings.avatar)

    def predictor(self, avatar: TrainedAvatar, outfit: str, points: int, surface: ExtractionConfig) -> Callable:
        check_count(points)
        avatar.outfit_index(outfit)

        def dress(body: BodyFit) -> Surface:
            joint_transforms = torch.from_numpy(np.asarray(body.joint_transforms, np.float32))
            mesh = avatar.model.canonical_mesh(joint_transforms, surface)
            mesh = avatar.model.pose_mesh(mesh, joint_transforms)
            return Surface(sample_mesh(mesh, points), mesh)

        return dress

    def prediction_settings(self, points: int, surface: ExtractionConfig) -> dict[str, Any]:
        return super().prediction_settings(points, surface) | {"surface": settings_to_dict(surface)}


def read_frames(outfit: Outfit, names: tuple[str, ...], colored: bool) -> Sequence[CanonicalFrame]:
    """Canonical scans of training frames, read when needed; `DataError` for one without the colours to be learned."""

    def read(index: int) -> CanonicalFrame:
        frame = canonical_frame(outfit.load("train", names[index]))
        if colored and frame.colors is None:
            path = outfit.frame_path("train", frame.name)
            raise DataError(path, "this scan has no colours to learn.", "Set method.settings.avatar.colored=false.")
        return frame

    return LruSequence(read, len(names))
