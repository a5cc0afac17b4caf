"""Poses from posed vertices: the pose and translation that a body's own mesh has in each of its frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from avatar.body.model import BodyModel
from avatar.checks import check_finite, check_shape

RIDGE = 1e-6  # of the mean joint's weight: pulls a joint's motion to its parent's where its vertices leave it open
STEPS = 30
EXACT = 5e-7  # metres, root mean square: what float32 leaves
CONVERGED = 1e-5  # of the residual, by which a step lowers it
DAMPING = 1e-9  # of the largest diagonal entry


@dataclass(frozen=True)
class SolvedPoses:
    """Poses of a body that fit given vertices: ``poses (B, J, 3)`` radians, ``translations (B, 3)`` metres, float32.

    ``residuals (B,)`` are root mean square distances, metres, from the given to the posed vertices.
    """

    poses: np.ndarray
    translations: np.ndarray
    residuals: np.ndarray


def posed_vertices(body: BodyModel, pose: np.ndarray, translation: np.ndarray | None = None) -> np.ndarray:
    """Posed vertices ``(V, 3)`` metres of one pose ``(J', 3)``: joints beyond J' are at rest, those beyond J are left
    out."""
    whole, count = torch.zeros(1, len(body.parents), 3), min(len(pose), len(body.parents))
    whole[0, :count] = torch.from_numpy(np.asarray(pose[:count], np.float32))
    shift = torch.zeros(1, 3) if translation is None else torch.from_numpy(np.asarray(translation, np.float32)[None])
    with torch.no_grad():
        return body(whole, shift).vertices[0].numpy()


def solve_poses(body: BodyModel, vertices: np.ndarray) -> SolvedPoses:
    """The poses of a body in given frames, as `PoseSolver` solves for them."""
    return PoseSolver(body).solve(vertices)


class _Fit(NamedTuple):
    """Rotations ``(J, 3, 3)`` relative to the parents, translation ``(3,)`` and what they leave, metres."""

    residual: float
    local: np.ndarray
    translation: np.ndarray


class _Posed(NamedTuple):
    """Vertices under each joint's motion times their weights ``(J, 3, V)``, joints ``(J, 3)`` and the parents' world
    rotations ``(J, 3, 3)``."""

    weighted: np.ndarray
    places: np.ndarray
    above: np.ndarray


class PoseSolver:
    """Poses and translations with which a body's vertices lie nearest to given ones, prepared once for many frames.

    Linear blend skinning is linear in the joints' motions, so affine motions are solved for first; the nearest
    rotations of a kinematic tree start Gauss-Newton steps on pose and translation, in which pose blendshapes are those
    of the step before.
    """

    def __init__(self, body: BodyModel):
        kept = ("weights", "zero_from_bind", "bind_vertices", "zero_joints", "pose_directions")
        arrays = {name: getattr(body, name) for name in kept}
        arrays = {name: None if value is None else value.double().cpu().numpy() for name, value in arrays.items()}
        self.weights, self.zero_from_bind = arrays["weights"], arrays["zero_from_bind"]
        self.bind, self.joints, self.directions = (
            arrays[name] for name in ("bind_vertices", "zero_joints", "pose_directions")
        )
        self.parents, count = body.parents, len(body.parents)
        self.below = np.eye(count)  # [k, j]: whether joint j hangs from joint k or is it
        for joint in range(count - 1, 0, -1):
            self.below[self.parents[joint]] += self.below[joint]
        # positions in the T-pose under each joint's own motion: (V, J, 4)
        own = np.einsum("jab,vb->vja", self.zero_from_bind[:, :3, :3], self.bind) + self.zero_from_bind[:, :3, 3]
        homogeneous = np.concatenate([own, np.ones((*own.shape[:2], 1))], axis=2) * self.weights[:, :, None]
        design = homogeneous.reshape(len(self.bind), 4 * count)
        pull = np.eye(count)
        for joint in range(1, count):
            pull[joint, self.parents[joint]] = -1
        pull[0, 0] = 0
        scale = RIDGE * self.weights.sum() / count
        normal = design.T @ design + scale * np.kron(pull.T @ pull, np.eye(4)) + 1e-12 * np.eye(4 * count)
        self.affine = np.linalg.solve(normal, design.T)

    def solve(self, vertices: np.ndarray) -> SolvedPoses:
        """The poses nearest to ``vertices (B, V, 3)``, metres, by least squares.

        Vertices that the body itself was posed to are met to rounding; for those of another shape ``residuals`` say how
        far off the result is. Raises `AvatarError` for another number of vertices or numbers that are not finite.
        """
        check_shape("vertices", vertices, "B V 3", V=len(self.bind))
        check_finite("vertices", vertices)
        solved = [self._solve_frame(frame) for frame in np.asarray(vertices, np.float64)]
        poses = np.array([pose for pose, _, _ in solved], np.float32).reshape(-1, len(self.parents), 3)
        translations = np.array([translation for _, translation, _ in solved], np.float32).reshape(-1, 3)
        return SolvedPoses(poses, translations, np.array([residual for *_, residual in solved]))

    def _solve_frame(self, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Pose ``(J, 3)``, translation ``(3,)`` and residual of one frame's vertices ``(V, 3)``."""
        motions = (self.affine @ wanted).reshape(-1, 4, 3).transpose(0, 2, 1)  # posed_from_zero (J, 3, 4)
        left, _, right = np.linalg.svd(motions[:, :, :3])
        left[:, :, -1] *= np.sign(np.linalg.det(left @ right))[:, None]
        world = left @ right
        local = np.stack([world[j] if p < 0 else world[p].T @ world[j] for j, p in enumerate(self.parents)])
        translation = motions[0, :, :3] @ self.joints[0] + motions[0, :, 3] - self.joints[0]
        best, damping = _Fit(np.inf, local, translation), DAMPING
        for _ in range(STEPS):
            posed = self._pose(local, translation)
            error = wanted.T - posed.weighted.sum(axis=0)
            fit = _Fit(float(np.sqrt(np.square(error).sum(axis=0).mean())), local, translation)
            gained = best.residual - fit.residual
            if gained > 0:
                best, damping = fit, max(damping / 10, DAMPING)
                if fit.residual < EXACT or gained < CONVERGED * fit.residual:
                    break
                jacobian = self._jacobian(posed)
                normal, slope = jacobian @ jacobian.T, jacobian @ error.reshape(-1)
                above = posed.above
            elif (damping := damping * 100) > 1:  # the step made it worse, and there are no shorter ones
                break
            step = np.linalg.solve(normal + damping * normal.diagonal().max() * np.eye(len(normal)), slope)
            turns = Rotation.from_rotvec(step[:-3].reshape(-1, 3)).as_matrix()
            local = np.swapaxes(above, 1, 2) @ turns @ above @ best.local
            translation = best.translation + step[-3:]
        return Rotation.from_matrix(best.local).as_rotvec(), best.translation, best.residual

    def _pose(self, local: np.ndarray, translation: np.ndarray) -> _Posed:
        """The body posed by rotations ``(J, 3, 3)`` relative to the parents and a translation ``(3,)``."""
        world, places, above = np.empty_like(local), np.empty_like(self.joints), np.empty_like(local)
        for joint, parent in enumerate(self.parents):
            above[joint] = np.eye(3) if parent < 0 else world[parent]
            world[joint] = above[joint] @ local[joint]
            offset = self.joints[joint] - (self.joints[parent] if parent >= 0 else 0)
            places[joint] = self.joints[0] + translation if parent < 0 else places[parent] + above[joint] @ offset
        from_bind = world @ self.zero_from_bind[:, :3, :3]
        shifts = np.einsum("jab,jb->ja", world, self.zero_from_bind[:, :3, 3] - self.joints) + places
        bind = self.bind
        if self.directions is not None:
            bind = bind + self.directions @ (local[1:] - np.eye(3)).reshape(-1)
        return _Posed((from_bind @ bind.T + shifts[:, :, None]) * self.weights.T[:, None], places, above)

    def _jacobian(self, posed: _Posed) -> np.ndarray:
        """Derivatives ``(3 J + 3, 3 V)`` of the vertices with respect to a small turn, in world axes, of the subtree of
        each joint about it, and to the translation; blendshapes held.
        """
        count, size = len(self.parents), len(self.bind)
        arms = (self.below @ posed.weighted.reshape(count, -1)).reshape(count, 3, size)
        arms -= (self.below @ self.weights.T)[:, None] * posed.places[:, :, None]
        jacobian = np.zeros((count + 1, 3, 3, size))
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # a turn about axis a moves b by -c and c by b
            jacobian[:-1, a, b], jacobian[:-1, a, c] = -arms[:, c], arms[:, b]
            jacobian[-1, a, a] = 1
        return jacobian.reshape(3 * count + 3, 3 * size)
