"""What tests of learned skinning share: bodies posed at random as a batch, and fields that know the answer."""

import torch
from torch import Tensor, nn

from avatar.body.model import BodyModel
from avatar.geometry.neighbours import nearest
from avatar.records import Batch, SurfaceSamples, Template


class BodyField(nn.Module):
    """The weights of the nearest vertex of a body at rest."""

    def __init__(self, template: Template):
        super().__init__()
        self.template = template

    def forward(self, points: Tensor) -> Tensor:
        body = self.template.vertices.expand(len(points), -1, -1)
        return self.template.weights[nearest(points.detach(), body)]


class SmoothField(nn.Module):
    """Weights that change with every move of a point."""

    def __init__(self, joints: int):
        super().__init__()
        self.layer = nn.Linear(3, joints)

    def forward(self, points: Tensor) -> Tensor:
        return self.layer(5 * points).softmax(dim=-1)


def vertex_samples(ids: Tensor) -> SurfaceSamples:
    """Template points that stand on vertices."""
    corners = torch.tensor([1.0, 0.0, 0.0]).expand(len(ids), 3)
    return SurfaceSamples(ids[:, None].expand(-1, 3), corners, torch.zeros_like(ids))


def posed_batch(bodies: list[BodyModel], outfit_ids: list[int], seed: int = 0) -> Batch:
    """Frames of several subjects in random poses, turned and moved in the world."""
    draw = torch.Generator().manual_seed(seed)
    poses = 0.5 * torch.randn(len(outfit_ids), 1, 22, 3, generator=draw)
    moves = torch.randn(len(outfit_ids), 1, 3, generator=draw)
    posed = [bodies[outfit](pose, move) for outfit, pose, move in zip(outfit_ids, poses, moves)]
    vertices = torch.cat([body.vertices for body in posed])
    return Batch(
        pose_vertices=vertices,
        vertices=vertices,
        vertex_transforms=torch.cat([body.vertex_transforms for body in posed]),
        joint_transforms=torch.cat([body.joint_transforms for body in posed]),
        scan_points=vertices,
        scan_normals=vertices,
        outfit_ids=torch.tensor(outfit_ids),
        names=tuple(f"walk.{number:05d}" for number in range(len(outfit_ids))),
    )
