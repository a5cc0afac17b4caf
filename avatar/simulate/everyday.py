"""Everyday poses in seeded parametric families: what people do most of the time, apart from the test motions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avatar.simulate.angles import Angles

Draw = Callable[[float, float], np.ndarray]  # fresh values between two bounds, one a pose
SIDES = (("left", 1.0), ("right", -1.0))


def _stand(draw: Draw) -> Angles:
    """Straight legs, the weight on one of them."""
    return {}


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


def _sit(draw: Draw) -> Angles:
    """Seated, upright to bent forward, hands before the trunk or beside it."""
    made = {"pelvis_bend": draw(-12, 6), "trunk_bend": draw(-4, 28)}
    for side, _ in SIDES:
        made[f"{side}_hip_flexion"] = draw(62, 78)
        made[f"{side}_knee_flexion"] = draw(62, 105)
        made[f"{side}_hip_abduction"] = draw(5, 20)
        made[f"{side}_arm_flexion"] = draw(-5, 48)
        made[f"{side}_arm_abduction"] = draw(28, 48)
        made[f"{side}_elbow_flexion"] = draw(10, 70)
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


def _lean(draw: Draw) -> Angles:
    """Bent at the hips, leaning to a side, hands free."""
    made = {"pelvis_bend": draw(0, 34), "pelvis_lean": draw(-13, 13)}
    made |= {"trunk_bend": draw(0, 24), "trunk_lean": draw(-16, 16), "trunk_twist": draw(-18, 18)}
    for side, _ in SIDES:
        made[f"{side}_knee_flexion"] = draw(2, 26)
        made[f"{side}_arm_flexion"] = draw(5, 55)
    return made


def _gesture(draw: Draw) -> Angles:
    """Both arms moving before or beside the trunk."""
    made = {}
    for side, _ in SIDES:
        made[f"{side}_arm_abduction"] = draw(25, 72)
        made[f"{side}_arm_flexion"] = draw(-22, 52)
        made[f"{side}_arm_sweep"] = draw(-5, 32)
        made[f"{side}_elbow_flexion"] = draw(20, 92)
        made[f"{side}_forearm_turn"] = draw(-28, 28)
    return made


def _turn(draw: Draw) -> Angles:
    """Looking back over a shoulder: trunk, head and pelvis turned the same way."""
    way = draw(-1, 1)
    made = {"trunk_twist": 32 * way, "head_turn": 38 * way + draw(-8, 8), "yaw": 20 * way, "pelvis_lean": draw(-8, 8)}
    made |= {f"{side}_hip_turn": 5 - 12 * mirror * way for side, mirror in SIDES}
    return made | {f"{side}_arm_flexion": draw(-8, 10) - 14 * mirror * way for side, mirror in SIDES}


EVERYDAY = {
    "stand": _stand,
    "stride": _stride,
    "sit": _sit,
    "lift": _lift,
    "lean": _lean,
    "gesture": _gesture,
    "turn": _turn,
}


def everyday_angles(name: str, count: int, seed: int) -> Angles:
    """Degrees of freedom ``(count,)`` of a family's poses: a relaxed stance, changed as the family says.

    Draws are a scrambled Sobol sequence of the seed. Legs stay under a tilted pelvis: its tilt is added to hip
    angles, so that feet stay on the ground.

    Args:
        name: stand, stride, sit, lift, lean, gesture or turn; count: a power of two; seed: of the draws.
    """
    from scipy.stats import qmc  # here, for it takes half a second to load

    rng = np.random.default_rng([seed, list(EVERYDAY).index(name)])
    unit = iter(qmc.Sobol(48, scramble=True, rng=rng).random(count).T)

    def draw(low: float, high: float) -> np.ndarray:
        return low + (high - low) * next(unit)

    angles = {"yaw": draw(-20, 20), "pelvis_bend": draw(-9, 11), "pelvis_lean": draw(-7, 7), "trunk_bend": draw(-7, 9)}
    angles |= {"trunk_twist": draw(-9, 9), "trunk_lean": draw(-6, 6) - angles["pelvis_lean"]}
    angles |= {"head_nod": draw(-14, 18), "head_turn": draw(-26, 26), "head_tilt": draw(-8, 8)}
    for side, _ in SIDES:
        angles |= {
            f"{side}_hip_flexion": draw(-3, 6),
            f"{side}_knee_flexion": draw(1, 9),
            f"{side}_hip_abduction": draw(2, 10),
            f"{side}_hip_turn": draw(-2, 16),
            f"{side}_arm_abduction": draw(22, 32),
            f"{side}_arm_flexion": draw(-10, 14),
            f"{side}_arm_sweep": draw(4, 24),
            f"{side}_elbow_flexion": draw(6, 34),
        }
    angles |= EVERYDAY[name](draw)
    for side, mirror in SIDES:
        angles[f"{side}_hip_flexion"] = angles[f"{side}_hip_flexion"] + angles["pelvis_bend"]
        angles[f"{side}_hip_abduction"] = angles[f"{side}_hip_abduction"] + mirror * angles["pelvis_lean"]
        angles[f"{side}_ankle_flexion"] = angles[f"{side}_knee_flexion"] / 2
    return angles
