"""The surface encoders behind one switch: the same template, the same levels, the same call."""

from __future__ import annotations

from enum import Enum

from torch import nn

from avatar.nn.pointmlp import PointMLP
from avatar.nn.pointnet2 import PointNet2, PointNet2Config
from avatar.nn.pointnext import PointNeXt
from avatar.records import Template


class Encoder(Enum):
    """What makes features on the body's surface out of features on its vertices (CloSET, table 5)."""

    pointnet2 = "pointnet2"
    pointmlp = "pointmlp"
    pointnext = "pointnext"


ENCODERS = {Encoder.pointnet2: PointNet2, Encoder.pointmlp: PointMLP, Encoder.pointnext: PointNeXt}


def build_encoder(kind: Encoder, template: Template, channels: int, config: PointNet2Config) -> nn.Module:
    """A fresh encoder: ``(B, V, channels)`` on the template's vertices to ``(B, V, encoder.out_channels)``.

    Args:
        kind: which one.
        template: its vertices are the point cloud, fixed for good.
        channels: input features a vertex.
        config: levels and channels; ``conf/encoder/`` has lists for each kind of about as many parameters.
    """
    return ENCODERS[kind](template, channels, config)
