"""BVH motion files: skeleton, channels and forward kinematics, in the file's own units and axes."""

from __future__ import annotations

import logging
import re
from collections import deque
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.checks import DataError, check_file

log = logging.getLogger(__name__)

MAX_BYTES = 256 << 20
MAX_JOINTS = 1000
FARTHEST = 1e9  # of any number in a file: millimetres to the moon would do
MOVES = {f"{axis}position" for axis in "xyz"}
HEADER = re.compile(r"\s*MOTION\s+Frames\s*:?\s*(\S+)\s+Frame\s+Time\s*:?\s*(\S+)", re.IGNORECASE)
COMMENT = re.compile(r"^[ \t]*(#|//|;).*$", re.MULTILINE)
STRETCH = 0.02  # of a mean bone: those that lengthen by more are mentioned
CHANNELS = MOVES | {f"{axis}rotation" for axis in "xyz"}


@dataclass(frozen=True)
class BvhMotion:
    """A BVH file, posed: J joints over T frames, parents before children, -1 for the root, in the file's units.

    ``offsets (J, 3)`` from the parent at rest; ``rotations (T, J, 3, 3)`` and ``positions (T, J, 3)`` in the world.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    rotations: np.ndarray
    positions: np.ndarray
    fps: float


@dataclass(eq=False)
class _Joint:
    """A joint while its file is read."""

    name: str
    parent: int
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path) -> BvhMotion:
    """Reads a BVH file; `DataError` for a missing, oversized or damaged one names what was expected.

    Names may have blanks, lines may be comments, rows beyond the header's count are left out with a warning. Positions
    move the root, and joints down to the first that branches; those of other joints' bones do not (warned about).
    """
    path = Path(path)
    check_file(path, MAX_BYTES)
    try:
        text = COMMENT.sub("", path.read_text(encoding="utf-8-sig"))
        end = text.rfind("}") + 1
        tokens = deque(text[:end].replace("{", " { ").replace("}", " } ").split())
        joints = _read_hierarchy(tokens)
        if tokens:
            raise ValueError(f"{tokens[0]!r} stands where MOTION was expected")
        values, fps = _read_frames(path, text[end:], sum(len(joint.channels) for joint in joints))
    except UnicodeDecodeError as error:
        raise DataError(path, f"expected a BVH file, it is not text ({error.reason}).") from error
    except IndexError as error:
        raise DataError(path, "expected a whole BVH file, it ends too early.", "Copy it again.") from error
    except ValueError as error:
        raise DataError(path, f"expected a valid BVH file: {error}.") from error
    _fix_bones(path, joints, values)
    rotations, positions = _pose(joints, values)
    names, parents, offsets = zip(*((joint.name, joint.parent, joint.offset) for joint in joints))
    return BvhMotion(names, parents, np.array(offsets), rotations, positions, fps)


def _read_name(tokens: deque[str]) -> str:
    """The words up to an opening brace."""
    words = []
    while (word := tokens.popleft()) != "{":
        if word == "}" or len(words) == 20:
            raise ValueError(f"{word!r} stands where '{{' was expected")
        words.append(word)
    return " ".join(words)


def _read_hierarchy(tokens: deque[str]) -> list[_Joint]:
    if (start := " ".join(islice(tokens, 2))).upper() != "HIERARCHY ROOT":
        raise ValueError(f"it begins with {start!r}, not with HIERARCHY ROOT")
    tokens.popleft()
    joints: list[_Joint] = []
    stack: list[_Joint | None] = []  # open blocks; None is an end site
    while stack or not joints:
        token = (word := tokens.popleft()).upper()
        if token in ("ROOT", "JOINT", "END"):
            name, joint = _read_name(tokens), None
            if token != "END":
                if len(joints) >= MAX_JOINTS or (token == "ROOT") != (not joints) or (stack and stack[-1] is None):
                    raise ValueError(f"{token} {name} stands where no joint can be")
                joint = _Joint(name, joints.index(stack[-1]) if stack else -1)
                joints.append(joint)
            stack.append(joint)
        elif token == "OFFSET":
            words = [tokens.popleft() for _ in range(3)]
            offset = [float(word) for word in words]
            if not np.abs(offset).max() <= FARTHEST:
                raise ValueError(f"the offset {' '.join(words)} is none")
            if stack and stack[-1] is not None:
                stack[-1].offset = offset
        elif token == "CHANNELS":
            count = int(tokens.popleft())
            channels = [tokens.popleft().lower() for _ in range(count)]
            if not stack or stack[-1] is None or not set(channels) <= CHANNELS or len(set(channels)) != count:
                raise ValueError(f"channels {' '.join(channels)} are not those of a joint")
            stack[-1].channels = channels
        elif token == "}":
            stack.pop()
        else:
            raise ValueError(f"{word!r} stands where a joint, OFFSET, CHANNELS or }} was expected")
    return joints


def _read_frames(path: Path, text: str, channels: int) -> tuple[np.ndarray, float]:
    """Channel values ``(T, channels)`` and frames per second, from what follows a file's skeleton."""
    if (header := HEADER.match(text)) is None:
        start = " ".join(text.split()[:6])
        raise ValueError(f"after the skeleton MOTION, Frames: and Frame Time: were expected, it goes on {start!r}")
    frames, seconds = int(header[1]), float(header[2])
    lines = [line.split() for line in re.sub(r"#.*", "", text[header.end() :]).splitlines()]
    values = np.array([word for line in lines for word in line], dtype=np.float64)
    rows, rest = divmod(values.size, max(channels, 1))
    if frames < 1 or channels < 3 or rest or rows < frames:
        raise ValueError(
            f"{frames} frames of {channels} channels were expected, {values.size} numbers are there, "
            f"{values.size / max(channels, 1):.6g} rows of {channels}"
        )
    if rows > frames:
        if (widths := {len(line) for line in lines if line} - {channels}) and len(lines) > 1:
            raise ValueError(f"rows of {channels} numbers were expected, there are some of {min(widths)}")
        log.warning("%s: read the %d frames that its header declares of the %d rows there.", path, frames, rows)
        values = values[: frames * channels]
    if not np.abs(values).max() <= FARTHEST or not 1e-4 <= seconds <= 10:
        raise ValueError(f"numbers must be within {FARTHEST:g} and the frame time 0.0001 to 10 s, it is {seconds} s")
    return values.reshape(frames, channels), _frame_rate(header[2])


def _frame_rate(time: str) -> float:
    """Frames per second of a frame time as written: the one whole number that rounds to its digits, as 30 of 0.0333."""
    seconds = float(time)
    mantissa, _, exponent = time.lower().partition("e")
    half = 0.5 * 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    low, high = 1 / (seconds + half), 1 / max(seconds - half, 1e-6)
    whole = round(1 / seconds)
    only = low <= whole <= high and not low <= whole - 1 and not whole + 1 <= high
    return float(whole) if only else 1 / seconds


def _fix_bones(path: Path, joints: list[_Joint], values: np.ndarray) -> None:
    """Takes the position channels from joints whose bones do not move, with their lengths where offsets are zero.

    The root keeps its own, and so do joints down to the first that branches: under a "reference" the hips move.
    """
    size = max(sum(float(np.linalg.norm(joint.offset)) for joint in joints[1:]), 1e-12)
    free, at = {0}, 0
    while len(below := [index for index, joint in enumerate(joints) if joint.parent == at]) == 1:
        at = below[0]
        free.add(at)
    column, moved = 0, {}
    for index, joint in enumerate(joints):
        columns = dict(zip(joint.channels, range(column, column + len(joint.channels))))
        column += len(joint.channels)
        axes = [axis for axis in "xyz" if f"{axis}position" in columns]
        if index in free or not axes:
            continue
        places = np.tile(np.array(joint.offset), (len(values), 1))
        for axis in axes:
            places[:, "xyz".index(axis)] = values[:, columns[f"{axis}position"]]
        bone = np.median(places, axis=0)
        if np.abs(joint.offset).max() < 1e-9 * size:
            joint.offset = bone.tolist()
        away = float(np.linalg.norm(places - (bone if np.abs(places).max() == 0 else joint.offset), axis=1).max())
        if away > STRETCH * size / max(len(joints), 1):
            moved[joint.name] = away
        joint.channels = [name if name not in MOVES else f"unused {name}" for name in joint.channels]
    if moved:
        most = max(moved, key=moved.get)
        message = "positions of %d joints below the root move (%s by %.3g units); their rotations alone are used."
        log.warning(f"%s: {message}", path, len(moved), most, moved[most])


def _pose(joints: list[_Joint], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and positions in the world. Position channels stand in the place of the offset."""
    frames, column = len(values), 0
    rotations, positions = np.zeros((frames, len(joints), 3, 3)), np.zeros((frames, len(joints), 3))
    for index, joint in enumerate(joints):
        own = dict(zip(joint.channels, values[:, column : column + len(joint.channels)].T))
        column += len(joint.channels)
        place = np.tile(np.array(joint.offset), (frames, 1))
        for channel in own.keys() & MOVES:
            place[:, "xyz".index(channel[0])] = own[channel]
        turn = np.tile(np.eye(3), (frames, 1, 1))
        if order := "".join(channel[0].upper() for channel in own if channel.endswith("rotation")):
            angles = np.stack([own[f"{axis.lower()}rotation"] for axis in order], axis=-1)
            turn = Rotation.from_euler(order, angles, degrees=True).as_matrix()
        if joint.parent < 0:
            rotations[:, index], positions[:, index] = turn, place
        else:
            above = rotations[:, joint.parent]
            rotations[:, index] = above @ turn
            positions[:, index] = positions[:, joint.parent] + np.einsum("tij,tj->ti", above, place)
    return rotations, positions
