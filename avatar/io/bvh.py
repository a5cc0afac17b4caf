"""BVH motion files: skeleton, channels and forward kinematics, in the file's own units and axes."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import compress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.checks import DataError, check_file

MAX_BYTES = 256 << 20
MAX_JOINTS = 1000
FARTHEST = 1e9  # of any number in a file: millimetres to the moon would do
CHANNELS = {f"{axis.lower()}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}


@dataclass(frozen=True)
class BvhMotion:
    """A BVH file, posed: J joints over T frames, parents before children, -1 for the root.

    ``offsets (J, 3)`` from the parent at rest; ``rotations (T, J, 3, 3)`` and ``positions (T, J, 3)`` in the world,
    in the file's units; ``fps``.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    rotations: np.ndarray
    positions: np.ndarray
    fps: float


@dataclass
class _Joint:
    """A joint while its file is read."""

    name: str
    parent: int
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path) -> BvhMotion:
    """Reads a BVH file; `DataError` for a missing, oversized or damaged one names what was expected."""
    path = Path(path)
    check_file(path, MAX_BYTES)
    try:
        tokens = path.read_text(encoding="utf-8").split()
        joints, at = _read_hierarchy(tokens)
        values, fps = _read_frames(tokens, at, sum(len(joint.channels) for joint in joints))
    except UnicodeDecodeError as error:
        raise DataError(path, f"expected a BVH file, it is not text ({error.reason}).") from error
    except IndexError as error:
        raise DataError(path, "expected a whole BVH file, it ends too early.", "Copy it again.") from error
    except ValueError as error:
        raise DataError(path, f"expected a valid BVH file: {error}.") from error
    rotations, positions = _pose(joints, values)
    names, parents, offsets = zip(*((joint.name, joint.parent, joint.offset) for joint in joints))
    return BvhMotion(names, parents, np.array(offsets), rotations, positions, fps)


def _read_hierarchy(tokens: list[str]) -> tuple[list[_Joint], int]:
    """The joints, and where the frames begin."""
    if tokens[0] != "HIERARCHY" or tokens[1] != "ROOT":
        raise ValueError(f"it begins with {' '.join(tokens[:2])!r}, not with HIERARCHY ROOT")
    joints: list[_Joint] = []
    stack: list[int | None] = []  # open blocks; None is an end site
    at = 1
    while True:
        token = tokens[at]
        if token in ("ROOT", "JOINT", "End"):
            if token != "End":
                if len(joints) >= MAX_JOINTS or (token == "ROOT") != (not joints) or (stack and stack[-1] is None):
                    raise ValueError(f"{token} {tokens[at + 1]} stands where no joint can be")
                joints.append(_Joint(tokens[at + 1], stack[-1] if stack else -1))
            stack.append(None if token == "End" else len(joints) - 1)
            at = _expect(tokens, at + 2, "{")
        elif token == "OFFSET":
            offset = [float(value) for value in tokens[at + 1 : at + 4]]
            if len(offset) != 3 or not np.abs(offset).max() <= FARTHEST:
                raise ValueError(f"the offset {' '.join(tokens[at + 1 : at + 4])} is none")
            if stack[-1] is not None:
                joints[stack[-1]].offset = offset
            at += 4
        elif token == "CHANNELS":
            count = int(tokens[at + 1])
            channels = [name.lower() for name in tokens[at + 2 : at + 2 + count]]
            if stack[-1] is None or not set(channels) <= CHANNELS or len(set(channels)) != count:
                raise ValueError(f"channels {' '.join(channels)} are not those of a joint")
            joints[stack[-1]].channels = channels
            at += 2 + count
        elif token == "}":
            stack.pop()
            at += 1
            if not stack:
                return joints, at
        else:
            raise ValueError(f"{token!r} stands where a joint, OFFSET, CHANNELS or }} was expected")


def _expect(tokens: list[str], at: int, *expected: str) -> int:
    """The place after expected tokens."""
    for token in expected:
        if tokens[at] != token:
            raise ValueError(f"{tokens[at]!r} stands where {token!r} was expected")
        at += 1
    return at


def _read_frames(tokens: list[str], at: int, channels: int) -> tuple[np.ndarray, float]:
    """Channel values ``(T, channels)`` and frames per second."""
    at = _expect(tokens, at, "MOTION", "Frames:")
    frames = int(tokens[at])
    at = _expect(tokens, at + 1, "Frame", "Time:")
    seconds = float(tokens[at])
    values = np.array(tokens[at + 1 :], dtype=np.float64)
    if frames < 1 or channels < 3 or values.size != frames * channels:
        raise ValueError(f"{frames} frames of {channels} channels were expected, {values.size} numbers are there")
    if not np.abs(values).max() <= FARTHEST or not 1e-4 <= seconds <= 10:
        raise ValueError(f"numbers must be within {FARTHEST:g} and the frame time 0.0001 to 10 s, it is {seconds} s")
    return values.reshape(frames, channels), 1 / seconds


def _pose(joints: list[_Joint], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and positions in the world. Position channels stand in the place of the offset."""
    rotations = np.zeros((len(values), len(joints), 3, 3))
    positions = np.zeros((len(values), len(joints), 3))
    column = 0
    for index, joint in enumerate(joints):
        own = values[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        place = np.tile(np.array(joint.offset), (len(values), 1))
        turning = [channel.endswith("rotation") for channel in joint.channels]
        for channel, turns, value in zip(joint.channels, turning, own.T):
            if not turns:
                place[:, "xyz".index(channel[0])] = value
        turn = np.tile(np.eye(3), (len(values), 1, 1))
        if any(turning):
            order = "".join(channel[0].upper() for channel in compress(joint.channels, turning))
            turn = Rotation.from_euler(order, own[:, turning], degrees=True).as_matrix()
        if joint.parent < 0:
            rotations[:, index], positions[:, index] = turn, place
        else:
            above = rotations[:, joint.parent]
            rotations[:, index] = above @ turn
            positions[:, index] = positions[:, joint.parent] + np.einsum("tij,tj->ti", above, place)
    return rotations, positions
