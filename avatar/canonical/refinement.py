"""Refinement of a garment's mesh and skinning weights against posed scans, without a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import diags
from scipy.sparse.linalg import splu
from torch import Tensor

from avatar.body.skinning import skin_transforms
from avatar.checks import AvatarError
from avatar.geometry.laplacians import cotangent_laplacian, vertex_areas
from avatar.geometry.surface import interpolate, sample_surface
from avatar.geometry.transforms import transform_points
from avatar.geometry.trees import build_tree
from avatar.records import Mesh

HUBER = 0.02  # metres


@dataclass(frozen=True)
class PosedPoints:
    """Points of one posed scan, root frame: ``points (M, 3)`` metres, and its ``joint_transforms (J, 4, 4)``."""

    points: np.ndarray
    joint_transforms: Tensor


@dataclass
class RefineConfig:
    """How a template is refined by Chamfer against the scans it was made from."""

    steps: int = 60  # of Adam; 0 keeps the template as it is
    frames: int = 2  # scans a step
    samples: int = 8000  # points on the garment, and of a scan, a step
    rate: float = 0.003  # metres a step, before smoothing
    weight_rate: float = 0.02  # of the weights' logarithms a step, before smoothing
    length: float = 0.08  # metres over which every displacement and change of weights is smooth
    seed: int = 0  # of the samples

    def __post_init__(self):
        if min(self.steps, self.seed) < 0 or min(self.frames, self.samples) < 1:
            raise AvatarError("steps, seed: expected at least 0; frames, samples: at least 1.")
        if min(self.rate, self.weight_rate) < 0 or self.length <= 0:
            raise AvatarError("rate, weight_rate: expected at least 0; length: above 0.")


class SmoothFields:
    """Smooth fields on a mesh: ``(M + length^2 L)^-1 M`` of any field, with gradients.

    Gradient steps on what goes in are smooth steps of what comes out (large steps in inverse rendering, Nicolet et al.
    2021), which is what keeps a Chamfer distance from shredding the surface.
    """

    def __init__(self, mesh: Mesh, length: float):
        """Factorises the mesh's screened Laplacian once; ``length`` metres."""
        self.masses = np.maximum(vertex_areas(mesh.vertices, mesh.faces), 1e-12)
        stiffness = cotangent_laplacian(mesh.vertices, mesh.faces, positive=True)
        self.solver = splu((diags(self.masses) + length**2 * stiffness).tocsc())

    def __call__(self, values: Tensor) -> Tensor:
        """Fields ``(V, C)`` smoothed."""
        return _Smooth.apply(values, self)


class _Smooth(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, fields: SmoothFields) -> Tensor:
        ctx.fields = fields
        smoothed = fields.solver.solve(fields.masses[:, None] * values.double().numpy())
        return torch.from_numpy(smoothed).to(values.dtype)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        solved = ctx.fields.solver.solve(gradient.double().numpy())  # the system is symmetric
        return torch.from_numpy(ctx.fields.masses[:, None] * solved).to(gradient.dtype), None


def pose_mesh(
    vertices: Tensor, weights: Tensor, joint_transforms: Tensor, canonical_from_bind: Tensor | None
) -> Tensor:
    """Canonical vertices ``(V, 3)`` with weights ``(V, J)`` by LBS: ``(V, 3)``."""
    return transform_points(skin_transforms(weights, joint_transforms[None], canonical_from_bind)[0], vertices)


def chamfer(
    mesh: Mesh, weights: np.ndarray, scans: Sequence[PosedPoints], canonical_from_bind: Tensor | None, samples: int
) -> float:
    """Mean squared Chamfer distance, m^2, of a canonical mesh skinned by ``weights (V, J)`` to posed scans.

    Both directions added, over all scans, from ``samples`` points spread evenly on the mesh. Raises `AvatarError`
    without scans.
    """
    if not scans:
        raise AvatarError("scans: expected at least one to measure against, got none.")
    vertices, faces = torch.as_tensor(mesh.vertices).float(), torch.as_tensor(mesh.faces)
    values = torch.as_tensor(weights).float()
    errors = []
    for scan in scans:
        posed = pose_mesh(vertices, values, scan.joint_transforms, canonical_from_bind)
        places = sample_surface(posed, faces, samples, torch.Generator().manual_seed(0))
        points = interpolate(posed, places).numpy()
        forth, _ = build_tree(scan.points).query(points)
        back, _ = build_tree(points).query(scan.points)
        errors.append(np.square(forth).mean() + np.square(back).mean())
    return float(np.mean(errors))


def robust_squares(away: Tensor) -> Tensor:
    """Squared lengths of vectors ``(N, 3)`` that grow linearly beyond 2 cm (Huber's), ``(N,)`` m^2.

    Points that the garment has no part for (cloth turned up, skin taken for cloth) pull no harder for being far.
    """
    squares = away.square().sum(dim=1)
    lengths = squares.clamp(min=HUBER**2).sqrt()
    return torch.where(squares <= HUBER**2, squares, 2 * HUBER * lengths - HUBER**2)


@dataclass(frozen=True)
class Refined:
    """A refined mesh with its ``weights (V, J)``, and the loss of every step, m^2."""

    mesh: Mesh
    weights: np.ndarray
    losses: tuple[float, ...]


def refine(
    mesh: Mesh,
    weights: np.ndarray,
    scans: Sequence[PosedPoints],
    canonical_from_bind: Tensor | None,
    config: RefineConfig,
) -> Refined:
    """Vertices and weights moved, smoothly, so that the skinned mesh lies closer to the scans on average.

    Chamfer distance both ways between points of the garment and of the scans, a few scans a step. Displacements and
    changes of the weights' logarithms pass through `SmoothFields`. A static mesh cannot follow what a pose does to the
    cloth; what it can take from the scans is their mean over poses. Judge it by its looks as well: with little
    smoothing the same distance falls further and the surface is shredded. ``mesh`` is in the canonical pose, ``scans``
    hold the garment's points alone, rows of ``weights (V, J)`` sum to 1.
    """
    fields = SmoothFields(mesh, config.length)
    start, faces = torch.as_tensor(mesh.vertices).float(), torch.as_tensor(mesh.faces)
    logs = torch.log(torch.as_tensor(weights).float().clamp(min=1e-6))
    moved = torch.zeros_like(start, requires_grad=True)
    changed = torch.zeros_like(logs, requires_grad=True)
    optimiser = torch.optim.Adam(
        [{"params": [moved], "lr": config.rate}, {"params": [changed], "lr": config.weight_rate}]
    )
    generator, rng = torch.Generator().manual_seed(config.seed), np.random.default_rng(config.seed)
    losses = []
    for step in range(config.steps):
        for group, rate in zip(optimiser.param_groups, (config.rate, config.weight_rate)):
            group["lr"] = rate * min(1.0, 2 * (1 - step / config.steps))  # falls in the second half
        vertices, blend = start + fields(moved), (logs + fields(changed)).softmax(dim=1)
        loss = start.new_zeros(())
        chosen = rng.choice(len(scans), min(config.frames, len(scans)), replace=False)
        for index in chosen:
            scan = scans[index]
            posed = pose_mesh(vertices, blend, scan.joint_transforms, canonical_from_bind)
            places = sample_surface(posed.detach(), faces, config.samples, generator)
            points = interpolate(posed, places)
            some = scan.points[rng.permutation(len(scan.points))[: config.samples]]
            plain, target = points.detach().numpy(), torch.from_numpy(np.ascontiguousarray(some)).float()
            _, there = build_tree(some).query(plain)
            _, here = build_tree(plain).query(some)
            for away in (points - target[there], points[here] - target):
                loss = loss + robust_squares(away).mean() / len(chosen)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    with torch.no_grad():
        vertices, blend = start + fields(moved), (logs + fields(changed)).softmax(dim=1)
    return Refined(Mesh(vertices.numpy(), mesh.faces), blend.numpy(), tuple(losses))
