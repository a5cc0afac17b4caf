"""Mirrored frames: a symmetric body in symmetric clothes has twice as many poses to learn from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from avatar.checks import AvatarError
from avatar.geometry.neighbours import nearest
from avatar.records import Batch, Template

TOLERANCE = 0.005  # metres: nearly all vertices must have a mirror image this near
ACROSS = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))  # left and right are x


@dataclass(frozen=True)
class MirrorMap:
    """Which vertex, and which joint, is whose mirror image: ``vertices (V,)``, ``joints (J,)``."""

    vertices: Tensor
    joints: Tensor


def mirror_map(template: Template) -> MirrorMap:
    """The left-right symmetry of a template in a symmetric canonical pose.

    Raises `AvatarError` when more than 1% of the vertices have no mirror image within 5 mm, or joints have no partner.
    """
    mirrored = template.vertices * ACROSS.diagonal()[:3]
    ids = nearest(mirrored[None], template.vertices[None])[0]
    off = (template.vertices[ids] - mirrored).norm(dim=-1) > TOLERANCE
    if off.float().mean() > 0.01:
        raise AvatarError(
            f"mirror: expected a symmetric template, {int(off.sum())} of {len(off)} vertices have no mirror image "
            "within 5 mm. Train without mirroring (train.mirror=false)."
        )
    names = list(template.joint_names)
    swapped = [swap_side(name) for name in names]
    missing = [name for name in swapped if name not in names]
    if missing:
        raise AvatarError(f"mirror: expected joints in left and right pairs, there is no {missing[0]}.")
    return MirrorMap(ids, torch.tensor([names.index(name) for name in swapped]))


def swap_side(name: str) -> str:
    """``left_knee`` for ``right_knee`` and the other way round; a joint in the middle stays."""
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


def mirror_batch(batch: Batch, chosen: Tensor, symmetry: MirrorMap) -> Batch:
    """The batch with the chosen frames ``(B,)`` bool seen in a mirror: bodies, transforms and scans alike."""
    flip = ACROSS.diagonal()[:3]
    turned = torch.outer(ACROSS.diagonal(), ACROSS.diagonal())  # signs of ACROSS @ T @ ACROSS
    images = {
        "pose_vertices": lambda seen: seen[:, symmetry.vertices] * flip,
        "vertices": lambda seen: seen[:, symmetry.vertices] * flip,
        "vertex_transforms": lambda seen: seen[:, symmetry.vertices] * turned,
        "joint_transforms": lambda seen: seen[:, symmetry.joints] * turned,
        "scan_points": lambda seen: seen * flip,
        "scan_normals": lambda seen: seen * flip,
    }
    rows = chosen.nonzero()[:, 0]
    mirrored = {name: getattr(batch, name).clone() for name in images}
    for name, image in images.items():
        mirrored[name][rows] = image(mirrored[name][rows])
    return replace(batch, **mirrored)


def mirror_coins(seed: int, step: int, frames: int) -> Tensor:
    """Which frames of a step's batch are mirrored, ``(B,)`` bool: half of them, from the seed and the step alone."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
    return torch.rand(frames, generator=generator) < 0.5
