"""The smallest bodies that bend: an arm in a sleeve, legs in a skirt; where their cloth truly belongs is known."""

import numpy as np
import torch
from torch import Tensor

from avatar.body.skinning import chain_transforms, skin_transforms
from avatar.geometry.transforms import transform_points
from avatar.records import BodyFit, Frame, Scan, Template

PARENTS = (-1, 0, 1)
JOINTS = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.9, 0.0]])
RADIUS, SLEEVE = 0.08, 0.12  # metres
RINGS, SEGMENTS = 40, 24


def true_weights(points: Tensor) -> Tensor:
    """Weights ``(N, 3)`` of canonical points: they change along the tube alone, over a few centimetres."""
    steps = torch.sigmoid((points[:, 1:2] - JOINTS[1:, 1]) / 0.03)
    return torch.stack([1 - steps[:, 0], steps[:, 0] - steps[:, 1], steps[:, 1]], dim=-1).clamp(min=0)


def tube(radius: float, low: float = -0.1, high: float = 1.1) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices, unit normals and faces of an open upright tube."""
    heights, turns = torch.linspace(low, high, RINGS), torch.arange(SEGMENTS) * (2 * torch.pi / SEGMENTS)
    around = torch.stack([turns.cos(), torch.zeros_like(turns), turns.sin()], dim=-1)
    up = torch.tensor([0.0, 1.0, 0.0])
    vertices = (radius * around + heights[:, None, None] * up).reshape(-1, 3)
    corner = torch.arange(SEGMENTS)
    square = torch.stack([corner, corner + SEGMENTS, (corner + 1) % SEGMENTS, (corner + 1) % SEGMENTS + SEGMENTS], -1)
    faces = torch.cat([square[:, [0, 1, 2]], square[:, [2, 1, 3]]])
    faces = torch.cat([faces + ring * SEGMENTS for ring in range(RINGS - 1)])
    return vertices, around.repeat(RINGS, 1), faces


def arm_template(canonical_from_bind: Tensor | None = None) -> Template:
    vertices, _, faces = tube(RADIUS)
    weights = true_weights(vertices)
    return Template(vertices, faces, weights, JOINTS, PARENTS, ("root", "elbow", "wrist"), canonical_from_bind)


def arm_frame(elbow: float, wrist: float = 0.0, mesh: bool = False, seed: int = 0, split: str = "train") -> Frame:
    """A sleeve bent about x at elbow and wrist (radians), the whole turned and moved; 2,000 points or a mesh."""
    pose = torch.tensor([[0.3, 1.1, -0.4], [elbow, 0.0, 0.0], [wrist, 0.0, 0.0]])
    canonical, normals, faces = tube(SLEEVE, 0.0, 1.0)
    if not mesh:
        generator = torch.Generator().manual_seed(seed)
        turn, height = torch.rand(2, 2000, generator=generator)
        normals = torch.stack([(6.2832 * turn).cos(), torch.zeros(2000), (6.2832 * turn).sin()], dim=-1)
        canonical = SLEEVE * normals + height[:, None] * torch.tensor([0.0, 1.0, 0.0])
    transforms = chain_transforms(pose[None], JOINTS, PARENTS)
    name = f"bend.{round(100 * elbow):05d}"
    weights = true_weights(canonical)
    return dressed_frame(name, split, arm_template(), transforms, canonical, normals, weights, faces if mesh else None)


def legs_template() -> Template:
    """Two upright tubes, each all of one hip's."""
    vertices, _, faces = tube(0.06, -0.9, -0.02)
    aside, none, one = torch.tensor([0.12, 0.0, 0.0]), torch.zeros(len(vertices)), torch.ones(len(vertices))
    weights = torch.cat([torch.stack([none, one, none], dim=-1), torch.stack([none, none, one], dim=-1)])
    joints = torch.stack([0 * aside, aside, -aside])
    both = torch.cat([vertices + aside, vertices - aside])
    faces = torch.cat([faces, faces + len(vertices)])
    return Template(both, faces, weights, joints, (-1, 0, 0), ("root", "left", "right"))


def skirt_frame(left: tuple[float, float], right: tuple[float, float], seed: int = 0) -> Frame:
    """A skirt round both legs, whose weights go softly from one to the other where those of the nearest leg jump.

    ``left`` and ``right`` turn the hips about x (forwards) and z (aside), radians.
    """
    turn, height = torch.rand(2, 2000, generator=torch.Generator().manual_seed(seed))
    angle = 6.2832 * turn
    canonical = torch.stack([0.26 * angle.cos(), -0.1 - 0.7 * height, 0.16 * angle.sin()], dim=-1)
    normals = torch.stack([angle.cos() / 0.26, torch.zeros(2000), angle.sin() / 0.16], dim=-1)
    share = torch.sigmoid(canonical[:, :1] / 0.06)
    template = legs_template()
    pose = torch.tensor([[0.3, 1.1, -0.4], [left[0], 0.0, left[1]], [right[0], 0.0, right[1]]])
    transforms = chain_transforms(pose[None], template.joints, template.parents)
    weights = torch.cat([torch.zeros_like(share), share, 1 - share], dim=-1)
    return dressed_frame("step.00000", "train", template, transforms, canonical, normals, weights)


def dressed_frame(
    name: str,
    split: str,
    template: Template,
    transforms: Tensor,
    canonical: Tensor,
    normals: Tensor,
    weights: Tensor,
    faces: Tensor | None = None,
) -> Frame:
    """A frame of cloth that follows its body by skinning alone, moved away from the origin."""
    transforms[..., :3, 3] += torch.tensor([0.5, -0.2, 2.0])
    body, cloth = skin_transforms(template.weights, transforms)[0], skin_transforms(weights, transforms)[0]
    turned = torch.linalg.inv(cloth[:, :3, :3]).transpose(-1, -2) @ normals[..., None]
    vertices = transform_points(body, template.vertices).numpy()
    fit = BodyFit(vertices, body.numpy(), transforms[0].numpy(), vertices, np.zeros(3, np.float32))
    scan = Scan(
        points=transform_points(cloth, canonical).numpy(),
        normals=torch.nn.functional.normalize(turned[..., 0], dim=-1).numpy(),
        faces=None if faces is None else faces.numpy(),
        canonical=canonical.numpy(),
    )
    return Frame(name, "limb", split, fit, scan)
