"""BVH motion files: skeleton, channels and forward kinematics, in the file's own units and axes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.checks import DataError, check_file

MAX_BYTES = 256 << 20
MAX_JOINTS = 1000
FARTHEST = 1e9  # of any number in a file: millimetres to the moon would do
MOVES = {f"{axis}position" for axis in "xyz"}
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
    """Reads a BVH file; `DataError` for a missing, oversized or damaged one names what was expected."""
    path = Path(path)
    check_file(path, MAX_BYTES)
    try:
        tokens = deque(path.read_text(encoding="utf-8").split())
        joints = _read_hierarchy(tokens)
        values, fps = _read_frames(tokens, sum(len(joint.channels) for joint in joints))
    except UnicodeDecodeError as error:
        raise DataError(path, f"expected a BVH file, it is not text ({error.reason}).") from error
    except IndexError as error:
        raise DataError(path, "expected a whole BVH file, it ends too early.", "Copy it again.") from error
    except ValueError as error:
        raise DataError(path, f"expected a valid BVH file: {error}.") from error
    rotations, positions = _pose(joints, values)
    names, parents, offsets = zip(*((joint.name, joint.parent, joint.offset) for joint in joints))
    return BvhMotion(names, parents, np.array(offsets), rotations, positions, fps)


def _expect(tokens: deque[str], *expected: str) -> None:
    for token in expected:
        if (found := tokens.popleft()) != token:
            raise ValueError(f"{found!r} stands where {token!r} was expected")


def _read_hierarchy(tokens: deque[str]) -> list[_Joint]:
    if (start := " ".join(islice(tokens, 2))) != "HIERARCHY ROOT":
        raise ValueError(f"it begins with {start!r}, not with HIERARCHY ROOT")
    tokens.popleft()
    joints: list[_Joint] = []
    stack: list[_Joint | None] = []  # open blocks; None is an end site
    while stack or not joints:
        token = tokens.popleft()
        if token in ("ROOT", "JOINT", "End"):
            name, joint = tokens.popleft(), None
            if token != "End":
                if len(joints) >= MAX_JOINTS or (token == "ROOT") != (not joints) or (stack and stack[-1] is None):
                    raise ValueError(f"{token} {name} stands where no joint can be")
                joint = _Joint(name, joints.index(stack[-1]) if stack else -1)
                joints.append(joint)
            stack.append(joint)
            _expect(tokens, "{")
        elif token == "OFFSET":
            words = [tokens.popleft() for _ in range(3)]
            offset = [float(word) for word in words]
            if not np.abs(offset).max() <= FARTHEST:
                raise ValueError(f"the offset {' '.join(words)} is none")
            if stack[-1] is not None:
                stack[-1].offset = offset
        elif token == "CHANNELS":
            count = int(tokens.popleft())
            channels = [tokens.popleft().lower() for _ in range(count)]
            if stack[-1] is None or not set(channels) <= CHANNELS or len(set(channels)) != count:
                raise ValueError(f"channels {' '.join(channels)} are not those of a joint")
            stack[-1].channels = channels
        elif token == "}":
            stack.pop()
        else:
            raise ValueError(f"{token!r} stands where a joint, OFFSET, CHANNELS or }} was expected")
    return joints


def _read_frames(tokens: deque[str], channels: int) -> tuple[np.ndarray, float]:
    """Channel values ``(T, channels)`` and frames per second, from what is left of a file's tokens."""
    _expect(tokens, "MOTION", "Frames:")
    frames = int(tokens.popleft())
    _expect(tokens, "Frame", "Time:")
    seconds = float(tokens.popleft())
    values = np.array(list(tokens), dtype=np.float64)
    if frames < 1 or channels < 3 or values.size != frames * channels:
        raise ValueError(f"{frames} frames of {channels} channels were expected, {values.size} numbers are there")
    if not np.abs(values).max() <= FARTHEST or not 1e-4 <= seconds <= 10:
        raise ValueError(f"numbers must be within {FARTHEST:g} and the frame time 0.0001 to 10 s, it is {seconds} s")
    return values.reshape(frames, channels), 1 / seconds


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
        if order := "".join(channel[0].upper() for channel in own if channel not in MOVES):
            angles = np.stack([own[f"{axis.lower()}rotation"] for axis in order], axis=-1)
            turn = Rotation.from_euler(order, angles, degrees=True).as_matrix()
        if joint.parent < 0:
            rotations[:, index], positions[:, index] = turn, place
        else:
            above = rotations[:, joint.parent]
            rotations[:, index] = above @ turn
            positions[:, index] = positions[:, joint.parent] + np.einsum("tij,tj->ti", above, place)
    return rotations, positions
