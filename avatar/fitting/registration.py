"""Registration of a body to one scan or several: Gauss-Newton on robust, one-sided distances, from many starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avatar.body.families import BodyFamily
from avatar.body.model import SMPL_JOINTS
from avatar.fitting.posing import Fit, PosedFamily, joint_descendants, left_jacobian, skin, where
from avatar.fitting.prior import drawn_prior
from avatar.fitting.settings import FittingConfig, StageConfig
from avatar.geometry.surface import farthest_points
from avatar.geometry.trees import Tree, build_tree
from avatar.records import PointCloud
from avatar.simulate.angles import pose_from_angles

BARE = ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle", "left_foot", "right_foot")
FACING = 0.2  # cosine between normals below which two points are no pair
START_ANGLES = (  # at ease, arms sideways, and raised before the trunk
    {},
    {"left_arm_abduction": 85, "right_arm_abduction": 85, "left_elbow_flexion": 5, "right_elbow_flexion": 5},
    {"left_arm_flexion": 60, "right_arm_flexion": 60, "left_hip_flexion": 40, "right_hip_flexion": 40,
     "left_knee_flexion": 50, "right_knee_flexion": 50},
)


@dataclass(frozen=True)
class ScanSamples:
    """A scan prepared for registration: all points with a tree over points and normals, in a random order."""

    points: np.ndarray  # (M, 3) float32
    normals: np.ndarray  # (M, 3)
    tree: Tree  # of points and normals times the reach


def prepare_samples(cloud: PointCloud, config: FittingConfig, most: int = 20_000) -> ScanSamples:
    """Samples of a scan, at most so many, the same for the same seed."""
    order = np.random.default_rng(config.seed).permutation(len(cloud.points))[:most]
    points, normals = (np.asarray(a, np.float32)[order] for a in (cloud.points, cloud.normals))
    return ScanSamples(points, normals, build_tree(np.concatenate([points, config.normal_reach * normals], axis=1)))


@dataclass
class Pairs:
    """Corresponding points of B scans and bodies: vertices ``ids (B, N)``, targets, normals and weights."""

    ids: Tensor
    targets: Tensor
    normals: Tensor
    outward: float  # 1 where the normals are the body's, -1 where they are the scan's
    matched: Tensor  # (B, N) in [0, 1], by the normals' agreement


class Registration:
    """The objective of B fits to scans, each to one of them, and its Gauss-Newton steps."""

    def __init__(self, family: BodyFamily, scans: list[ScanSamples], config: FittingConfig):
        self.family, self.scans, self.config = family, scans, config
        self.descendants = joint_descendants(family.bind.parents)
        self.prior = drawn_prior(config.slack)
        self.rest_normals = family.normals
        rest = family.rest(family.mean[None])[0][0]
        most = max(stage.points for stage in config.stages)
        self.order = body_order(rest, min(most, len(rest)))
        bare = [SMPL_JOINTS.index(name) for name in BARE]
        self.bare = family.bind.weights[:, bare].sum(dim=1) > 0.5

    def starts(self, scan: int, shape: Tensor | None = None) -> Fit:
        """Fits of every start heading and pose, the body's middle in the scan's."""
        config = self.config
        poses = torch.from_numpy(np.concatenate([pose_from_angles(angles, 1) for angles in START_ANGLES]))
        poses[:, 0] = 0
        fits = []
        shape = self.family.mean if shape is None else shape
        for number in range(config.headings):
            turned = poses.clone()
            turned[:, 0, 1] = 2 * np.pi * number / config.headings
            turned[:, 0, 1] = (turned[:, 0, 1] + np.pi) % (2 * np.pi) - np.pi
            fits.append(turned)
        poses = torch.cat(fits)
        fit = Fit(poses, torch.zeros(len(poses), 3), shape.expand(len(poses), -1).clone())
        middle = PosedFamily(self.family, fit, self.descendants).points(self.order[:500]).median(dim=1).values
        target = torch.from_numpy(np.median(self.scans[scan].points, axis=0))
        return Fit(fit.pose, target - middle, fit.shape)

    def pairs(self, posed: PosedFamily, which: list[int], stage: StageConfig) -> tuple[Pairs, Pairs]:
        """Correspondences from the scan's samples to vertices and back."""
        config = self.config
        ids = self.order[: stage.points]
        points, normals = posed.points(ids), posed.normals(self.rest_normals, ids)
        described = torch.cat([points, config.normal_reach * normals], dim=-1).numpy()
        to_body, to_scan = [], []
        for place, scan in enumerate(which):
            samples = self.scans[scan]
            count = stage.points
            seen = np.concatenate([samples.points[:count], config.normal_reach * samples.normals[:count]], axis=1)
            nearest = build_tree(described[place]).query(seen)[1]
            to_body.append((ids[nearest], samples.points[:count], samples.normals[:count], normals[place][nearest]))
            nearest = samples.tree.query(described[place])[1]
            to_scan.append((samples.points[nearest], samples.normals[nearest]))
        targets = torch.from_numpy(np.stack([found[1] for found in to_body]))
        seen = torch.from_numpy(np.stack([found[2] for found in to_body]))
        vertex_normals = torch.stack([found[3] for found in to_body])
        agreement = (vertex_normals * seen).sum(dim=-1)
        first = Pairs(torch.stack([f[0] for f in to_body]), targets, vertex_normals, 1.0, matched(agreement))
        targets = torch.from_numpy(np.stack([found[0] for found in to_scan]))
        seen = torch.from_numpy(np.stack([found[1] for found in to_scan]))
        agreement = (normals * seen).sum(dim=-1)
        second = Pairs(ids.expand(len(which), -1), targets, seen, -1.0, matched(agreement))
        return first, second

    def terms(self, posed: PosedFamily, pairs: Pairs, stage: StageConfig) -> tuple[Tensor, Tensor, Tensor]:
        """Offsets ``(B, N, 3)`` of targets from vertices, weights of least squares and robust costs ``(B, N)``."""
        config = self.config
        weights = self.family.bind.weights[pairs.ids]
        rest = torch.gather(posed.rest, 1, pairs.ids.unsqueeze(-1).expand(-1, -1, 3))
        offsets = pairs.targets - skin(weights, posed.bones, rest)
        across = (offsets * pairs.normals).sum(dim=-1)
        squared = (1 - config.tangential) * across.square() + config.tangential * offsets.square().sum(dim=-1)
        scale, base = torch.full_like(across, stage.reach), torch.full_like(across, config.inside)
        if config.clothing:
            over = (across > 0) & ~self.bare[pairs.ids]
            scale, base = torch.where(over, stage.cloth, scale), torch.where(over, config.outside, base)
        known = scale**2 / (scale**2 + squared)
        weight = base * known.square() * pairs.matched
        cost = base * (squared * known * pairs.matched + scale**2 * (1 - pairs.matched))
        return offsets, weight, cost

    def normal_equations(self, fit: Fit, which: list[int], stage: StageConfig, with_shape: bool):
        """Hessians ``(B, P, P)``, gradients ``(B, P)`` and objectives ``(B,)`` of the data and the priors."""
        config, batch = self.config, len(fit)
        posed = PosedFamily(self.family, fit, self.descendants)
        joints = len(self.family.bind.parents)
        sizes = 3 * joints + 3 + (len(self.family.names) if with_shape else 0)
        hessian, gradient = torch.zeros(batch, sizes, sizes), torch.zeros(batch, sizes)
        objective = torch.zeros(batch)
        for pairs in self.pairs(posed, which, stage):
            offsets, weight, cost = self.terms(posed, pairs, stage)
            scale = config.effective / 2 / weight.shape[1] / stage.sigma**2
            jacobian = posed.jacobian(pairs.ids, with_shape)
            across = (jacobian * pairs.normals.unsqueeze(-1)).sum(dim=2, keepdim=True)
            plane, along = (1 - config.tangential) ** 0.5, config.tangential**0.5
            rows = torch.cat([plane * across, along * jacobian], dim=2)
            residual = torch.cat(
                [plane * (offsets * pairs.normals).sum(dim=-1, keepdim=True), along * offsets], dim=-1
            )
            root = (scale * weight).sqrt()
            rows = (rows * root[..., None, None]).flatten(1, 2)
            residual = (residual * root[..., None]).flatten(1, 2)
            hessian += rows.transpose(1, 2) @ rows
            gradient += (rows.transpose(1, 2) @ residual.unsqueeze(-1)).squeeze(-1)
            objective += scale * cost.sum(dim=1)
        self.add_priors(fit, posed, hessian, gradient, objective, with_shape)
        return hessian, gradient, objective

    def add_priors(self, fit: Fit, posed: PosedFamily, hessian, gradient, objective, with_shape: bool) -> None:
        """Adds pose, tilt and shape priors in place."""
        config = self.config
        joints = len(self.family.bind.parents)
        inner = slice(3, 3 * joints)
        off = self.prior.mean - fit.pose[:, 1:].flatten(1)
        pull = off @ self.prior.precision
        hessian[:, inner, inner] += config.pose_weight * self.prior.precision
        gradient[:, inner] += config.pose_weight * pull
        objective += config.pose_weight * (pull * off).sum(dim=1)
        up = posed.rotations[:, 0, :, 1]
        turning = torch.linalg.cross(left_jacobian(fit.pose[:, 0]).transpose(-1, -2), up.unsqueeze(1), dim=-1)
        rows = turning[..., [0, 2]].transpose(-1, -2) / config.tilt  # (B, 2, 3)
        residual = -up[:, [0, 2]] / config.tilt
        hessian[:, :3, :3] += rows.transpose(1, 2) @ rows
        gradient[:, :3] += (rows.transpose(1, 2) @ residual.unsqueeze(-1)).squeeze(-1)
        objective += residual.square().sum(dim=1) + torch.where(up[:, 1] < 0, 10.0, 0.0)
        if len(self.family.names):
            off = (self.family.mean - fit.shape) / self.family.std
            objective += config.shape_weight * off.square().sum(dim=1)
            if with_shape:
                outer = slice(3 * joints + 3, None)
                hessian[:, outer, outer] += config.shape_weight * torch.diag(self.family.std**-2)
                gradient[:, outer] += config.shape_weight * off / self.family.std

    def run(self, fit: Fit, which: list[int], stage: StageConfig, with_shape: bool = True) -> tuple[Fit, Tensor]:
        """The fits after the steps of a stage, and their objectives.

        Correspondences are new in each step, so a step may raise the objective (as in any iterative closest point
        method); damping keeps it short.
        """
        for _ in range(stage.steps):
            hessian, gradient, _ = self.normal_equations(fit, which, stage, with_shape)
            damped = hessian + self.config.damping * torch.eye(hessian.shape[1])
            fit = self.moved(fit, self.solve(fit, damped, gradient, with_shape), with_shape)
        return fit, self.normal_equations(fit, which, stage, with_shape=False)[2]

    def solve(self, fit: Fit, hessian: Tensor, gradient: Tensor, with_shape: bool) -> Tensor:
        """Changes ``(B, P)`` that minimise the quadratic models with the shapes within their bounds.

        Shape numbers that would leave their bounds stop there, and the others are solved for again.
        """
        hessian, gradient = hessian.double(), gradient.double()
        change = torch.linalg.solve(hessian, gradient)
        if not with_shape or not self.family.names:
            return change.float()
        outer = slice(hessian.shape[1] - len(self.family.names), None)
        wanted = fit.shape + change[:, outer]
        held = torch.zeros_like(gradient)
        held[:, outer] = (wanted.clamp(self.family.low, self.family.high) != wanted).double()
        fixed = torch.zeros_like(gradient)
        fixed[:, outer] = wanted.clamp(self.family.low, self.family.high) - fit.shape
        fixed = fixed * held
        free = 1 - held
        rest = gradient - (hessian @ fixed.unsqueeze(-1)).squeeze(-1)
        reduced = hessian * free.unsqueeze(1) * free.unsqueeze(2) + torch.diag_embed(held)
        return (torch.linalg.solve(reduced, rest * free) + fixed).float()

    def moved(self, fit: Fit, change: Tensor, with_shape: bool) -> Fit:
        """Fits after a change ``(B, P)``, too long ones shortened, shapes within their bounds."""
        joints = len(self.family.bind.parents)
        longest = change[:, : 3 * joints + 3].abs().max(dim=1, keepdim=True).values
        change = change * (self.config.longest_step / longest.clamp(min=self.config.longest_step))
        pose = fit.pose + change[:, : 3 * joints].unflatten(1, (joints, 3))
        angle = pose[:, :1].norm(dim=-1, keepdim=True)
        root = torch.where(angle > np.pi, pose[:, :1] * (1 - 2 * np.pi / angle.clamp(min=1e-6)), pose[:, :1])
        pose = torch.cat([root, pose[:, 1:]], dim=1)
        translation = fit.translation + change[:, 3 * joints : 3 * joints + 3]
        shape = fit.shape
        if with_shape and len(self.family.names):
            shape = (shape + change[:, 3 * joints + 3 :]).clamp(self.family.low, self.family.high)
        return Fit(pose, translation, shape)


def matched(agreement: Tensor) -> Tensor:
    """How far normals agree, 0 from `FACING` downwards and 1 from 60 degrees on."""
    return ((agreement - FACING) / (0.5 - FACING)).clamp(0, 1)


def body_order(vertices: Tensor, count: int) -> Tensor:
    """Vertex ids ``(count,)`` of which the first n are spread over the body, for any n."""
    return farthest_points(vertices, count)
