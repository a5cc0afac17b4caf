"""What a simulated frame must meet, how it is measured, and the second tries it gets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from avatar.checks import AvatarError
from avatar.io.frames import OpenFrame, write_open_frame
from avatar.records import Motion
from avatar.simulate.dressing import DressedBody
from avatar.simulate.implicit import mesh_edges
from avatar.simulate.poses import NamedPose
from avatar.simulate.visibility import measure_penetration, visible_faces

STRIDES = (1.0, 0.6, 0.35)  # shares of the configured stride, tried in turn until a frame passes the gates


@dataclass
class GateConfig:
    """What a frame must meet to be written."""

    share: float = 0.005  # largest share of cloth vertices inside the body
    depth: float = 0.005  # m, deepest of them
    stretch: float = 1.3  # 99th percentile of edge lengths, in rest lengths
    speed: float = 1e-3  # m a step, 99th percentile of vertex ways when the frame is taken

    def __post_init__(self):
        for name, value in vars(self).items():
            if not value > 0:
                raise AvatarError(f"{name}: expected a positive number, got {value}.")


@dataclass(frozen=True)
class FrameReport:
    """How one frame went: its file ``name``, the gates it ``failed`` (empty when written) and its numbers."""

    name: str
    failed: tuple[str, ...]
    share: float = 0.0
    depth: float = 0.0
    stretch: float = 1.0
    speed: float = 0.0
    attempts: int = 0


def edge_stretch(dressed: DressedBody, cloth: np.ndarray) -> float:
    """The 99th percentile of edge lengths in units of their rest lengths."""
    edges, _ = mesh_edges(dressed.faces)
    rest = np.concatenate([garment.vertices for garment in dressed.garments])
    lengths = [np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) for points in (cloth, rest)]
    return float(np.percentile(lengths[0] / lengths[1], 99))


def examine(dressed: DressedBody, pose: np.ndarray, cloth: np.ndarray) -> OpenFrame:
    """A frame with its measured penetration and visibility, from a pose and the cloth resting in it."""
    body = dressed.posed_body(pose[None])[0]
    body_faces = dressed.body.faces.numpy()
    inside = measure_penetration(body, body_faces, cloth)
    seen = visible_faces(np.concatenate([body, cloth]), np.concatenate([body_faces, dressed.faces + len(body)]))
    return OpenFrame(
        pose=np.asarray(pose, np.float32),
        translation=np.zeros(3, np.float32),
        cloth=cloth.astype(np.float32),
        visible_body=seen[: len(body_faces)],
        visible_cloth=seen[len(body_faces) :],
        penetration_share=inside.share,
        penetration_depth=inside.deepest,
    )


def measure(dressed: DressedBody, frame: OpenFrame, speed: float) -> dict[str, float]:
    """The numbers the gates look at, by their names in `GateConfig`."""
    return {
        "share": frame.penetration_share,
        "depth": frame.penetration_depth,
        "stretch": edge_stretch(dressed, frame.cloth),
        "speed": speed,
    }


def missed(measured: dict[str, float], gates: GateConfig) -> tuple[str, ...]:
    """Which gates are missed, by how much."""
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
            report = FrameReport(pose.name, (str(error),), attempts=attempt)
            continue
        frame = examine(dressed, pose.pose, rest.cloth)
        measured = measure(dressed, frame, rest.speed)
        report = FrameReport(pose.name, missed(measured, gates), **measured, attempts=attempt)
        if not report.failed:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_open_frame(path, frame)
            return report
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
        measured = measure(dressed, frame, 0.0)
        write_open_frame(folder / f"{named.name}.npz", frame)
        reports.append(FrameReport(named.name, missed(measured, gates), **measured, attempts=1))
    return reports
