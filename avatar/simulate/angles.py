"""A person's degrees of freedom: named angles in degrees, with the everyday poses and the motions written in them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS
from avatar.checks import AvatarError, unknown_name
from avatar.io.motions import check_rate
from avatar.records import Motion

LONGEST = 3600  # seconds of a motion

# The degrees of freedom of a person, in degrees: least, at ease, most. Arms: 0 abduction hangs, 90 is the T-pose. The
# pelvis tilts in everyday poses only: pose encoders see the body in its root frame, without the direction of gravity.
LIMITS = {
    "yaw": (-25, 0, 25),  # + turns to the left
    "pelvis_bend": (-15, 0, 40),  # + forward
    "pelvis_lean": (-15, 0, 15),  # + to the left
    "trunk_bend": (-20, 0, 55),  # + forward
    "trunk_twist": (-40, 0, 40),  # + to the left
    "trunk_lean": (-25, 0, 25),  # + to the left
    "head_nod": (-30, 0, 35),  # + down
    "head_turn": (-50, 0, 50),  # + to the left
    "head_tilt": (-20, 0, 20),  # + to the left
    "hip_flexion": (-25, 2, 85),  # + knee forward and up
    "hip_abduction": (-4, 4, 40),  # + outward
    "hip_turn": (-20, 0, 30),  # + toes outward
    "knee_flexion": (0, 4, 110),
    "ankle_flexion": (-35, 0, 30),  # + toes up
    "arm_abduction": (20, 27, 145),  # + sideways and up
    "arm_flexion": (-40, 4, 100),  # + forward
    "arm_sweep": (-20, 15, 60),  # + across the chest when raised, forearm inward when hanging
    "elbow_flexion": (3, 18, 125),
    "forearm_turn": (-40, 0, 40),
    "wrist_bend": (-25, 0, 25),
}
CENTRAL = {name for name in LIMITS if name.split("_")[0] in ("yaw", "pelvis", "trunk", "head")}
SIDES = (("left", 1.0), ("right", -1.0))
Angles = dict[str, np.ndarray]
Draw = Callable[[float, float], np.ndarray]  # fresh values between two bounds, one a pose


def pose_from_angles(angles: Angles, frames: int) -> np.ndarray:
    """Poses ``(T, 22, 3)`` from named degrees of freedom, numbers or ``(T,)``; what is not named stands at ease.

    Central names are those of `LIMITS`, paired ones carry a side, as in ``left_knee_flexion``. Angles are held within
    their limits. Raises `AvatarError` for a name that no degree of freedom has.
    """
    sources = {name if name in CENTRAL else f"left_{name}": name for name in LIMITS}
    sources |= {f"right_{name}": name for name in LIMITS if name not in CENTRAL}
    unknown = sorted(set(angles) - set(sources))
    if unknown:
        raise AvatarError(f"angles: expected names among {', '.join(sources)}, got {', '.join(unknown)}.")

    def angle(name: str) -> np.ndarray:
        least, ease, most = LIMITS[sources[name]]
        return np.clip(np.broadcast_to(np.asarray(angles.get(name, ease), np.float64), (frames,)), least, most)

    turns = {"pelvis": _turn(y=angle("yaw")) * _turn(x=angle("pelvis_bend"), z=-angle("pelvis_lean"))}
    bend, twist, lean = (angle(f"trunk_{kind}") for kind in ("bend", "twist", "lean"))
    for joint, share in (("spine1", 0.3), ("spine2", 0.35), ("spine3", 0.35)):
        turns[joint] = _turn(x=bend * share, y=twist * share, z=-lean * share)
    turns["neck"] = turns["head"] = _turn(angle("head_nod") / 2, angle("head_turn") / 2, -angle("head_tilt") / 2)
    for side, mirror in SIDES:
        at = {name: angle(f"{side}_{name}") for name in LIMITS if name not in CENTRAL}
        raised = at["arm_abduction"] - 90
        collar = 0.25 * np.clip(raised + 30, 0, None)  # the collar bone lifts with the arm
        limbs = {
            "hip": _turn(-at["hip_flexion"], mirror * at["hip_turn"], mirror * at["hip_abduction"]),
            "knee": _turn(at["knee_flexion"]),
            "ankle": _turn(-at["ankle_flexion"]),
            "collar": _turn(z=mirror * collar),
            "shoulder": _turn(-at["arm_flexion"], -mirror * at["arm_sweep"], mirror * (raised - collar)),
            "elbow": _turn(at["forearm_turn"], -mirror * at["elbow_flexion"]),
            "wrist": _turn(z=mirror * at["wrist_bend"]),
        }
        turns |= {f"{side}_{joint}": turn for joint, turn in limbs.items()}
    poses = np.zeros((frames, len(SMPL_JOINTS), 3))
    for joint, rotation in turns.items():
        poses[:, SMPL_JOINTS.index(joint)] = rotation.as_rotvec()
    return poses.astype(np.float32)


def _turn(x=0.0, y=0.0, z=0.0) -> Rotation:
    """Rotation by z, then y, then x, about the world-aligned axes of a joint; degrees, arrays ``(T,)``."""
    return Rotation.from_euler("XYZ", np.stack(np.broadcast_arrays(x, y, z), axis=-1), degrees=True)


def everyday_angles(name: str, count: int, seed: int) -> Angles:
    """Degrees of freedom ``(count,)`` of a family of `EVERYDAY`: a relaxed stance, changed as the family says.

    Draws are a scrambled Sobol sequence of the seed, ``count`` a power of two. Legs stay under a tilted pelvis: its
    tilt is added to hip angles, so that feet stay on the ground.
    """
    from scipy.stats import qmc  # here, for it takes half a second to load

    rng = np.random.default_rng([seed, list(EVERYDAY).index(name)])
    unit = iter(qmc.Sobol(48, scramble=True, rng=rng).random(count).T)

    def draw(low: float, high: float) -> np.ndarray:
        return low + (high - low) * next(unit)

    angles = _drawn(draw, RELAXED)
    angles["trunk_lean"] = angles["trunk_lean"] - angles["pelvis_lean"]
    family = EVERYDAY[name]
    angles |= family(draw) if callable(family) else _drawn(draw, family)
    for side, mirror in SIDES:
        angles[f"{side}_hip_flexion"] = angles[f"{side}_hip_flexion"] + angles["pelvis_bend"]
        angles[f"{side}_hip_abduction"] = angles[f"{side}_hip_abduction"] + mirror * angles["pelvis_lean"]
        angles[f"{side}_ankle_flexion"] = angles[f"{side}_knee_flexion"] / 2
    return angles


def _drawn(draw: Draw, bounds: dict[str, tuple[float, float]]) -> Angles:
    """Angles drawn within bounds: central ones, then those of each side."""
    angles = {name: draw(*ends) for name, ends in bounds.items() if name in CENTRAL}
    paired = {name: ends for name, ends in bounds.items() if name not in CENTRAL}
    return angles | {f"{side}_{name}": draw(*ends) for side, _ in SIDES for name, ends in paired.items()}


def _stride(draw: Draw) -> Angles:
    """Small strides of any phase, arms against legs."""
    phase, width, lifted = draw(0, 2 * np.pi), draw(5, 15), draw(10, 34)
    made = {}
    for side, mirror in SIDES:
        swing = mirror * np.sin(phase)
        made[f"{side}_hip_flexion"] = 3 + width * swing
        made[f"{side}_knee_flexion"] = 5 + lifted * np.clip(mirror * np.cos(phase), 0, 1) ** 2
        made[f"{side}_arm_flexion"] = draw(-2, 8) - 0.7 * width * swing
    return made


def _lift(draw: Draw) -> Angles:
    """One arm up, forward or sideways, as to take or show something; either side."""
    side = draw(-1, 1)
    made = {"trunk_lean": 9 * side + draw(-3, 3), "trunk_twist": draw(-12, 12), "head_nod": draw(-18, 10)}
    for name, mirror in SIDES:
        share = np.clip(1.4 * mirror * side + 0.2, 0, 1)
        made[f"{name}_arm_abduction"] = draw(24, 32) + share * draw(0, 70)
        made[f"{name}_arm_flexion"] = draw(-6, 8) + share * draw(10, 88)
        made[f"{name}_elbow_flexion"] = draw(6, 30) + share * draw(0, 50)
    return made


def _turn_around(draw: Draw) -> Angles:
    """Looking back over a shoulder: trunk, head and pelvis turned the same way."""
    way = draw(-1, 1)
    made = {"trunk_twist": 32 * way, "head_turn": 38 * way + draw(-8, 8), "yaw": 20 * way, "pelvis_lean": draw(-8, 8)}
    made |= {f"{side}_hip_turn": 5 - 12 * mirror * way for side, mirror in SIDES}
    return made | {f"{side}_arm_flexion": draw(-8, 10) - 14 * mirror * way for side, mirror in SIDES}


RELAXED = {
    **{"yaw": (-20, 20), "pelvis_bend": (-9, 11), "pelvis_lean": (-7, 7)},
    **{"trunk_bend": (-7, 9), "trunk_twist": (-9, 9), "trunk_lean": (-6, 6)},
    **{"head_nod": (-14, 18), "head_turn": (-26, 26), "head_tilt": (-8, 8)},
    **{"hip_flexion": (-3, 6), "knee_flexion": (1, 9), "hip_abduction": (2, 10), "hip_turn": (-2, 16)},
    **{"arm_abduction": (22, 32), "arm_flexion": (-10, 14), "arm_sweep": (4, 24), "elbow_flexion": (6, 34)},
}
EVERYDAY: dict[str, dict[str, tuple[float, float]] | Callable[[Draw], Angles]] = {
    "stand": {},  # straight legs, the weight on one of them
    "stride": _stride,
    "sit": {  # upright to bent forward, hands before the trunk or beside it
        **{"pelvis_bend": (-12, 6), "trunk_bend": (-4, 28)},
        **{"hip_flexion": (62, 78), "knee_flexion": (62, 105), "hip_abduction": (5, 20)},
        **{"arm_flexion": (-5, 48), "arm_abduction": (28, 48), "elbow_flexion": (10, 70)},
    },
    "lift": _lift,
    "lean": {  # bent at the hips, leaning to a side, hands free
        **{"pelvis_bend": (0, 34), "pelvis_lean": (-13, 13)},
        **{"trunk_bend": (0, 24), "trunk_lean": (-16, 16), "trunk_twist": (-18, 18)},
        **{"knee_flexion": (2, 26), "arm_flexion": (5, 55)},
    },
    "gesture": {  # both arms moving before or beside the trunk
        **{"arm_abduction": (25, 72), "arm_flexion": (-22, 52), "arm_sweep": (-5, 32)},
        **{"elbow_flexion": (20, 92), "forearm_turn": (-28, 28)},
    },
    "turn": _turn_around,
}


def check_timing(fps: float, seconds: float) -> None:
    """Raises `AvatarError` for a frame rate or a length in seconds out of range, NaN included."""
    check_rate(fps)
    if not 0 <= seconds <= LONGEST:
        raise AvatarError(f"seconds: expected 0 to {LONGEST}, got {seconds}.")


def authored_motion(name: str, fps: float = 30.0, seconds: float = 6.0) -> Motion:
    """A continuous, looping motion of `SEQUENCES` as a person would make it, the pelvis in place.

    What the open dataset is tested on. Raises `AvatarError` for an unknown name, a rate or a length out of range, or
    when no frame would result.
    """
    if name not in SEQUENCES:
        raise unknown_name("name", name, SEQUENCES)
    check_timing(fps, seconds)
    frames = round(fps * seconds)
    if frames < 1:
        raise AvatarError(f"fps, seconds: expected at least one frame, got {fps} fps for {seconds} s.")
    period, angles_of = SEQUENCES[name]
    phase, angles = 2 * np.pi * np.arange(frames) / (fps * period), {}
    for side, mirror in SIDES:
        for key, value in angles_of(phase, mirror).items():
            angles[f"{side}_{key}" if key in LIMITS and key not in CENTRAL else key] = value
    return Motion(pose_from_angles(angles, frames), np.zeros((frames, 3), np.float32), float(fps), name)


# Each motion gives the central angles, and those of the side whose ``mirror`` is 1 (left) or -1 (right).


def _walk(phase: np.ndarray, mirror: float) -> Angles:
    """Two steps; arms swing against the legs."""
    step = phase + (1 - mirror) / 2 * np.pi
    return {
        "trunk_twist": 7 * np.sin(phase),
        "head_turn": -5 * np.sin(phase),
        "trunk_bend": 3,
        "hip_flexion": 7 + 24 * np.sin(step),
        "knee_flexion": 7 + 46 * ((1 + np.cos(step - 0.2)) / 2) ** 2,
        "ankle_flexion": 4 - 9 * np.cos(step),
        "arm_flexion": 2 - 22 * np.sin(step),
        "elbow_flexion": 22 - 12 * np.sin(step),
    }


def _squat(phase: np.ndarray, mirror: float) -> Angles:
    """Down and up, arms forward for balance."""
    deep = (1 - np.cos(phase)) / 2
    return {
        "trunk_bend": 24 * deep,
        "head_nod": -14 * deep,
        "hip_flexion": 2 + 70 * deep,
        "knee_flexion": 4 + 86 * deep,
        "ankle_flexion": 2 + 16 * deep,
        "hip_abduction": 8 + 10 * deep,
        "hip_turn": 5 + 10 * deep,
        "arm_flexion": 4 + 62 * deep,
        "elbow_flexion": 18 - 6 * deep,
    }


def _twist(phase: np.ndarray, mirror: float) -> Angles:
    """The trunk turns from side to side, elbows out."""
    turn = np.sin(phase)
    return {
        "trunk_twist": 36 * turn,
        "head_turn": 22 * turn,
        "trunk_lean": 4 * turn,
        "arm_abduction": 58 + 6 * np.cos(2 * phase),
        "elbow_flexion": 48,
        "hip_abduction": 9,
        "arm_sweep": 22 - 16 * mirror * turn,
        "knee_flexion": 8 + 10 * mirror * turn,
    }


def _reach(phase: np.ndarray, mirror: float) -> Angles:
    """One arm reaches up and across, then the other."""
    up = ((1 + mirror * np.sin(phase)) / 2) ** 2
    return {
        "trunk_lean": 14 * np.sin(phase),
        "trunk_twist": 12 * np.sin(phase),
        "head_nod": -14 * np.sin(phase) ** 2,
        "head_turn": -18 * np.sin(phase),
        "arm_abduction": 27 + 103 * up,
        "arm_flexion": 4 + 22 * up,
        "arm_sweep": 15 + 12 * up,
        "elbow_flexion": 20 - 8 * up,
        "knee_flexion": 6 + 14 * (1 - up) ** 2,
        "hip_flexion": 3 + 8 * (1 - up) ** 2,
    }


def _kick(phase: np.ndarray, mirror: float) -> Angles:
    """The right leg swings back and kicks forward; the left arm goes with it."""
    swing = np.sin(phase)
    return {
        "trunk_bend": 6 - 12 * swing,
        "trunk_twist": 14 * swing,
        "right_hip_flexion": 20 + 42 * swing,
        "right_knee_flexion": 12 + 26 * (1 - np.sin(phase + 0.5)),
        "right_ankle_flexion": -12 * np.clip(swing, 0, None) ** 1.5,
        "right_hip_abduction": 6 + 4 * swing**2,
        "left_knee_flexion": 14 + 6 * swing,
        "left_hip_flexion": 8 + 3 * swing,
        "left_arm_flexion": 12 + 34 * swing,
        "right_arm_flexion": -4 - 20 * swing,
        "left_arm_abduction": 40 + 12 * swing**2,
        "right_arm_abduction": 46 + 14 * swing**2,
        "left_elbow_flexion": 30 + 12 * swing,
        "right_elbow_flexion": 30 - 8 * swing,
    }


def _bend(phase: np.ndarray, mirror: float) -> Angles:
    """Bowing forward with hanging arms, leaning to each side in turn."""
    down = (1 - np.cos(2 * phase)) / 2
    return {
        "trunk_bend": 50 * down,
        "head_nod": 12 * down,
        "trunk_lean": 12 * np.sin(phase),
        "trunk_twist": 14 * np.sin(phase) * down,
        "arm_flexion": 4 + 40 * down,
        "knee_flexion": 5 + 16 * down,
        "hip_flexion": 3 + 18 * down,
        "hip_abduction": 8,
    }


def _dance(phase: np.ndarray, mirror: float) -> Angles:
    """Swaying hips and raised, waving arms over three rhythms."""
    shift = (1 - mirror) / 2 * 2.2
    return {
        "yaw": 12 * np.sin(phase),
        "trunk_lean": 11 * np.sin(2 * phase),
        "trunk_twist": 16 * np.sin(phase + 0.6),
        "trunk_bend": 8 + 8 * np.cos(3 * phase),
        "head_tilt": 9 * np.sin(2 * phase + 0.5),
        "head_turn": 20 * np.sin(phase),
        "arm_abduction": 82 + 40 * np.sin(phase + shift),
        "arm_sweep": 22 + 16 * np.sin(2 * phase + shift),
        "arm_flexion": 8 + 14 * np.cos(phase + shift),
        "elbow_flexion": 52 + 32 * np.sin(2 * phase + shift + 0.8),
        "hip_flexion": 16 + 18 * np.sin(2 * phase + 1.4 * shift),
        "knee_flexion": 30 + 24 * np.sin(2 * phase + 1.4 * shift - 0.3),
        "hip_abduction": 10 + 6 * np.sin(phase + shift),
    }


# name: seconds a loop, and its angles over the phase in radians
SEQUENCES: dict[str, tuple[float, Callable[[np.ndarray, float], Angles]]] = {
    "walk": (1.5, _walk),
    "squat": (4.0, _squat),
    "twist": (4.0, _twist),
    "reach": (5.0, _reach),
    "kick": (3.0, _kick),
    "bend": (6.0, _bend),
    "dance": (6.0, _dance),
}
