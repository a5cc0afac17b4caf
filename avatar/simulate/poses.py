"""Poses for the open dataset: everyday and random ones to train on, random and authored ones to test on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.distance import cdist

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.body.open import open_body, open_body_shapes
from avatar.checks import AvatarError, unknown_name
from avatar.geometry.surface import vertex_normals
from avatar.geometry.trees import build_tree
from avatar.simulate.angles import (
    EVERYDAY,
    LIMITS,
    SEQUENCES,
    SIDES,
    Angles,
    authored_motion,
    everyday_angles,
    pose_from_angles,
)

CLEARANCE = 0.03  # metres kept between forearms, hands, legs and the rest, so that cloth finds room
APART = 0.5  # radians, norm over all joints' axis-angles: no training pose is nearer to a frame of a test motion
STRAIGHT, UPRIGHT = 15.0, 20.0  # degrees of knees and of hips, up to which legs count as straight
KINDS = ("train", "test", "interpolation")


@dataclass(frozen=True)
class NamedPose:
    """One pose of the open dataset: ``name`` is ``<sequence>.<frame>``, ``pose (22, 3)`` axis-angle, radians."""

    name: str
    pose: np.ndarray


def random_angles(count: int, seed: int | list[int]) -> Angles:
    """Degrees of freedom of random poses, ``(count,)`` each: broad, correlated as people are, and spread evenly.

    A scrambled Sobol sequence over 27 factors, so that any number of first draws covers the space well. Hips and
    knees share a squat, a stride and a lifted leg, and with a thigh up the trunk bends less; arms share how far
    they are raised, and elbows fold as arms come forward.
    """
    from scipy.stats import qmc  # here, for it takes half a second to load

    factors = qmc.Sobol(27, scramble=True, rng=np.random.default_rng(seed)).random(count).T
    unit = iter(factors)
    signed = (2 * factor - 1 for factor in unit)
    angles = {"yaw": 15 * next(signed)}
    for name in ("trunk_bend", "trunk_twist", "trunk_lean", "head_nod", "head_turn", "head_tilt"):
        low, _, high = LIMITS[name]
        draw = next(signed)
        angles[name] = np.where(draw > 0, high, -low) * draw * np.abs(draw) ** 0.5
    squat, stride, lift = next(unit) ** 2.5, next(signed), next(signed)
    stance, raised, apart = 14 * next(unit) ** 2, next(unit) ** 1.5, next(signed)
    folded = np.clip(75 * squat + 60 * np.abs(lift) ** 1.5 * (1 - squat), 0, 75) / 75
    angles["trunk_bend"] = np.where(angles["trunk_bend"] > 0, 1 - 0.6 * folded, 1) * angles["trunk_bend"]
    for side, mirror in SIDES:
        lifted = np.clip(mirror * lift, 0, None) ** 1.5 * (1 - squat)
        flexion = 75 * squat + 25 * mirror * stride * (1 - squat) + 60 * lifted
        knee = 90 * squat + 8 + 65 * next(unit) ** 2 * (1 - squat)
        arm = np.clip(raised + 0.5 * mirror * apart, 0, 1)
        forward = next(signed)
        angles |= {
            f"{side}_hip_flexion": flexion,
            f"{side}_knee_flexion": knee,
            f"{side}_ankle_flexion": (knee - flexion) * (1 - lifted) * 0.8,
            f"{side}_hip_abduction": 3 + stance + 14 * next(unit) ** 2,
            f"{side}_hip_turn": 5 + 14 * next(signed),
            f"{side}_arm_abduction": 24 + 112 * arm,
            f"{side}_arm_flexion": np.where(forward > 0, 85, 30) * forward * (1 - 0.5 * arm),
            f"{side}_arm_sweep": 18 + 30 * next(signed),
            f"{side}_elbow_flexion": 8 + 75 * next(unit) ** 1.5 + 25 * np.clip(forward, 0, 1),
            f"{side}_forearm_turn": 30 * next(signed),
        }
    return angles


def draw_poses(count: int, seed: int, kind: str) -> list[NamedPose]:
    """Poses of one kind, none of which makes an open body touch itself.

    ``train``: even numbers everyday poses, in turn from each family of `EVERYDAY`, odd numbers random draws
    (``pose.<number>``); none is within `APART` of a frame of a test motion. ``interpolation``: random draws of
    another sequence (``random.<number>``). ``test``: frames of the authored sequences, spread over each of them
    (``walk.<frame>``).

    The same seed gives the same poses, whatever was drawn before. Raises `AvatarError` for an unknown kind or a count
    that cannot be met.
    """
    if kind not in KINDS:
        raise unknown_name("kind", kind, KINDS)
    if count < 1:
        raise AvatarError(f"count: expected at least 1 pose, got {count}.")
    if kind == "test":
        return _authored_poses(count, seed)
    if kind == "interpolation":
        drawn = accepted_poses(lambda n: random_angles(n, [seed, 1000]), count)
        return [NamedPose(f"random.{i:05d}", pose) for i, pose in enumerate(drawn)]
    poses = [np.empty(0)] * count
    for place, name in enumerate(EVERYDAY):
        turns = slice(2 * place, None, 2 * len(EVERYDAY))
        poses[turns] = everyday_poses(name, len(poses[turns]), seed)
    poses[1::2] = accepted_poses(lambda n: random_angles(n, seed), count // 2)
    return [NamedPose(f"pose.{i:05d}", pose) for i, pose in enumerate(poses)]


def everyday_poses(name: str, count: int, seed: int) -> list[np.ndarray]:
    """The first ``count`` acceptable poses ``(22, 3)`` of a family of `EVERYDAY`."""
    return accepted_poses(lambda n: everyday_angles(name, n, seed), count)


def accepted_poses(angles: Callable[[int], Angles], count: int) -> list[np.ndarray]:
    """The first ``count`` draws that are clear of themselves and apart from the frames of all test motions."""
    tested = np.concatenate([authored_motion(name, seconds=period).poses for name, (period, _) in SEQUENCES.items()])
    drawn = 1 << int(np.ceil(np.log2(count * 1.5 + 8)))  # Sobol sequences are balanced at powers of two
    while drawn <= 64 * (count + 8):
        poses = pose_from_angles(angles(drawn), drawn)
        apart = cdist(poses.reshape(drawn, -1), tested.reshape(len(tested), -1)).min(axis=1) > APART
        kept: list[np.ndarray] = []
        for part in np.split(poses[apart], range(32, int(apart.sum()), 32)):
            if len(kept) < count:
                kept.extend(part[clear_of_itself(part)])
        if len(kept) >= count:
            return kept[:count]
        drawn *= 2
    raise AvatarError(f"count: expected poses that do not touch themselves, found too few for {count}.")


@torch.no_grad()
def split_distances(poses: dict[str, list[NamedPose]], shape: str = "female") -> list[str]:
    """Lines on how far each split's poses are from the nearest training pose, and how many have straight legs.

    A distance is the mean over an open body's vertices, its root turned alike; legs are straight where all knees are
    bent by less than `STRAIGHT` and all hips by less than `UPRIGHT`.

    Raises `AvatarError` without training poses.
    """
    if "train" not in poses:
        got = ", ".join(poses) or "no split"
        raise AvatarError(f"train: expected poses to measure from, got those of {got} alone.")
    body, lines = open_body(shape), []
    knees, hips = ([SMPL_JOINTS.index(f"{side}_{name}") for side in ("left", "right")] for name in ("knee", "hip"))
    for split, named in {"train": poses["train"], **poses}.items():
        angles = torch.from_numpy(np.stack([pose.pose for pose in named]).astype(np.float32))
        bent = torch.rad2deg(angles.norm(dim=-1))
        straight = (bent[:, knees] < STRAIGHT).all(dim=1) & (bent[:, hips] < UPRIGHT).all(dim=1)
        angles[:, 0] = 0
        posed = body(angles).vertices
        lines.append(f"{split}: {len(named)} poses, {int(straight.sum())} with straight legs")
        if split == "train":
            training = posed
        else:
            nearest = [(training - one).norm(dim=-1).mean(dim=-1).min() for one in posed]
            lines[-1] += f"; {100 * float(torch.stack(nearest).mean()):.1f} cm to the nearest training pose"
    return lines


def _authored_poses(count: int, seed: int) -> list[NamedPose]:
    """Frames of all sequences in turn, one from each equal stretch of one loop."""
    rng = np.random.default_rng(seed)
    drawn = []
    for place, (name, (period, _)) in enumerate(SEQUENCES.items()):
        poses = authored_motion(name, seconds=period).poses
        share = count // len(SEQUENCES) + (place < count % len(SEQUENCES))
        if share > len(poses):
            raise AvatarError(f"count: expected at most {len(poses)} frames of {name}, got {share}.")
        edges = np.arange(share + 1) * len(poses) // max(share, 1)
        frames = edges[:-1] + (rng.random(share) * np.diff(edges)).astype(int)
        drawn += [NamedPose(f"{name}.{frame:05d}", poses[frame]) for frame in frames]
    return drawn


@torch.no_grad()
def clear_of_itself(poses: np.ndarray, clearance: float = CLEARANCE) -> np.ndarray:
    """Which poses ``(T, 22, 3)`` keep hands, forearms and legs out of the rest of every open body: ``(T,)`` bool.

    Sampled vertices of forearms and hands are tested against head, trunk, legs and the other arm, and those of
    one leg from mid-thigh down against the other: closer than ``clearance`` metres, or inside, is touching.
    """
    clear = np.ones(len(poses), bool)
    for shape in open_body_shapes():
        body = open_body(shape)
        pairs = _touching_parts(body)
        posed = body(torch.from_numpy(np.ascontiguousarray(poses, np.float32))).vertices
        normals = vertex_normals(posed, body.faces)
        for frame in np.flatnonzero(clear):
            points, outward = posed[frame].numpy(), normals[frame].numpy()
            for mover, rest in pairs:
                distance, nearest = build_tree(points[rest]).query(points[mover])
                across = points[mover] - points[rest[nearest]]
                behind = (across * outward[rest[nearest]]).sum(axis=1) < 0
                clear[frame] &= not ((distance < clearance) | (behind & (distance < 0.15))).any()
    return clear


def _touching_parts(body: BodyModel) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs of vertex sets (mover, rest) that must not touch; every third vertex is near enough."""
    owner = np.array(SMPL_JOINTS)[body.weights.argmax(dim=1).numpy()]
    sampled = np.arange(len(owner)) % 3 == 0
    knees = body.template.joints[[SMPL_JOINTS.index("left_knee"), SMPL_JOINTS.index("left_hip")], 1].mean()
    below = body.template.vertices[:, 1].numpy() < float(knees)
    pairs, shins = [], []
    for side, _ in SIDES:
        hand, arm, leg = (
            np.isin(owner, [f"{side}_{joint}" for joint in joints])
            for joints in (("elbow", "wrist"), ("collar", "shoulder"), ("hip", "knee", "ankle", "foot"))
        )
        pairs.append((hand & sampled, ~hand & ~arm & sampled))
        shins.append(leg & below & sampled)
    return [(np.flatnonzero(mover), np.flatnonzero(rest)) for mover, rest in (*pairs, shins)]
