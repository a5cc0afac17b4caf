"""Authored motions (walk, squat, twist, reach, kick, bend, dance): what the open dataset is tested on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avatar.checks import AvatarError, unknown_name
from avatar.records import Motion
from avatar.simulate.angles import Angles, pose_from_angles


def _walk(phase: np.ndarray) -> Angles:
    """Two steps; arms swing against the legs."""
    angles: Angles = {"trunk_twist": 7 * np.sin(phase), "head_turn": -5 * np.sin(phase), "trunk_bend": 3 + 0 * phase}
    for side, shift in (("left", 0.0), ("right", np.pi)):
        step = phase + shift
        angles |= {
            f"{side}_hip_flexion": 7 + 24 * np.sin(step),
            f"{side}_knee_flexion": 7 + 46 * ((1 + np.cos(step - 0.2)) / 2) ** 2,
            f"{side}_ankle_flexion": 4 - 9 * np.cos(step),
            f"{side}_arm_flexion": 2 - 22 * np.sin(step),
            f"{side}_elbow_flexion": 22 - 12 * np.sin(step),
        }
    return angles


def _squat(phase: np.ndarray) -> Angles:
    """Down and up, arms forward for balance."""
    deep = (1 - np.cos(phase)) / 2
    both = {
        "hip_flexion": 2 + 70 * deep,
        "knee_flexion": 4 + 86 * deep,
        "ankle_flexion": 2 + 16 * deep,
        "hip_abduction": 8 + 10 * deep,
        "hip_turn": 5 + 10 * deep,
        "arm_flexion": 4 + 62 * deep,
        "elbow_flexion": 18 - 6 * deep,
    }
    return {"trunk_bend": 24 * deep, "head_nod": -14 * deep, **_both(both)}


def _twist(phase: np.ndarray) -> Angles:
    """The trunk turns from side to side, elbows out."""
    turn = np.sin(phase)
    both = {"arm_abduction": 58 + 6 * np.cos(2 * phase), "elbow_flexion": 48 + 0 * phase, "hip_abduction": 9}
    swing = {"left_arm_sweep": 22 - 16 * turn, "right_arm_sweep": 22 + 16 * turn}
    knees = {"left_knee_flexion": 8 + 10 * turn, "right_knee_flexion": 8 - 10 * turn}
    return {"trunk_twist": 36 * turn, "head_turn": 22 * turn, "trunk_lean": 4 * turn, **_both(both), **swing, **knees}


def _reach(phase: np.ndarray) -> Angles:
    """One arm reaches up and across, then the other."""
    angles: Angles = {"trunk_lean": 14 * np.sin(phase), "trunk_twist": 12 * np.sin(phase)}
    angles |= {"head_nod": -14 * np.sin(phase) ** 2, "head_turn": -18 * np.sin(phase)}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        up = ((1 + sign * np.sin(phase)) / 2) ** 2
        angles |= {
            f"{side}_arm_abduction": 27 + 103 * up,
            f"{side}_arm_flexion": 4 + 22 * up,
            f"{side}_arm_sweep": 15 + 12 * up,
            f"{side}_elbow_flexion": 20 - 8 * up,
            f"{side}_knee_flexion": 6 + 14 * (1 - up) ** 2,
            f"{side}_hip_flexion": 3 + 8 * (1 - up) ** 2,
        }
    return angles


def _kick(phase: np.ndarray) -> Angles:
    """The right leg swings back and kicks forward; the left arm goes with it."""
    swing = np.sin(phase)
    forward = np.clip(swing, 0, None) ** 1.5
    return {
        "trunk_bend": 6 - 12 * swing,
        "trunk_twist": 14 * swing,
        "right_hip_flexion": 20 + 42 * swing,
        "right_knee_flexion": 12 + 26 * (1 - np.sin(phase + 0.5)),
        "right_ankle_flexion": -12 * forward,
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


def _bend(phase: np.ndarray) -> Angles:
    """Bowing forward with hanging arms, leaning to each side in turn."""
    down = (1 - np.cos(2 * phase)) / 2
    both = {
        "arm_flexion": 4 + 40 * down,
        "knee_flexion": 5 + 16 * down,
        "hip_flexion": 3 + 18 * down,
        "hip_abduction": 8,
    }
    side = {"trunk_lean": 12 * np.sin(phase), "trunk_twist": 14 * np.sin(phase) * down}
    return {"trunk_bend": 50 * down, "head_nod": 12 * down, **side, **_both(both)}


def _dance(phase: np.ndarray) -> Angles:
    """Swaying hips and raised, waving arms over three rhythms."""
    angles: Angles = {
        "yaw": 12 * np.sin(phase),
        "trunk_lean": 11 * np.sin(2 * phase),
        "trunk_twist": 16 * np.sin(phase + 0.6),
        "trunk_bend": 8 + 8 * np.cos(3 * phase),
        "head_tilt": 9 * np.sin(2 * phase + 0.5),
        "head_turn": 20 * np.sin(phase),
    }
    for side, shift in (("left", 0.0), ("right", 2.2)):
        angles |= {
            f"{side}_arm_abduction": 82 + 40 * np.sin(phase + shift),
            f"{side}_arm_sweep": 22 + 16 * np.sin(2 * phase + shift),
            f"{side}_arm_flexion": 8 + 14 * np.cos(phase + shift),
            f"{side}_elbow_flexion": 52 + 32 * np.sin(2 * phase + shift + 0.8),
            f"{side}_hip_flexion": 16 + 18 * np.sin(2 * phase + 1.4 * shift),
            f"{side}_knee_flexion": 30 + 24 * np.sin(2 * phase + 1.4 * shift - 0.3),
            f"{side}_hip_abduction": 10 + 6 * np.sin(phase + shift),
        }
    return angles


def _both(angles: Angles) -> Angles:
    """The same angles on the left and on the right."""
    return {f"{side}_{name}": value for side in ("left", "right") for name, value in angles.items()}


# name: (seconds a loop, angles over the phase in radians)
SEQUENCES: dict[str, tuple[float, Callable[[np.ndarray], Angles]]] = {
    "walk": (1.5, _walk),
    "squat": (4.0, _squat),
    "twist": (4.0, _twist),
    "reach": (5.0, _reach),
    "kick": (3.0, _kick),
    "bend": (6.0, _bend),
    "dance": (6.0, _dance),
}


def authored_motion(name: str, fps: float = 30.0, seconds: float = 6.0) -> Motion:
    """A continuous, looping motion as a person would make it, the pelvis in place.

    Args:
        name: walk, squat, twist, reach, kick, bend or dance.
        fps: frames per second; seconds: length. Loops take 1.5 s (walk) to 6 s (bend, dance).

    Raises:
        AvatarError: for an unknown name, or when no frame would result.
    """
    if name not in SEQUENCES:
        raise unknown_name("name", name, SEQUENCES)
    frames = round(fps * seconds)
    if frames < 1:
        raise AvatarError(f"fps, seconds: expected at least one frame, got {fps} fps for {seconds} s.")
    period, angles = SEQUENCES[name]
    phase = 2 * np.pi * np.arange(frames) / (fps * period)
    poses = pose_from_angles(angles(phase), frames)
    return Motion(poses=poses, translations=np.zeros((frames, 3), np.float32), fps=float(fps), name=name)
