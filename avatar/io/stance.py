"""How people stand in a motion: which way is up, in which unit they travel, whether joints bend as a person's do.

Files name neither their up axis nor their unit. What is measured here contradicts a wrong reading before anyone lies
down or flies.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_PARENTS
from avatar.checks import DataError, unknown_name
from avatar.geometry.units import METRES
from avatar.io.joint_names import INDEX

log = logging.getLogger(__name__)

Y_FROM = {  # rotations that turn a world, upright along an axis, to y up; about x, as SMPL's people face along z
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "-z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
AUTO = "auto"
UPRIGHT, ELSEWHERE = 0.5, 0.8  # mean cosine between a person, from ankles to shoulders, and an axis
FRAMES = 2000  # that are looked at
FASTEST = 15.0  # m/s of the pelvis, for one frame in twenty
RISE = 3.0  # m between the pelvis's highest and lowest place: more is mentioned
STILL = 0.001  # m
PLANTED = 0.5  # share of the feet's movement about the pelvis that its travel explains, where one can tell a unit
SLIDING = 2.0  # times that translations are too long or too short for the feet: more is mentioned
JUMP, JERKY, MOVING = 1.2, 1.3, 0.02  # radians a frame; change of a frame's turns to these; radians a frame
BACKWARDS, SIDEWAYS, TWISTED = 15.0, 40.0, 60.0  # degrees, medians over the frames


def check_up(up: str | None) -> None:
    """Raises `AvatarError` for an ``up`` that is no axis, "auto" or None."""
    if up not in (None, AUTO, *Y_FROM):
        raise unknown_name("up", str(up), (*Y_FROM, AUTO))


def check_units(units: str | None) -> None:
    """Raises `AvatarError` for a unit of length that is not known."""
    if units not in (None, *METRES):
        raise unknown_name("units", str(units), METRES)


def joint_places(poses: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Joints ``(T, 22, 3)`` relative to the pelvis, metres, of poses ``(T, 22, 3)`` and joints at rest ``(22, 3)``."""
    turns: list[Rotation] = []
    places = np.zeros((len(poses), len(SMPL_PARENTS), 3))
    for joint, parent in enumerate(SMPL_PARENTS):
        own = Rotation.from_rotvec(poses[:, joint].astype(np.float64))
        turns.append(own if parent < 0 else turns[parent] * own)
        if parent >= 0:
            places[:, joint] = places[:, parent] + turns[parent].apply(rest[joint] - rest[parent])
    return places


def settle_up(path: Path, low: np.ndarray, high: np.ndarray, up: str | None, usual: str | None) -> str:
    """The axis that is up in a file: ``up`` if given, else the ``usual`` one of its format, which people must agree to.

    ``low`` and ``high`` ``(T, 3)`` are people's ankles and shoulders. "auto", and formats without a usual axis, take
    the one that people stand along. Raises `DataError`, with the figure, where people stand along another than the
    usual, or along none where that must tell. An axis given that people do not stand along is warned about.
    """
    bones = high - low
    mean = (bones / np.maximum(np.linalg.norm(bones, axis=1, keepdims=True), 1e-12)).mean(axis=0)
    shares = {axis: float(mean @ turn[1]) for axis, turn in Y_FROM.items()}
    best = max(shares, key=shares.get)
    wanted = usual if up in (None, AUTO) else up
    share = f"({shares[best]:.2f} of 1 from ankles to shoulders, over the frames)"
    if wanted and shares[wanted] >= UPRIGHT:
        return wanted
    if up not in (None, AUTO):
        log.warning("%s: people do not stand along %s, as up=%s says, but along %s %s.", path, up, up, best, share)
    elif (up == AUTO or usual is None) and shares[best] >= ELSEWHERE:
        log.warning("%s: people stand along %s %s, which is taken for up.", path, best, share)
        return best
    elif usual is None or up == AUTO:
        raise DataError(
            path, f"expected people who stand along an axis, the nearest is {best} {share}.", "Give up=y, z, -y or -z."
        )
    elif shares[best] > ELSEWHERE:
        problem = f"expected people upright along {usual}, they are upright along {best} {share}."
        raise DataError(path, problem, f"Give up={best}, or up={usual} if people really lie down.")
    else:
        log.warning(
            "%s: people stand %.2f of 1 along %s, which is taken for up; give up= if it is not.",
            *(path, shares[usual], usual),
        )
    return wanted


def check_travel(path: Path, places: np.ndarray, travel: np.ndarray, fps: float, units: str | None) -> None:
    """Refuses translations ``(T, 3)``, y up, in another unit than metres, unless ``units`` are given.

    While a foot stands the pelvis moves against it: what it moves by, in metres, over what the file says is the unit.
    ``places (T, 22, 3)`` are joints about the pelvis. Also refused: more than 15 m/s; a rise of 3 m is warned about.
    """
    speed = float(np.percentile(np.linalg.norm(np.diff(travel, axis=0), axis=1), 95)) * fps if len(travel) > 3 else 0.0
    stride = max(1, round(fps / 15))  # frames; over fewer, noise is more than movement
    places, steps = places[::stride], np.diff(travel[::stride], axis=0)
    if len(travel) < 4 or not speed:
        return
    hint = "Give units=cm, mm, in or, if it is right, m."
    feet = places[:, [INDEX[f"{side}_{joint}"] for side in ("left", "right") for joint in ("ankle", "foot")]]
    lowest = (feet[1:, :, 1] + feet[:-1, :, 1]).argmin(axis=1)
    moved = np.diff(feet, axis=0)[np.arange(len(steps)), lowest]
    scale, explained = _planted(moved, steps)
    others = {axis: _planted(moved, steps @ turn.T)[1] for axis, turn in Y_FROM.items() if axis != "y"}
    best = max(others, key=others.get)
    if len(steps) >= 10 and others[best] > PLANTED and explained < PLANTED / 2:
        message = "translations fit the feet (%.2f of 1, as they are %.2f) if they are turned up without the poses"
        log.warning(f"%s: {message}: correct the file if people fly.", path, others[best], explained)
    if units is None and len(steps) >= 10 and explained > PLANTED and 0 < scale < 0.1:
        near = min(METRES, key=lambda name: abs(np.log(METRES[name] / scale)))
        problem = f"expected translations in metres, feet stand still if their unit is {scale:.3g} m, which is {near}."
        raise DataError(path, problem, f"Give units={near} or, if they are in metres, units=m.")
    if units is None and len(steps) >= 10 and explained > PLANTED and not 1 / SLIDING < scale < SLIDING:
        message = "feet slide: they stand still if translations are multiplied by %.2f; are they in metres?"
        log.warning(f"%s: {message}", path, scale)
    if units is None and speed > FASTEST:
        raise DataError(path, f"expected a pelvis slower than {FASTEST:g} m/s, it moves at {speed:.3g} m/s.", hint)
    if (rise := float(np.ptp(travel[:, 1]))) > RISE:
        log.warning("%s: the pelvis rises and falls by %.1f m; give up= or units= if people fly.", path, rise)


def _planted(moved: np.ndarray, steps: np.ndarray) -> tuple[float, float]:
    """The factor of the pelvis's ``steps (T, 3)`` that undoes how the standing foot ``moved`` about it, and the share
    of that movement's square which it undoes; feet that move less than a millimetre say nothing.
    """
    if np.square(moved).sum() < len(moved) * STILL**2:
        return 1.0, 0.0
    scale = -float((moved * steps).sum() / max(float((steps * steps).sum()), 1e-12))
    return scale, 1 - float(np.square(moved + scale * steps).sum() / np.square(moved).sum())


def check_sides(path: Path, places: np.ndarray, source: dict[int, int]) -> None:
    """Warns of toes behind their ankles, as where left and right are swapped; ``places (T, J, 3)`` are y-up."""
    left, right = (places[:, source[INDEX[f"{side}_hip"]]] for side in ("left", "right"))
    ahead = np.cross(left - right, [0.0, 1.0, 0.0])
    for side in ("left", "right"):
        ankle, foot = (source.get(INDEX[f"{side}_{joint}"]) for joint in ("ankle", "foot"))
        if foot is None:
            continue
        toes = places[:, foot] - places[:, ankle]
        lengths = np.linalg.norm(toes, axis=1) * np.linalg.norm(ahead, axis=1)
        cosine = float(np.median((toes * ahead).sum(axis=1) / np.maximum(lengths, 1e-12)))
        if cosine < -UPRIGHT:
            message = "toes point backwards (%s: %.2f of 1): left and right may be swapped, joints=map.yaml names them."
            log.warning(f"%s: {message}", path, side, -cosine)


def check_joint_order(path: Path, poses: np.ndarray) -> None:
    """Warns of knees and elbows that bend backwards, knees that bend sideways and trunks that twist: joints in another
    order than SMPL's do so.
    """
    bends = {
        **{f"{side}_knee": poses[:, INDEX[f"{side}_knee"], 0] for side in ("left", "right")},
        **{f"{s}_elbow": poses[:, INDEX[f"{s}_elbow"], 1] * (-1 if s == "left" else 1) for s in ("left", "right")},
    }
    medians = {joint: float(np.degrees(np.median(angles))) for joint, angles in bends.items()}
    trunk = {j: np.linalg.norm(poses[:, INDEX[j]], axis=1) for j in ("spine1", "spine2", "spine3", "neck")}
    turned = {joint: float(np.degrees(np.median(angles))) for joint, angles in trunk.items()}
    across = {f"{side}_knee": poses[:, INDEX[f"{side}_knee"], 1:] for side in ("left", "right")}
    sideways = {j: float(np.degrees(np.median(np.linalg.norm(turns, axis=1)))) for j, turns in across.items()}
    faults = [f"{joint} bends backwards by {-angle:.0f}" for joint, angle in medians.items() if angle < -BACKWARDS]
    faults += [f"{joint} is turned by {angle:.0f}" for joint, angle in turned.items() if angle > TWISTED]
    faults += [f"{joint} bends sideways by {angle:.0f}" for joint, angle in sideways.items() if angle > SIDEWAYS]
    if faults:
        log.warning(
            "%s: %s degrees (medians): expected joints in SMPL's order, left before right; look at the result.",
            *(path, ", ".join(faults)),
        )


def check_order(path: Path, poses: np.ndarray) -> None:
    """Warns of poses ``(T, J, 3)`` that jump from frame to frame, as where frames are in another order or damaged."""
    if len(poses) < 4:
        return
    turns = Rotation.from_rotvec(poses.reshape(-1, 3).astype(np.float64)).as_matrix().reshape(*poses.shape[:2], 9)
    steps = np.diff(turns, axis=0)
    sizes = np.linalg.norm(steps, axis=2) / np.sqrt(2)  # radians, where they are small
    changes = np.linalg.norm(np.diff(steps, axis=0), axis=2) / np.sqrt(2)
    moving, change = (float(np.median(values.mean(axis=1))) for values in (sizes, changes))
    if moving > MOVING and change > JERKY * moving:
        log.warning(
            "%s: joints turn to and fro from frame to frame (%.2f times what they turn by): are frames in their order?",
            *(path, change / moving),
        )
    elif (jumps := np.flatnonzero(sizes.max(axis=1) > JUMP)).size:
        log.warning(
            "%s: joints jump by up to %.1f radians between %d frames, first after frame %d: look at the result.",
            *(path, sizes.max(), len(jumps), jumps[0]),
        )
