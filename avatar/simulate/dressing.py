"""A dressed body: garments in layers, led from the bind pose to any pose and held there until they rest."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from avatar.body.model import BodyModel
from avatar.body.open import open_body
from avatar.body.packed import packed_body
from avatar.body.skinning import blend_transforms
from avatar.checks import AvatarError, DataError, check_finite, check_shape
from avatar.geometry.surface import vertex_normals
from avatar.geometry.transforms import axis_angle_from_rotation, rotation_from_axis_angle, transform_points
from avatar.geometry.trees import build_tree
from avatar.simulate.garments import Garment, cut_garment
from avatar.simulate.level_sets import smoothing_matrix
from avatar.simulate.mesh_queries import lift_off, tuck
from avatar.simulate.outfits import OutfitConfig
from avatar.simulate.solver import ClothSolver, SolverConfig

CLING_GAP = (0.02, 0.045)  # m between cloth and skin over which its cling to the skin fades out
WAISTBAND_STIFFNESS = 3.0  # N/m a vertex: an elastic waistband stays where it is put
COVERED_GAP = 0.05  # m: skin nearer than this to a garment is under it
LEAST_GAP = 0.001  # m kept between all cloth and skin at the end
PLAY_STEPS = 4  # fewest steps from one frame of a continuous motion to the next


@dataclass
class TravelConfig:
    """How a body is led to a pose."""

    stride: float = 0.015  # m: no part of the body moves farther in one step
    hold: int = 90  # most steps held at the target
    least_hold: int = 20  # fewest
    rest_speed: float = 1e-4  # m a step: the 99th percentile of vertex ways at which cloth counts as resting
    solver: SolverConfig = field(default_factory=SolverConfig)


@dataclass(frozen=True)
class Layer:
    """A garment on its body: its ``solver`` and anchor weights ``(V, J)``.

    ``lift (V,)`` is how far the body's vertices move out for the inner garments, metres; ``part`` are the garment's
    vertices among those of the outfit.
    """

    garment: Garment
    solver: ClothSolver
    weights: torch.Tensor
    lift: torch.Tensor
    part: slice


@dataclass(frozen=True)
class Rest:
    """Cloth at the end of a travel: ``cloth (V, 3)`` metres, ``speed`` m a step (99th percentile)."""

    cloth: np.ndarray
    speed: float


def bind_pose(body: BodyModel) -> np.ndarray:
    """Pose parameters ``(J, 3)`` that put a body into its bind pose, relative to the T-pose."""
    world = body.zero_from_bind[:, :3, :3].double().transpose(1, 2)
    local = [world[0]] + [world[p].T @ world[j] for j, p in enumerate(body.parents) if j]
    return axis_angle_from_rotation(torch.stack(local)).float().numpy()


def pose_path(start: np.ndarray, end: np.ndarray, count: int) -> np.ndarray:
    """Poses ``(count, J, 3)`` on the geodesic of every joint, eased in and out, without the start itself."""
    a = rotation_from_axis_angle(torch.as_tensor(start, dtype=torch.float64))
    b = rotation_from_axis_angle(torch.as_tensor(end, dtype=torch.float64))
    turn = axis_angle_from_rotation(a.transpose(1, 2) @ b)
    t = torch.arange(1, count + 1, dtype=torch.float64) / count
    eased = t * t * (3 - 2 * t)
    return axis_angle_from_rotation(a @ rotation_from_axis_angle(eased[:, None, None] * turn)).float().numpy()


def subject(shape: str) -> BodyModel:
    """The open body in one of its shapes, or a body of its topology from a file of tools/make_body.py.

    Raises `DataError` for a damaged file or a body of another topology.
    """
    if not shape.endswith(".npz"):
        return open_body(shape)
    body = packed_body(Path(shape))
    if not torch.equal(body.faces, open_body().faces):
        raise DataError(Path(shape), "faces: expected those of the open body.", "Make it with tools/make_body.py.")
    return body


class DressedBody:
    """A body in an outfit, with everything prepared that does not depend on the pose."""

    def __init__(self, outfit: OutfitConfig, travel: TravelConfig | None = None):
        """Cuts the garments, settles them in the bind pose and keeps that as the start of every travel."""
        self.body, self.outfit, self.travel = subject(outfit.shape), outfit, travel or TravelConfig()
        self.garments = [cut_garment(self.body, config) for config in outfit.garments]
        sizes = [len(g.vertices) for g in self.garments]
        self.offsets = np.concatenate([[0], np.cumsum(sizes)])
        self.faces = np.concatenate([g.faces + o for g, o in zip(self.garments, self.offsets)])
        self.labels = np.repeat(np.arange(1, len(sizes) + 1), sizes).astype(np.uint8)
        self.start_pose = bind_pose(self.body)
        self.layers = self.make_layers()
        self.start = np.concatenate([g.vertices for g in self.garments])
        self.start = self.run(self.start_pose[None]).cloth

    def make_layers(self) -> list[Layer]:
        """Anchors, colliders and solvers of all garments, the innermost first."""
        vertices, faces = self.body.bind_vertices.numpy(), self.body.faces.numpy()
        lift = np.zeros(len(vertices))
        spread, _ = smoothing_matrix(faces, len(vertices))
        layers = []
        for garment, start in zip(self.garments, self.offsets):
            config, points = garment.config, garment.vertices
            gap, ids = build_tree(vertices).query(points)
            average, rim = smoothing_matrix(garment.faces, len(points))
            weights = self.body.weights.numpy()[ids].astype(np.float64)
            for _ in range(5):
                weights = 0.5 * weights + 0.5 * (average @ weights)
            stiffness = config.cling * np.clip((CLING_GAP[1] - gap) / (CLING_GAP[1] - CLING_GAP[0]), 0, 1)
            if config.waistband:
                stiffness[points[:, 1] > points[:, 1].max() - config.waistband] = WAISTBAND_STIFFNESS
            solver = ClothSolver(points, garment.faces, config.fabric, vertices, faces, stiffness, self.travel.solver)
            part = slice(int(start), int(start) + len(points))
            lifted = torch.from_numpy(lift).float()
            layers.append(Layer(garment, solver, torch.from_numpy(weights).float(), lifted, part))
            away, nearest = build_tree(points).query(vertices)
            lift = lift + config.bulk * ((away < COVERED_GAP) & ~rim[nearest])
            for _ in range(10):
                lift = spread @ lift
        return layers

    def under(self, layer: Layer, body_points: torch.Tensor) -> np.ndarray:
        """What a layer rests on: posed body vertices ``(T, V, 3)``, moved out where inner garments lie."""
        if not layer.lift.any():
            return body_points.numpy()
        normals = vertex_normals(body_points, self.body.faces)
        return (body_points + layer.lift[:, None] * normals).numpy()

    def posed_body(self, poses: np.ndarray) -> np.ndarray:
        """Body vertices ``(T, V, 3)`` in poses ``(T, J, 3)``."""
        return self.body(torch.as_tensor(poses, dtype=torch.float32)).vertices.numpy()

    def settle(self, pose: np.ndarray, stride: float | None = None, via: Sequence[np.ndarray] = ()) -> Rest:
        """The outfit at rest in a pose ``(J, 3)``, reached from the bind pose, by way of the poses ``via`` in order.

        No body vertex moves farther than ``stride`` metres in one step; the configured one if None. Raises
        `AvatarError` for a pose of another shape or not finite, and where the solver diverges.
        """
        check_shape("pose", pose, "J 3", J=len(self.body.parents))
        check_finite("pose", pose)
        stops = itertools.pairwise([self.start_pose, *via, pose])
        return self.run(np.concatenate([self.leg(a, b, stride or self.travel.stride) for a, b in stops]))

    def leg(self, start: np.ndarray, end: np.ndarray, stride: float, least: int = 2) -> np.ndarray:
        """Poses from one stop to the next, as many as the farthest-moving vertex needs."""
        sketch = self.posed_body(np.concatenate([start[None], pose_path(start, end, 8)]))
        way = np.linalg.norm(np.diff(sketch, axis=0), axis=-1).max(1).sum()
        return pose_path(start, end, max(least, int(np.ceil(1.5 * way / stride))))

    def run(self, poses: np.ndarray) -> Rest:
        """Leads the outfit along poses, then holds the last one until the cloth rests, layer by layer."""
        posed = self.body(torch.as_tensor(np.concatenate([self.start_pose[None], poses]), dtype=torch.float32))
        motions = posed.joint_transforms[1:] @ self.body.zero_from_bind
        cloth, speed = self.start.copy(), 0.0
        for layer in self.layers:
            under = self.under(layer, posed.vertices)
            layer.solver.reset(self.start[layer.part], under[0])
            self.follow(layer, under[1:], motions, self.travel.hold)
            cloth[layer.part] = layer.solver.positions
            speed = max(speed, float(np.percentile(layer.solver.moved, 99)))
        if not np.isfinite(cloth).all():
            raise AvatarError(f"outfit {self.outfit.name!r}: the solver diverged; use a smaller stride.")
        return Rest(self.in_order(cloth, posed.vertices[-1].numpy()), speed)

    def play(self, poses: np.ndarray) -> np.ndarray:
        """Cloth ``(T, V, 3)`` over a continuous motion ``(T, J, 3)``: settled in its first pose, then following."""
        check_shape("poses", poses, "T J 3", J=len(self.body.parents))
        check_finite("poses", poses)
        self.settle(poses[0])
        legs = [poses[:1]] + [self.leg(a, b, self.travel.stride, PLAY_STEPS) for a, b in itertools.pairwise(poses)]
        cloth = np.zeros((len(poses), len(self.start), 3), np.float32)
        for layer in self.layers:
            for frame, leg in enumerate(legs):
                posed = self.body(torch.as_tensor(leg, dtype=torch.float32))
                motions = posed.joint_transforms @ self.body.zero_from_bind
                self.follow(layer, self.under(layer, posed.vertices), motions)
                cloth[frame, layer.part] = layer.solver.positions
        return np.stack([self.in_order(c, b) for c, b in zip(cloth, self.posed_body(poses))])

    def in_order(self, cloth: np.ndarray, body_points: np.ndarray) -> np.ndarray:
        """The outfit's cloth with inner garments under outer ones, outside the body."""
        for above in range(len(self.layers) - 1, 0, -1):
            outer = self.layers[above]
            for inner in self.layers[:above]:
                cloth[inner.part] = tuck(cloth[inner.part], cloth[outer.part], outer.garment.faces)
        return lift_off(cloth, body_points, self.body.faces.numpy(), LEAST_GAP)

    def follow(self, layer: Layer, under: np.ndarray, motions: torch.Tensor, hold: int = 0) -> None:
        """Leads one layer through colliders ``(T, V, 3)`` and holds it at the last until it rests."""
        rest, solver = torch.as_tensor(layer.garment.vertices, dtype=torch.float32), layer.solver
        for points, motion in zip(under, motions):
            anchors = transform_points(blend_transforms(layer.weights, motion[None])[0], rest).numpy()
            solver.step(points, anchors)
        for held in range(hold):
            solver.step(under[-1], anchors, float(np.clip(2 - 2 * held / hold, 0.1, 1.0)))
            if held >= self.travel.least_hold and np.percentile(solver.moved, 99) < self.travel.rest_speed:
                break
