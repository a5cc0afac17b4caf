"""Whether cloth follows from the pose: what it remembers of its way there, and how it answers to small changes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from avatar.checks import AvatarError
from avatar.simulate.dressing import DressedBody
from avatar.simulate.poses import NamedPose


@dataclass(frozen=True)
class HistoryError:
    """Vertex distances between cloth at rest in the same poses reached two ways, metres."""

    mean: float
    percentile95: float
    poses: int

    def __str__(self) -> str:
        """One line for a log."""
        distances = f"{self.mean * 1e3:.2f} mm mean, {self.percentile95 * 1e3:.2f} mm at the 95th percentile"
        return f"history error {distances}, {self.poses} poses reached two ways"


@dataclass(frozen=True)
class PoseSensitivity:
    """Mean vertex distances, metres, that a small change of pose makes to the cloth at rest and to the body."""

    cloth: float
    body: float
    poses: int

    def __str__(self) -> str:
        """One line for a log."""
        moved = f"cloth moves {self.cloth * 1e3:.2f} mm where the body moves {self.body * 1e3:.2f} mm"
        return f"pose sensitivity: {moved}, mean of {self.poses} poses"


def history_error(dressed: DressedBody, poses: list[NamedPose]) -> HistoryError:
    """How far settled cloth depends on the way to a pose.

    Each pose but the last is reached twice, directly and by way of the next pose. Recorded frames all go the
    direct way, so this is what a pose alone leaves open about real cloth, not noise in the data.

    Raises:
        AvatarError: for fewer than two poses.
    """
    if len(poses) < 2:
        raise AvatarError(f"poses: expected at least 2, got {len(poses)}.")
    distances = []
    for target, detour in itertools.pairwise(poses):
        direct, around = dressed.settle(target.pose), dressed.settle(target.pose, via=[detour.pose])
        distances.append(np.linalg.norm(direct.cloth - around.cloth, axis=1))
    everything = np.concatenate(distances)
    return HistoryError(float(everything.mean()), float(np.percentile(everything, 95)), len(distances))


def pose_sensitivity(
    dressed: DressedBody, poses: list[NamedPose], angle: float = 0.01, seed: int = 0
) -> PoseSensitivity:
    """How far settled cloth moves when a pose changes a little: chaos would show as cloth far ahead of the body.

    Args:
        dressed: who is dressed how; poses: at least one.
        angle: standard deviation of the change of every angle but the root's, radians; seed: of the changes.

    Raises:
        AvatarError: for no pose.
    """
    if not poses:
        raise AvatarError("poses: expected at least 1, got 0.")
    rng, ways = np.random.default_rng(seed), []
    for target in poses:
        change = rng.normal(scale=angle, size=target.pose.shape).astype(np.float32)
        change[0] = 0
        pair = np.stack([target.pose, target.pose + change])
        cloth, body = [dressed.settle(pose).cloth for pose in pair], dressed.posed_body(pair)
        ways.append([np.linalg.norm(a - b, axis=1).mean() for a, b in (cloth, body)])
    cloth, body = np.mean(ways, axis=0)
    return PoseSensitivity(float(cloth), float(body), len(poses))
