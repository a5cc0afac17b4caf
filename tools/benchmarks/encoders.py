"""PointNet++ without its optimisations: the first layer on every neighbour, torch's gathers, no cached indices."""

from __future__ import annotations

import copy
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import linear

from avatar.methods.closet import ClosetConfig
from avatar.nn.encoders import FeaturePropagation, PointNet2, SetAbstraction
from avatar.nn.hierarchy import Level
from avatar.settings import settings_from_dict
from benchmarks.avatars import sample_batch
from benchmarks.comparisons import Comparison, Job, Run


class NeighbourAbstraction(SetAbstraction):
    """Set abstraction whose first layer sees every neighbour, as the paper writes it."""

    def forward(self, features: Tensor) -> Tensor:
        level = self.level
        relative = level.finer_positions[level.groups] - level.positions[:, None]
        joined = torch.cat([level.group(features), relative.expand(len(features), -1, -1, -1)], dim=-1)
        weight = torch.cat([self.feature_layer.weight, self.position_layer.weight], dim=1)
        return self.rest(self.first(linear(joined, weight, self.feature_layer.bias))).amax(dim=2)


class LatePropagation(FeaturePropagation):
    """Feature propagation that interpolates first and joins before the first layer."""

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        return self.mlp(torch.cat([self.level.interpolate_up(coarse), fine], dim=-1))


class IndexedGroups(torch.nn.Module):
    """A level's gathers by torch's own indexing."""

    def __init__(self, level: Level, up: bool):
        super().__init__()
        self.level, self.up = [level], up  # in a list, so that it is no child of its child

    def forward(self, values: Tensor) -> Tensor:
        level = self.level[0]
        if not self.up:
            return values[:, level.groups]
        corners = range(level.up_ids.shape[1])
        return sum(values[:, level.up_ids[:, c]] * level.up_weights[:, c : c + 1] for c in corners)


def slow_layers(encoder: PointNet2) -> PointNet2:
    """The encoder with its linear layers after the gathers."""
    slow = copy.deepcopy(encoder)
    for layer in slow.abstractions:
        layer.__class__ = NeighbourAbstraction
    for layer in slow.propagations:
        layer.__class__ = LatePropagation
    return slow


def slow_gathers(encoder: PointNet2) -> PointNet2:
    """The encoder with torch's indexing in place of sums of bags."""
    slow = copy.deepcopy(encoder)
    for layer in slow.abstractions:
        layer.level.group = IndexedGroups(layer.level, up=False)
    for layer in slow.propagations:
        layer.level.interpolate_up = IndexedGroups(layer.level, up=True)
    return slow


def encoder_comparisons(job: Job) -> list[Comparison]:
    """The pose encoder forward and back, at full size over one frame, else over a batch.

    Indices anew are a network built for every step.
    """
    comparisons = []
    for label in (name for name in job.labels if name.startswith("closet")):
        config = settings_from_dict(ClosetConfig, job.avatars[label], f"avatars.{label}.").pose_encoder
        frames = job.size(4, 1) if label.endswith("_small") else 1

        def prepare(kind: str, config=config, frames=frames) -> Run:
            template, batch = sample_batch(frames, 1)
            vertices = batch.pose_vertices.to(job.device)
            torch.manual_seed(0)
            encoder = PointNet2(template, 3, config)
            change = {"layers a neighbour": slow_layers, "torch's gathers": slow_gathers}.get(kind)
            encoder = (change(encoder) if change else encoder).to(job.device)

            def run() -> Tensor:
                used = encoder
                if kind == "indices anew":
                    used = PointNet2(template, 3, config).to(job.device)
                    used.load_state_dict(encoder.state_dict())
                features = used(vertices)
                features.square().sum().backward()
                return features.detach()

            return run

        def gap(mine: Tensor, baseline: Tensor) -> float:
            return float((mine - baseline).abs().max() / baseline.abs().max())

        kinds = ("ours", "layers a neighbour", "torch's gathers", "indices anew")
        candidates = {kind: partial(prepare, kind) for kind in kinds}
        comparisons.append(Comparison("pointnet2", f"{label}, {frames} frames", candidates, "ours", gap))
    return comparisons
