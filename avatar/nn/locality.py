"""Local pose conditioning (SCANimate 3.2): features of a place and of the joints near it in the kinematic tree."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from avatar.body.skinning import tree_distances
from avatar.checks import AvatarError, check_range
from avatar.geometry.precision import full_precision
from avatar.geometry.surface import interpolate
from avatar.geometry.transforms import fourier_features, relative_quaternions
from avatar.nn.layers import PointNorm, point_mlp
from avatar.records import SurfaceSamples, Template


@dataclass
class LocalPoseConfig:
    """Reach and size of a local pose encoder; the defaults cost about what the full global one does."""

    rings: int = 4  # steps in the kinematic tree that a joint's motion reaches (the paper's); 11 is everywhere
    widths: tuple[int, ...] = (512, 512, 512, 64)  # channels of its layers; the last ones are the features
    orders: int = 6  # Fourier orders of the position on the template

    def __post_init__(self):
        self.widths = tuple(self.widths)
        check_range(self, "rings", "orders", low=0)
        if not self.widths or min(self.widths) < 1:
            raise AvatarError(f"widths: expected one or more positive numbers of channels, got {self.widths}.")


def pose_gates(template: Template, rings: int) -> Tensor:
    """How much each vertex sees of each joint but the root, ``(V, J - 1)`` in [0, 1]: SCANimate's W w (eq. 18).

    1 where all the joints that move the vertex are within ``rings`` steps of the joint, 0 where none is.
    """
    near = tree_distances(template.parents)[:, 1:] <= rings
    return template.weights @ near.to(template.weights)


def relative_rotations(joint_transforms: Tensor, parents: tuple[int, ...]) -> Tensor:
    """`relative_quaternions` less that of rest, (x, y, z, w - 1), so that the canonical pose is all zeros."""
    quaternions = relative_quaternions(joint_transforms, parents)
    return quaternions - quaternions.new_tensor([0.0, 0.0, 0.0, 1.0])


class LocalPoseEncoder(nn.Module):
    """Pose features of points on the template: a network on (W w) o theta and the position (SCANimate eq. 18).

    The first layer is linear in the gated rotations, so each joint goes through it once a frame and is gated
    afterwards: sum_j W_j (g_j theta_j) = sum_j g_j (W_j theta_j), exactly.
    """

    def __init__(self, template: Template, config: LocalPoseConfig):
        """Builds the encoder for one template; needs two joints or more."""
        super().__init__()
        if len(template.parents) < 2:
            raise AvatarError("template: expected two joints or more for local pose conditioning, got one.")
        self.parents, self.orders, self.out_channels = template.parents, config.orders, config.widths[-1]
        self.register_buffer("gates", pose_gates(template, config.rings), persistent=False)
        self.register_buffer("vertices", template.vertices.clone(), persistent=False)
        self.pose_layer = nn.Linear(4 * (len(template.parents) - 1), config.widths[0])
        self.position_layer = nn.Linear(3 + 6 * config.orders, config.widths[0], bias=False)
        self.first = nn.Sequential(PointNorm(config.widths[0]), nn.ReLU())
        self.rest = point_mlp(config.widths)

    def forward(self, joint_transforms: Tensor, samples: SurfaceSamples) -> Tensor:
        """``(B, J, 4, 4)`` posed_from_canonical to features ``(B, N, C)`` of N points on the template."""
        return self.rest(self.first(self.lift(joint_transforms, samples)))

    @full_precision
    def lift(self, joint_transforms: Tensor, samples: SurfaceSamples) -> Tensor:
        """The first layer, before its normalisation: ``(B, N, C)``, in float32 for the sake of the positions."""
        rotations = relative_rotations(joint_transforms, self.parents)
        columns = self.pose_layer.weight.unflatten(1, rotations.shape[1:])
        joints = torch.einsum("bjq,cjq->bjc", rotations, columns)
        places = self.position_layer(fourier_features(interpolate(self.vertices, samples), self.orders, math.pi))
        return interpolate(self.gates, samples) @ joints + places + self.pose_layer.bias
