"""A person's degrees of freedom: named angles in degrees, with limits, and the poses they make."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS
from avatar.checks import AvatarError

# The degrees of freedom of a person, in degrees. Arms: 0 abduction hangs, 90 is the T-pose. The pelvis tilts in
# everyday poses only: pose encoders see the body in its root frame, where the direction of gravity does not show.
LIMITS = {
    "yaw": (-25, 25),  # + turns to the left
    "pelvis_bend": (-15, 40),  # + forward
    "pelvis_lean": (-15, 15),  # + to the left
    "trunk_bend": (-20, 55),  # + forward
    "trunk_twist": (-40, 40),  # + to the left
    "trunk_lean": (-25, 25),  # + to the left
    "head_nod": (-30, 35),  # + down
    "head_turn": (-50, 50),  # + to the left
    "head_tilt": (-20, 20),  # + to the left
    "hip_flexion": (-25, 85),  # + knee forward and up
    "hip_abduction": (-4, 40),  # + outward
    "hip_turn": (-20, 30),  # + toes outward
    "knee_flexion": (0, 110),
    "ankle_flexion": (-35, 30),  # + toes up
    "arm_abduction": (20, 145),  # + sideways and up
    "arm_flexion": (-40, 100),  # + forward
    "arm_sweep": (-20, 60),  # + across the chest when raised, forearm inward when hanging
    "elbow_flexion": (3, 125),
    "forearm_turn": (-40, 40),
    "wrist_bend": (-25, 25),
}
CENTRAL = {name for name in LIMITS if name.split("_")[0] in ("yaw", "pelvis", "trunk", "head")}
STANCE = {
    "arm_abduction": 27,
    "arm_flexion": 4,
    "arm_sweep": 15,
    "elbow_flexion": 18,
    "hip_abduction": 4,
    "knee_flexion": 4,
    "hip_flexion": 2,
}
Angles = dict[str, np.ndarray]


def pose_from_angles(angles: Angles, frames: int) -> np.ndarray:
    """Poses ``(T, 22, 3)`` from named degrees of freedom; what is not named stands at ease.

    Central names are those of `LIMITS`, paired ones carry a side, as in ``left_knee_flexion``. Angles are numbers
    or ``(T,)``, degrees, and are held within `LIMITS`.

    Raises:
        AvatarError: for a name that no degree of freedom has.
    """
    left = {name if name in CENTRAL else f"left_{name}": name for name in LIMITS}
    right = {f"right_{name}": name for name in LIMITS if name not in CENTRAL}
    sources = {**left, **right}
    unknown = sorted(set(angles) - set(sources))
    if unknown:
        raise AvatarError(f"angles: expected names among {', '.join(sources)}, got {', '.join(unknown)}.")

    def angle(name: str) -> np.ndarray:
        base = sources[name]
        value = np.broadcast_to(np.asarray(angles.get(name, STANCE.get(base, 0)), np.float64), (frames,))
        return np.clip(value, *LIMITS[base])

    tilt = _turn(x=angle("pelvis_bend"), z=-angle("pelvis_lean"))
    turns: dict[str, Rotation] = {"pelvis": _turn(y=angle("yaw")) * tilt}
    bend, twist, lean = (angle(f"trunk_{kind}") for kind in ("bend", "twist", "lean"))
    for joint, share in (("spine1", 0.3), ("spine2", 0.35), ("spine3", 0.35)):
        turns[joint] = _turn(x=bend * share, y=twist * share, z=-lean * share)
    nod, turn, tilt = (angle(f"head_{kind}") for kind in ("nod", "turn", "tilt"))
    for joint in ("neck", "head"):
        turns[joint] = _turn(x=nod / 2, y=turn / 2, z=-tilt / 2)
    for side, mirror in (("left", 1.0), ("right", -1.0)):
        turns |= _limbs(side, mirror, lambda name, side=side: angle(f"{side}_{name}"))
    poses = np.zeros((frames, len(SMPL_JOINTS), 3))
    for joint, rotation in turns.items():
        poses[:, SMPL_JOINTS.index(joint)] = rotation.as_rotvec()
    return poses.astype(np.float32)


def _turn(x=0.0, y=0.0, z=0.0) -> Rotation:
    """Rotation by z, then y, then x, about the world-aligned axes of a joint; degrees, arrays ``(T,)``."""
    return Rotation.from_euler("XYZ", np.stack(np.broadcast_arrays(x, y, z), axis=-1), degrees=True)


def _limbs(side: str, mirror: float, angle: Callable[[str], np.ndarray]) -> dict[str, Rotation]:
    """Joint rotations of one leg and one arm. ``mirror`` is 1 on the left and -1 on the right."""
    raised = angle("arm_abduction") - 90
    collar = 0.25 * np.clip(raised + 30, 0, None)  # the collar bone lifts with the arm
    return {
        f"{side}_hip": _turn(x=-angle("hip_flexion"), y=mirror * angle("hip_turn"), z=mirror * angle("hip_abduction")),
        f"{side}_knee": _turn(x=angle("knee_flexion")),
        f"{side}_ankle": _turn(x=-angle("ankle_flexion")),
        f"{side}_collar": _turn(z=mirror * collar),
        f"{side}_shoulder": _turn(
            x=-angle("arm_flexion"), y=-mirror * angle("arm_sweep"), z=mirror * (raised - collar)
        ),
        f"{side}_elbow": _turn(x=angle("forearm_turn"), y=-mirror * angle("elbow_flexion")),
        f"{side}_wrist": _turn(z=mirror * angle("wrist_bend")),
    }
