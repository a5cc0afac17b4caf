"""Registration of a body to scans: Gauss-Newton steps on robust, one-sided distances, from many starts.

smplfitter and anny's own inverter solve for the pose of a mesh whose vertices are known one by one; scans have no such
correspondences, so these are searched for in each step, as in iterative closest point methods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from avatar.body.families import BodyFamily
from avatar.body.model import SMPL_JOINTS
from avatar.checks import AvatarError, check_oriented
from avatar.fitting.posing import Fit, PosedFamily, left_jacobian
from avatar.fitting.prior import drawn_prior
from avatar.fitting.settings import FittingConfig, StageConfig
from avatar.geometry.surface import farthest_points
from avatar.geometry.trees import Tree, build_tree
from avatar.geometry.units import PERSON, possible_units
from avatar.records import PointCloud
from avatar.simulate.angles import SIDES, pose_from_angles

BARE = ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle", "left_foot", "right_foot")
FACING, AGREEING = 0.2, 0.5  # cosines between normals below which points are no pair, and from which they fully are
MOST_POINTS = 20_000  # of a scan that correspondences are searched in
START_ANGLES = (  # at ease, arms sideways, and arms and knees bent forward
    {},
    {"arm_abduction": 85, "elbow_flexion": 5},
    {"arm_flexion": 60, "hip_flexion": 40, "knee_flexion": 50},
)


@dataclass(frozen=True)
class ScanSamples:
    """A scan's points and normals ``(M, 3)`` in a random order, with a tree over both."""

    points: np.ndarray
    normals: np.ndarray
    tree: Tree  # of points and normals times `FittingConfig.normal_reach`


def check_scan(cloud: PointCloud, config: FittingConfig, name: str = "scan") -> None:
    """Refuses a scan that cannot be a person's in metres, y up, or has too few points or no unit normals.

    Raises `AvatarError` with the figure.
    """
    count = check_oriented(cloud.points, cloud.normals)["N"]
    if count < config.least_points:
        raise AvatarError(f"{name}: expected at least {config.least_points} points, got {count}.")
    lengths = np.linalg.norm(cloud.normals, axis=1)
    if (off := float(np.median(np.abs(lengths - 1)))) > 0.1:
        raise AvatarError(f"{name}: expected unit normals, got lengths off by {off:.3g} (median).")
    extent = float(np.ptp(cloud.points, axis=0).max())
    if not PERSON[0] <= extent <= PERSON[1]:
        units = " or ".join(possible_units(extent))
        hint = f" Hint: the unit may be {units}." if units else ""
        raise AvatarError(
            f"{name}: expected a person of {PERSON[0]} to {PERSON[1]} m, got a largest extent of {extent:.4g}.{hint}"
        )


def prepare_samples(cloud: PointCloud, config: FittingConfig) -> ScanSamples:
    """Samples of a scan, at most `MOST_POINTS`, the same for the same seed."""
    order = np.random.default_rng(config.seed).permutation(len(cloud.points))[:MOST_POINTS]
    points, normals = (np.asarray(array, np.float32)[order] for array in (cloud.points, cloud.normals))
    return ScanSamples(points, normals, build_tree(np.concatenate([points, config.normal_reach * normals], axis=1)))


@dataclass(frozen=True)
class Pairs:
    """Pairs of vertices ``ids (B, N)`` and scan points ``targets (B, N, 3)``, with the normals of where one searched.

    ``matched (B, N)`` in [0, 1] is how far the normals of both agree.
    """

    ids: Tensor
    targets: Tensor
    normals: Tensor
    matched: Tensor


@dataclass(frozen=True)
class Level:
    """A family's vertices that a stage looks at, spread over the body."""

    family: BodyFamily
    normals: Tensor  # (N, 3) at rest
    bare: Tensor  # (N,) bool, on head, hands and feet, where skin is what a scan shows


class Registration:
    """Fits of a family of bodies to scans: starts, stages and objectives."""

    def __init__(self, family: BodyFamily, config: FittingConfig):
        self.family, self.config = family, config
        self.joints = len(family.bind.parents)
        self.prior = drawn_prior(config.slack)
        self.levels: dict[int, Level] = {}

    @cached_property
    def order(self) -> Tensor:
        """Vertex ids of which the first n are spread over the body, for any n up to the largest stage's."""
        rest = self.family.rest(self.family.mean[None])[0][0]
        return farthest_points(rest, min(max(stage.points for stage in self.config.stages), len(rest)))

    def level(self, points: int) -> Level:
        """The first vertices of `order`, as a family of their own."""
        if points not in self.levels:
            ids, bare = self.order[:points], [SMPL_JOINTS.index(name) for name in BARE]
            family = self.family.at(ids)
            shown = family.bind.weights[:, bare].sum(dim=1) > 0.5
            self.levels[points] = Level(family, self.family.normals[ids], shown)
        return self.levels[points]

    def starts(self, scan: ScanSamples, shape: Tensor | None = None) -> Fit:
        """Fits of every start pose in every heading, the body's middle in the scan's."""
        config, poses = self.config, []
        for angles in START_ANGLES:
            both = {f"{side}_{name}": value for side, _ in SIDES for name, value in angles.items()}
            poses.append(torch.from_numpy(pose_from_angles(both, 1)))
        poses = torch.cat(poses).repeat(config.headings, 1, 1)
        turns = torch.arange(config.headings).repeat_interleave(len(START_ANGLES)) / config.headings
        poses[:, 0] = 0
        poses[:, 0, 1] = 2 * np.pi * (turns - turns.round())
        shape = (self.family.mean if shape is None else shape).expand(len(poses), -1).clone()
        fit = Fit(poses, torch.zeros(len(poses), 3), shape)
        middle = PosedFamily(self.level(config.stages[0].points).family, fit).points().median(dim=1).values
        return Fit(poses, torch.from_numpy(np.median(scan.points, axis=0)) - middle, shape)

    def fit_one(self, scan: ScanSamples, shape: Tensor | None = None, start: Fit | None = None) -> tuple[Fit, float]:
        """The best fit of one body to a scan, and its objective in the last stage.

        From many headings and poses or, where there is a ``start`` of one body, from there without the first stage.
        The shape is estimated as well where none is given.
        """
        fit = self.starts(scan, shape) if start is None else start
        stages = self.config.stages if start is None else self.config.stages[1:] or self.config.stages
        for stage in stages:
            fit, objective = self.run(fit, [scan] * len(fit), stage, with_shape=shape is None)
            best = objective.argsort()[: stage.kept]
            fit, objective = fit[best], objective[best]
        return fit[:1], float(objective[0])

    def fit_shape(self, scans: Sequence[ScanSamples], fit: Fit) -> Fit:
        """Fits with one shape for all scans, from the median of their shapes, over the last two stages."""
        fit = Fit(fit.pose, fit.translation, fit.shape.median(dim=0).values.expand_as(fit.shape).clone())
        for stage in self.config.stages[-2:]:
            fit, _ = self.run(fit, scans, stage, shared=True)
        return fit

    def run(
        self, fit: Fit, scans: Sequence[ScanSamples], stage: StageConfig, with_shape: bool = True, shared: bool = False
    ) -> tuple[Fit, Tensor]:
        """The fits after the steps of a stage, each to its scan, and their objectives ``(B,)``.

        Correspondences are new in each step, so a step may raise the objective, as in any iterative closest point
        method; damping keeps it short. ``shared``: all bodies have one shape.
        """
        numbers = len(self.family.names) if with_shape else 0
        for _ in range(stage.steps):
            hessian, gradient, _ = self.normal_equations(fit, scans, stage, numbers, shared)
            hessian = hessian + self.config.damping * torch.eye(hessian.shape[1])
            change = self.solve(fit.shape, hessian.double(), gradient.double(), numbers, shared)
            fit = self.moved(fit, change.float(), numbers)
        return fit, self.normal_equations(fit, scans, stage, 0, shared)[2]

    def normal_equations(
        self, fit: Fit, scans: Sequence[ScanSamples], stage: StageConfig, numbers: int, shared: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Hessians ``(B, P, P)``, descents ``(B, P)`` and objectives ``(B,)`` of data and priors.

        The P unknowns are 3 J of the pose, 3 of the place and some ``numbers`` of the shape.
        """
        config, level = self.config, self.level(stage.points)
        posed = PosedFamily(level.family, fit)
        system = self.priors(fit, posed, numbers, 1 / len(fit) if shared else 1.0)
        plane, along = (1 - config.tangential) ** 0.5, config.tangential**0.5
        for pairs in find_pairs(posed, level, scans, stage, config):
            offsets = pairs.targets - posed.points_of(pairs.ids)
            across = (offsets * pairs.normals).sum(dim=-1, keepdim=True)
            weight, cost = self.robust(offsets, across[..., 0], pairs, level, stage)
            scale = config.effective / 2 / weight.shape[1] / stage.sigma**2
            jacobian = posed.jacobian(pairs.ids, numbers > 0)
            rows = torch.cat(
                [plane * (jacobian * pairs.normals.unsqueeze(-1)).sum(dim=2, keepdim=True), along * jacobian], dim=2
            )
            root = (scale * weight).sqrt().unsqueeze(-1)
            rows = (rows * root.unsqueeze(-1)).flatten(1, 2)
            residual = (torch.cat([plane * across, along * offsets], dim=-1) * root).flatten(1, 2)
            add_rows(system, rows, residual, scale * cost.sum(dim=1))
        return system

    def robust(
        self, offsets: Tensor, across: Tensor, pairs: Pairs, level: Level, stage: StageConfig
    ) -> tuple[Tensor, Tensor]:
        """Weights in least squares and robust costs ``(B, N)``, square metres, of pairs.

        Geman and McClure's loss of the distance, mostly that across the surface. One-sided: where clothes are worn,
        scan points outside the skin, away from head, hands and feet, cost a part of what those inside cost, and
        nothing more once they are well beyond the stage's ``cloth``. Pairs whose normals disagree cost as much as far
        ones.
        """
        config = self.config
        squared = (1 - config.tangential) * across.square() + config.tangential * offsets.square().sum(dim=-1)
        scale, base = torch.full_like(across, stage.reach), torch.ones_like(across)
        if config.clothing:
            over = (across > 0) & ~level.bare[pairs.ids]
            scale, base = torch.where(over, stage.cloth, scale), torch.where(over, config.outside, base)
        known = scale**2 / (scale**2 + squared)
        cost = squared * known * pairs.matched + scale**2 * (1 - pairs.matched)
        return base * known.square() * pairs.matched, base * cost

    def priors(self, fit: Fit, posed: PosedFamily, numbers: int, share: float) -> tuple[Tensor, Tensor, Tensor]:
        """Normal equations and objectives of the priors of pose, upright pelvis and, with a ``share`` of it, shape."""
        size = 3 * self.joints + 3
        system = (
            torch.zeros(len(fit), size + numbers, size + numbers),
            torch.zeros(len(fit), size + numbers),
            torch.zeros(len(fit)),
        )
        hessian, descent, objective = system
        inner, outer = slice(3, 3 * self.joints), slice(size, None)
        off = self.prior.mean - fit.pose[:, 1:].flatten(1)
        pull = off @ self.prior.precision
        hessian[:, inner, inner] += self.prior.precision
        descent[:, inner] += pull
        objective += (pull * off).sum(dim=1)
        up = posed.rotations[:, 0, :, 1]
        turning = torch.linalg.cross(left_jacobian(fit.pose[:, 0]).transpose(-1, -2), up.unsqueeze(1), dim=-1)
        rows = torch.zeros(len(fit), 2, size + numbers)
        rows[..., :3] = turning[..., [0, 2]].transpose(-1, -2) / self.config.tilt
        residual = -up[:, [0, 2]] / self.config.tilt
        add_rows(system, rows, residual, residual.square().sum(dim=1))
        off = (self.family.mean - fit.shape) / self.family.std
        objective += share * off.square().sum(dim=1)
        if numbers:
            hessian[:, outer, outer] += share * torch.diag(self.family.std**-2)
            descent[:, outer] += share * off / self.family.std
        return system

    def solve(self, shape: Tensor, hessian: Tensor, descent: Tensor, numbers: int, shared: bool) -> Tensor:
        """Changes ``(B, P)`` that minimise the quadratic models, with the shapes within their bounds.

        Poses are eliminated first (Schur's complement). Shape numbers that would leave their bounds stop there, and
        the others are solved for again.
        """
        size = hessian.shape[1] - numbers
        inner, cross = hessian[:, :size, :size], hessian[:, :size, size:]
        solved = torch.linalg.solve(inner, torch.cat([descent[:, :size, None], cross], dim=-1))
        if not numbers:
            return solved[..., 0]
        reduced = hessian[:, size:, size:] - cross.transpose(1, 2) @ solved[..., 1:]
        right = descent[:, size:] - (cross.transpose(1, 2) @ solved[..., :1])[..., 0]
        if shared:
            reduced, right = (part.sum(dim=0, keepdim=True).expand_as(part) for part in (reduced, right))
        change = torch.linalg.solve(reduced, right)
        bounded = (shape + change).clamp(self.family.low, self.family.high) - shape
        held = ((bounded - change).abs() > 1e-9).double()
        fixed, free = bounded * held, 1 - held
        reduced_free = reduced * free.unsqueeze(1) * free.unsqueeze(2) + torch.diag_embed(held)
        rest = (right - (reduced @ fixed.unsqueeze(-1))[..., 0]) * free
        change = torch.linalg.solve(reduced_free, rest) + fixed
        pose = solved[..., 0] - (solved[..., 1:] @ change.unsqueeze(-1))[..., 0]
        return torch.cat([pose, change], dim=1)

    def moved(self, fit: Fit, change: Tensor, numbers: int) -> Fit:
        """Fits after changes ``(B, P)``, those of pose and place shortened where too long; the root's turn below pi."""
        size = 3 * self.joints + 3
        longest = change[:, :size].abs().max(dim=1, keepdim=True).values
        change = change * (self.config.longest_step / longest.clamp(min=self.config.longest_step))
        pose = fit.pose + change[:, : size - 3].unflatten(1, (self.joints, 3))
        angle = pose[:, :1].norm(dim=-1, keepdim=True)
        root = torch.where(angle > np.pi, pose[:, :1] * (1 - 2 * np.pi / angle.clamp(min=1e-6)), pose[:, :1])
        shape = fit.shape
        if numbers:
            shape = (shape + change[:, size:]).clamp(self.family.low, self.family.high)
        return Fit(torch.cat([root, pose[:, 1:]], dim=1), fit.translation + change[:, size - 3 : size], shape)


def add_rows(system: tuple[Tensor, Tensor, Tensor], rows: Tensor, residual: Tensor, cost: Tensor) -> None:
    """Adds the rows ``(B, R, P)`` of a least squares problem, and its cost ``(B,)``, to normal equations in place."""
    hessian, descent, objective = system
    hessian += rows.transpose(1, 2) @ rows
    descent += (rows.transpose(1, 2) @ residual.unsqueeze(-1)).squeeze(-1)
    objective += cost


def find_pairs(
    posed: PosedFamily, level: Level, scans: Sequence[ScanSamples], stage: StageConfig, config: FittingConfig
) -> tuple[Pairs, Pairs]:
    """The nearest vertex of each scan sample and the nearest scan point of each vertex, by place and normal.

    Normals in the pairs are those of what was found: the vertices' first, then the scan points'.
    """
    points, normals = posed.points(), posed.normals(level.normals)
    described = torch.cat([points, config.normal_reach * normals], dim=-1).numpy()
    places, found, targets, seen = [], [], [], []
    for place, scan in enumerate(scans):
        sampled, facing = scan.points[: stage.points], scan.normals[: stage.points]
        nearest = build_tree(described[place]).query(np.concatenate([sampled, config.normal_reach * facing], axis=1))[1]
        places.append(torch.from_numpy(nearest))
        found.append((sampled, facing))
        nearest = scan.tree.query(described[place])[1]
        targets.append(scan.points[nearest])
        seen.append(scan.normals[nearest])
    ids = torch.stack(places)
    own = torch.gather(normals, 1, ids.unsqueeze(-1).expand(-1, -1, 3))
    sampled, facing = (torch.from_numpy(np.stack(part)) for part in zip(*found))
    outward = torch.from_numpy(np.stack(seen))
    every = torch.arange(points.shape[1]).expand(len(points), -1)
    return (
        Pairs(ids, sampled, own, agreement(own, facing)),
        Pairs(every, torch.from_numpy(np.stack(targets)), outward, agreement(normals, outward)),
    )


def agreement(first: Tensor, second: Tensor) -> Tensor:
    """How far unit normals ``(..., 3)`` agree: 0 from `FACING` downwards and 1 from `AGREEING` upwards."""
    return (((first * second).sum(dim=-1) - FACING) / (AGREEING - FACING)).clamp(0, 1)
