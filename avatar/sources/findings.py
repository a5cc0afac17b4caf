"""What an outfit's frames hold and what is doubtful about them, measured; nothing is written."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.checks import AvatarError
from avatar.data.alignment import measure_overlap
from avatar.data.folders import SPLITS
from avatar.data.outfits import Outfit
from avatar.data.scan_validation import check_frame
from avatar.data.splits import spaced_frames
from avatar.geometry.orientation import measure_winding
from avatar.geometry.trees import build_tree
from avatar.io.ledger import file_digest
from avatar.io.raw_surface import RawSurface
from avatar.progress import tracked
from avatar.records import Frame, Template
from avatar.sources.conversion import UnfittedError

REACH = 0.10  # metres from the skin within which cloth is expected but for skirts and hoods
BARE = 0.5  # share of a joint's skin without a scan point near from which on the part is called uncovered
SHOWN = 5  # doubtful frames in the text
NEAR_POSE = 0.05  # radians, the largest difference of a joint, below which two frames have one pose


@dataclass(frozen=True)
class FrameFinding:
    """One frame measured, or why it is refused.

    Shares are of 1: ``covered`` of the skin with a scan point near, ``buried`` of the scan deep inside, ``outward`` of
    its normals; ``uncovered`` names joints whose skin has no scan near, ``doubts`` is what loading warns of. A scan
    that is not ``fitted`` has none of these; ``against`` is the share of its faces wound against the others.
    """

    split: str
    name: str
    problem: str = ""
    points: int = 0
    faces: int = 0
    covered: float = 0.0
    buried: float = 0.0
    outward: float = 0.0
    height: float = 0.0
    uncovered: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    fitted: bool = True
    against: float = 0.0


@dataclass(frozen=True)
class Findings:
    """An outfit's frames measured, pairs of frames with one scan file or one pose, and sizes of its splits."""

    frames: tuple[FrameFinding, ...]
    sizes: dict[str, int]
    copies: tuple[tuple[str, ...], ...] = ()  # labels of frames whose files are the same
    leaked: tuple[tuple[str, str, float], ...] = ()  # labels over two splits, and how far their poses differ, radians

    @property
    def invalid(self) -> tuple[FrameFinding, ...]:
        """The frames that would be refused."""
        return tuple(frame for frame in self.frames if frame.problem)


def measure_outfit(outfit: Outfit, most: int | None = None) -> Findings:
    """Loads an outfit's frames, at most ``most`` of each split evenly spaced, and measures them.

    Invalid frames are findings, not errors. Raises `DataError` for an outfit without a valid body.
    """
    sizes = {split: len(outfit.frames(split)) for split in SPLITS if outfit.has_frames(split)}
    labels = [(split, name) for split in sizes for name in spaced_frames(outfit.frames(split), most)]
    found, poses, digests = [], defaultdict(list), defaultdict(list)
    for split, name in tracked(labels, f"check {outfit.name}"):
        digests[file_digest(outfit.frame_path(split, name))].append(f"{split}/{name}")
        try:
            frame = outfit.load(split, name)
        except UnfittedError:
            found.append(measure_scan(split, name, outfit.read(split, name).scan))
            continue
        except AvatarError as error:
            found.append(FrameFinding(split, name, str(error)))
            continue
        found.append(measure_frame(frame, outfit.template, outfit.frame_path(split, name)))
        if frame.body.pose is not None:
            poses[split].append((f"{split}/{name}", frame.body.pose))
    copies = tuple(tuple(same) for same in digests.values() if len(same) > 1)
    return Findings(tuple(found), sizes, copies, tuple(leaked_poses(poses)))


def measure_frame(frame: Frame, template: Template, path: Path) -> FrameFinding:
    """Measures one valid frame of a file."""
    scan, body = frame.scan, frame.body.vertices
    overlap = measure_overlap(scan.points, scan.normals, body, template.faces.numpy())
    return FrameFinding(
        split=frame.split,
        name=frame.name,
        points=len(scan.points),
        faces=0 if scan.faces is None else len(scan.faces),
        covered=overlap.covered,
        buried=overlap.buried,
        outward=overlap.outward,
        doubts=tuple(check_frame(frame, template, path).values()),
        height=float(np.ptp(scan.points[:, 1])),
        uncovered=uncovered_joints(scan.points, body, template),
    )


def measure_scan(split: str, name: str, scan: RawSurface) -> FrameFinding:
    """Measures a scan without a body, metres, y up."""
    faces = 0 if scan.faces is None else len(scan.faces)
    against = measure_winding(scan.vertices, scan.faces).against if faces else 0.0
    height = float(scan.extents[1])
    return FrameFinding(
        split, name, points=len(scan.vertices), faces=faces, height=height, fitted=False, against=against
    )


def uncovered_joints(points: np.ndarray, body: np.ndarray, template: Template) -> tuple[str, ...]:
    """Joints most of whose vertices have no scan point within `REACH`: a hand, foot or head that was not scanned."""
    far = build_tree(points).query(body, distance_upper_bound=REACH)[0] > REACH
    owners = template.weights.numpy().argmax(axis=1)
    names = template.joint_names
    return tuple(names[joint] for joint in np.unique(owners) if far[owners == joint].mean() > BARE)


def leaked_poses(poses: dict[str, list[tuple[str, np.ndarray]]]) -> Iterable[tuple[str, str, float]]:
    """Frames of other splits whose pose, the root's rotation aside, some training frame has as well."""
    train = poses.get("train", [])
    if not train:
        return
    known = np.stack([pose for _, pose in train])[:, 1:]
    for split in SPLITS[1:]:
        for label, pose in poses.get(split, []):
            apart = np.linalg.norm(known - pose[None, 1:], axis=2).max(axis=1)
            nearest = int(apart.argmin())
            if apart[nearest] < NEAR_POSE:
                yield train[nearest][0], label, float(apart[nearest])


def describe(findings: Findings) -> list[str]:
    """Findings in lines: what is there, what is doubtful with the figure, what is refused."""
    valid = [frame for frame in findings.frames if not frame.problem]
    seen = Counter(frame.split for frame in findings.frames)
    looked = (
        f"{count} {split}" + f" ({seen[split]} looked at)" * (seen[split] < count)
        for split, count in findings.sizes.items()
    )
    lines = [f"frames: {', '.join(looked)}"]
    fitted = [frame for frame in valid if frame.fitted]
    if valid:
        lines += [
            f"points a scan: {_range(frame.points for frame in valid)}"
            + (f", faces {_range(frame.faces for frame in valid)}" if any(f.faces for f in valid) else ""),
            f"scan's height, m: {_range((frame.height for frame in valid), '.2f')}",
        ]
    if len(fitted) < len(valid):
        lines.append(f"without a fitted body: {len(valid) - len(fitted)} of {len(valid)} frames")
        worst = max(valid, key=lambda frame: frame.against)
        if worst.against:
            lines.append(f"faces wound against the others: up to {worst.against:.1%}, in {worst.split}/{worst.name}")
    if fitted:
        lines += [
            f"skin with a scan point near: {_range((frame.covered for frame in fitted), '.0%')}",
            f"scan deep inside the body: {_range((frame.buried for frame in fitted), '.1%')}",
            f"normals that point outward: {_range((frame.outward for frame in fitted), '.0%')}",
        ]
        doubtful = [frame for frame in fitted if frame.doubts]
        lines += [f"doubtful: {frame.split}/{frame.name}: {' '.join(frame.doubts)}" for frame in doubtful[:SHOWN]]
        if len(doubtful) > SHOWN:
            lines.append(f"doubtful: {len(doubtful) - SHOWN} more frames; out=check.csv has them all")
        bare = Counter(joint for frame in fitted for joint in frame.uncovered)
        for joint, count in bare.most_common():
            lines.append(f"without a scan: {joint} in {count} of {len(fitted)} frames")
    lines += [f"the same file: {', '.join(same)}" for same in findings.copies]
    for one, other, apart in findings.leaked:
        lines.append(f"one pose in two splits: {one} and {other}, {apart:.3f} rad apart")
    lines += [f"refused: {frame.split}/{frame.name}: {frame.problem}" for frame in findings.invalid]
    return lines


def _range(values: Iterable[float], form: str = ",") -> str:
    """Smallest to largest of the values, or the one there is."""
    listed = list(values)
    low, high = format(min(listed), form), format(max(listed), form)
    return low if low == high else f"{low} to {high}"
