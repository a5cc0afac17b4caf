"""What is measured on simulated cloth: gates that frames must pass, with second tries, and how it follows a pose."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from avatar.checks import AvatarError, check_range
from avatar.io.frames import OpenFrame, write_open_frame
from avatar.records import Motion
from avatar.simulate.dressing import DressedBody
from avatar.simulate.level_sets import mesh_edges
from avatar.simulate.mesh_queries import penetration_depths, visible_faces
from avatar.simulate.poses import NamedPose

STRIDES = (1.0, 0.6, 0.35)  # shares of the configured stride, tried in turn until a frame passes the gates


@dataclass
class GateConfig:
    """What a frame must meet to be written."""

    share: float = 0.005  # largest share of cloth vertices inside the body
    depth: float = 0.005  # m, deepest of them
    stretch: float = 1.3  # 99th percentile of edge lengths, in rest lengths
    speed: float = 1e-3  # m a step, 99th percentile of vertex ways when the frame is taken

    def __post_init__(self):
        check_range(self, *vars(self), above=0)


@dataclass(frozen=True)
class FrameReport:
    """How one frame went: its file ``name``, the gates it ``failed`` (empty when it passed), and how many tries."""

    name: str
    failed: tuple[str, ...]
    attempts: int


def examine(dressed: DressedBody, pose: np.ndarray, cloth: np.ndarray) -> OpenFrame:
    """A frame with its measured penetration and visibility, from a pose and the cloth resting in it."""
    body, body_faces = dressed.posed_body(pose[None])[0], dressed.body.faces.numpy()
    depths = penetration_depths(body, body_faces, cloth)
    seen = visible_faces(np.concatenate([body, cloth]), np.concatenate([body_faces, dressed.faces + len(body)]))
    return OpenFrame(
        pose=np.asarray(pose, np.float32),
        translation=np.zeros(3, np.float32),
        cloth=cloth.astype(np.float32),
        visible_body=seen[: len(body_faces)],
        visible_cloth=seen[len(body_faces) :],
        penetration_share=float((depths > 0).mean()),
        penetration_depth=float(depths.max(initial=0)),
    )


def missed_gates(dressed: DressedBody, frame: OpenFrame, speed: float, gates: GateConfig) -> tuple[str, ...]:
    """Which gates a frame misses, by how much."""
    edges, _ = mesh_edges(dressed.faces)
    rest = np.concatenate([garment.vertices for garment in dressed.garments])
    now, at_rest = (np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) for points in (frame.cloth, rest))
    measured = {
        "share": frame.penetration_share,
        "depth": frame.penetration_depth,
        "stretch": float(np.percentile(now / at_rest, 99)),
        "speed": speed,
    }
    limits = vars(gates)
    return tuple(f"{name} {value:.4g} > {limits[name]:.4g}" for name, value in measured.items() if value > limits[name])


def record_frame(dressed: DressedBody, pose: NamedPose, path: Path, gates: GateConfig) -> FrameReport:
    """Settles one pose and writes its frame if it passes the gates, travelling more slowly if it does not.

    A frame that fails at every stride is not written; the report says why.
    """
    for attempt, share in enumerate(STRIDES, 1):
        try:
            rest = dressed.settle(pose.pose, stride=share * dressed.travel.stride)
        except AvatarError as error:
            report = FrameReport(pose.name, (str(error),), attempt)
            continue
        frame = examine(dressed, pose.pose, rest.cloth)
        report = FrameReport(pose.name, missed_gates(dressed, frame, rest.speed, gates), attempt)
        if not report.failed:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_open_frame(path, frame)
            break
    return report


def frames_of(motion: Motion) -> list[NamedPose]:
    """Poses of a motion's frames, named ``<sequence>.<frame>``."""
    return [NamedPose(f"{motion.name}.{frame:05d}", pose) for frame, pose in enumerate(motion.poses)]


def record_motion(dressed: DressedBody, motion: Motion, folder: Path, gates: GateConfig) -> list[FrameReport]:
    """Plays a sequence and writes all its frames; reports which gates each of them missed (rest is not asked for)."""
    folder.mkdir(parents=True, exist_ok=True)
    reports = []
    for history, (named, cloth) in enumerate(zip(frames_of(motion), dressed.play(motion.poses))):
        frame = replace(examine(dressed, named.pose, cloth), history=history)
        write_open_frame(folder / f"{named.name}.npz", frame)
        reports.append(FrameReport(named.name, missed_gates(dressed, frame, 0.0, gates), 1))
    return reports


def history_error(dressed: DressedBody, poses: list[NamedPose]) -> str:
    """A line on how far settled cloth depends on the way to a pose: vertex distances between two ways.

    Each pose but the last is reached twice, directly and by way of the next pose. Recorded frames all go the
    direct way, so this is what a pose alone leaves open about real cloth, not noise in the data. Raises `AvatarError`
    for fewer than two poses.
    """
    if len(poses) < 2:
        raise AvatarError(f"poses: expected at least 2, got {len(poses)}.")
    ways = [
        dressed.settle(target.pose).cloth - dressed.settle(target.pose, via=[detour.pose]).cloth
        for target, detour in itertools.pairwise(poses)
    ]
    distances = 1e3 * np.linalg.norm(np.concatenate(ways), axis=1)
    spread = f"{distances.mean():.2f} mm mean, {np.percentile(distances, 95):.2f} mm at the 95th percentile"
    return f"history error {spread}, {len(ways)} poses reached two ways"


def pose_sensitivity(dressed: DressedBody, poses: list[NamedPose], angle: float = 0.01, seed: int = 0) -> str:
    """A line on how far settled cloth moves when a pose changes a little: chaos would show as cloth far ahead.

    ``angle`` is the standard deviation of the change of every angle but the root's, radians, drawn from ``seed``.
    Raises `AvatarError` for no pose.
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
    cloth, body = 1e3 * np.mean(ways, axis=0)
    moved = f"cloth moves {cloth:.2f} mm where the body moves {body:.2f} mm"
    return f"pose sensitivity: {moved}, mean of {len(poses)} poses"
