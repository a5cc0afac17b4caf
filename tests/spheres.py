"""A sphere as the smallest body, a small CloSET on it and random batches, for tests of networks and training."""

import torch
import trimesh

from avatar.methods.closet import ClosetConfig
from avatar.nn.decoders import DecoderConfig
from avatar.nn.encoders import PointNet2Config
from avatar.nn.hierarchy import HierarchyConfig
from avatar.records import Batch, Template


def sphere_template(subdivisions: int = 2) -> Template:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = torch.from_numpy(sphere.vertices).float()
    return Template(
        vertices=vertices,
        faces=torch.from_numpy(sphere.faces).long(),
        weights=torch.ones(len(vertices), 1),
        joints=torch.zeros(1, 3),
        parents=(-1,),
        joint_names=("root",),
    )


TEMPLATE = sphere_template()
ENCODER = PointNet2Config(HierarchyConfig((40, 10), (0.5, 1.5), 6), ((8,), (8,)), ((8,), (4,)))
DECODER = DecoderConfig(width=16, trunk=1, branch=0)


def small_config(**switches) -> ClosetConfig:
    return ClosetConfig(ENCODER, ENCODER, DECODER, DECODER, code_channels=6, **switches)


def random_batch(frames: int = 3, outfits: tuple[int, ...] = (0, 1, 0)) -> Batch:
    draw = torch.Generator().manual_seed(1)
    count = len(TEMPLATE.vertices)
    transforms = torch.eye(4).repeat(frames, count, 1, 1)
    transforms[..., :3, :3] += 0.1 * torch.randn(frames, 1, 3, 3, generator=draw)
    transforms[..., :3, 3] = torch.randn(frames, 1, 3, generator=draw)
    vertices = (transforms[..., :3, :3] @ TEMPLATE.vertices[:, :, None])[..., 0] + transforms[..., :3, 3]
    scans = torch.randn(frames, 50, 3, generator=draw)
    return Batch(
        pose_vertices=vertices,
        vertices=vertices,
        vertex_transforms=transforms,
        joint_transforms=transforms[:, :1],
        scan_points=scans,
        scan_normals=scans,
        outfit_ids=torch.tensor(outfits[:frames]),
        names=tuple(f"walk.{i:05d}" for i in range(frames)),
    )
