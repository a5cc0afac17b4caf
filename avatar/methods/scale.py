"""SCALE (Surface Codec of Articulated Local Elements, CVPR 2021): the dressed body as small patches of points."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize, pad

from avatar.checks import AvatarError, check_range, check_shape
from avatar.geometry.neighbours import nearest
from avatar.geometry.sparse import SparseRows, gather_sum
from avatar.geometry.surface import farthest_points, interpolate
from avatar.geometry.transforms import transform_directions
from avatar.geometry.uv import uv_barycentric
from avatar.methods.points import PointMethod
from avatar.nn.atlas import Atlas
from avatar.nn.decoders import DecoderConfig, Normals, ShapeDecoder
from avatar.nn.layers import WideLinear, point_mlp
from avatar.nn.unet import UNet, UNetConfig
from avatar.records import Batch, Prediction, SurfaceSamples, Template

PLACE_CHANNELS = 4  # UV coordinates of the patch, and a point's own in the patch


class PoseFeature(Enum):
    """What a patch sees of the pose."""

    local = "local"  # its pixel of the feature map
    whole = "global"  # one vector for the whole body: the variant in CloSET's table 4


@dataclass
class PointNetConfig:
    """Channels of the PointNet behind the global variant; the defaults are the classification network's."""

    points: tuple[int, ...] = (64, 64, 64, 128, 1024)  # shared by all points, before the maximum
    body: tuple[int, ...] = (512, 256)  # after it

    def __post_init__(self):
        self.points, self.body = tuple(self.points), tuple(self.body)
        if not self.points or min(self.points + self.body) < 1:
            raise AvatarError(f"points, body: expected positive channel counts, got {self.points}, {self.body}.")


@dataclass
class ScaleConfig:
    """SCALE's switches and sizes; the defaults are the paper's."""

    pose_encoder: UNetConfig = field(default_factory=lambda: UNetConfig(levels=5, affine=True))
    global_encoder: PointNetConfig = field(default_factory=PointNetConfig)  # with pose_feature=global only
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    map_size: int = 32  # pixels a side of the position map; each pixel in the atlas can be a patch
    patches: int = 798  # at most; all pixels of the atlas where there are fewer
    pose_feature: PoseFeature = PoseFeature.local
    normals: Normals = Normals.body  # of a patch's triangle, which the decoder corrects; free as in the paper

    def __post_init__(self):
        check_range(self, "patches", low=1)
        self.pose_encoder.check_map_size(self.map_size)


class PointNet(nn.Module):
    """One feature vector for a whole point cloud: a shared network, the maximum over points, a network behind it."""

    def __init__(self, out_channels: int, config: PointNetConfig):
        super().__init__()
        self.points = point_mlp((3, *config.points), WideLinear)
        sizes = pairwise((config.points[-1], *config.body, out_channels))
        layers = [layer for size in sizes for layer in (nn.Linear(*size), nn.ReLU())]
        self.body = nn.Sequential(*layers[:-1])  # no normalisation: a batch of one body has nothing to normalise over

    def forward(self, points: Tensor) -> Tensor:
        """``(B, N, 3)`` to ``(B, C)``."""
        return self.body(self.points(points).amax(dim=1))


class ScaleAvatar(nn.Module):
    """The SCALE network of one outfit: patches fixed to triangles of the posed body.

    A patch has the feature of a pixel of the position map, its place on the body and its triangle's frame; points of it
    differ by their cell of the pixel alone. A point in no patch's pixel belongs to the patch nearest in the atlas.
    """

    def __init__(self, template: Template, outfits: int, config: ScaleConfig):
        """Builds the network on a body with UV coordinates; `AvatarError` for several outfits, which have no codes."""
        super().__init__()
        if outfits != 1:
            raise AvatarError(f"outfit: SCALE models one outfit, got {outfits}; train a run for each.")
        self.config, self.vertex_count, size = config, len(template.vertices), config.map_size
        self.atlas = Atlas(template, size)
        places, pixels = interpolate(template.vertices, self.atlas.grid.samples), self.atlas.map_pixels
        chosen = farthest_points(places, min(config.patches, len(places))).sort().values
        corners = torch.stack([pixels[chosen] % size, pixels[chosen] // size], dim=-1)
        rows, columns = torch.meshgrid(*[torch.arange(size)] * 2, indexing="ij")
        places = torch.stack([columns, rows, torch.zeros_like(rows)], dim=-1).flatten(0, 1).float()
        owner = nearest(places[None], pad(corners, (0, 1))[None].float().cpu())[0]
        for name, value in {"patch_rows": chosen, "patch_corners": corners, "patch_of_pixel": owner}.items():
            self.register_buffer(name, value.clone(), persistent=False)
        channels = config.pose_encoder.out_channels
        if config.pose_feature is PoseFeature.local:
            self.pose_encoder = UNet(3, config.pose_encoder)
        else:
            self.pose_encoder = PointNet(channels, config.global_encoder)
        self.decoder = ShapeDecoder(channels + PLACE_CHANNELS, config.decoder)

    @property
    def patches(self) -> SurfaceSamples:
        """The patches' places on the body."""
        atlas, rows = self.atlas, self.patch_rows
        return SurfaceSamples(atlas.map_vertex_ids[rows], atlas.map_barycentric[rows], atlas.map_face_ids[rows])

    def template_samples(self, points: int) -> SurfaceSamples:
        """About ``points`` places where this network predicts: k x k cells of every patch's pixel.

        A cell off the patch's triangle lies in the plane of it, so its barycentric coordinates may be negative.
        """
        patches = self.patches
        side = max(1, round(math.sqrt(points / len(self.patch_rows))))
        steps = (torch.arange(side, device=self.patch_corners.device, dtype=torch.float64) + 0.5) / side
        cells = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).flatten(0, 1)
        uv = (self.patch_corners[:, None] + cells).flatten(0, 1) / self.config.map_size
        face_ids = patches.face_ids.repeat_interleave(side**2)
        barycentric = uv_barycentric(uv, self.atlas.uv[self.atlas.uv_faces[face_ids]].double())
        vertex_ids = patches.vertex_ids.repeat_interleave(side**2, dim=0)
        return SurfaceSamples(vertex_ids, barycentric.to(patches.barycentric.dtype), face_ids)

    def pose_features(self, pose_vertices: Tensor) -> Tensor:
        """Pose features of the patches: ``(B, V, 3)`` posed body to ``(B, P, C)``."""
        if self.config.pose_feature is PoseFeature.local:
            features = self.pose_encoder(self.atlas.position_map(pose_vertices)).flatten(2).transpose(1, 2)
            return gather_sum(
                features, SparseRows.of_table(self.atlas.map_pixels[self.patch_rows, None], features.shape[1])
            )
        centres = interpolate(pose_vertices, self.patches)
        return self.pose_encoder(centres)[:, None].expand(-1, centres.shape[1], -1)

    def patch_frames(self, vertices: Tensor) -> Tensor:
        """Frames ``(B, P, 3, 3)`` of posed triangles, axes as columns: two edges, a normal as long as their mean."""
        first, second, third = (vertices[:, ids] for ids in self.patches.vertex_ids.unbind(dim=1))
        edges = torch.stack([second - first, third - first], dim=-1)
        length = edges.norm(dim=-2).mean(dim=(1, 2))[:, None, None]
        normals = normalize(torch.linalg.cross(edges[..., 0], edges[..., 1], dim=-1), dim=-1, eps=1e-20)
        return torch.cat([edges, (normals * length).unsqueeze(-1)], dim=-1)

    def forward(self, batch: Batch, samples: SurfaceSamples) -> Prediction:
        """Predicts the dressed surface of each frame at N points: those of `template_samples` or any on the body.

        ``x = T r + p``, p a patch's place on the posed body and T its triangle's frame. The ``offsets`` of the result
        are ``T r``: r counts in edges of a triangle, which the regulariser could not compare.
        """
        check_shape("pose_vertices", batch.pose_vertices, "B V 3", V=self.vertex_count)
        size = self.config.map_size
        spots = self.atlas.place(samples) * size
        pixels = spots.floor().long().clamp(0, size - 1)
        patch = self.patch_of_pixel[pixels[:, 1] * size + pixels[:, 0]]
        corners = self.patch_corners[patch]
        places = torch.cat([(corners + 0.5) / size, spots - corners], dim=-1)
        features = self.pose_features(batch.pose_vertices)
        features = gather_sum(features, SparseRows.of_table(patch[:, None], features.shape[1]))
        local = self.decoder(features, places)
        with torch.autocast(local.offsets.device.type, enabled=False):  # half precision is millimetres here
            frames = self.patch_frames(batch.vertices)[:, patch]
            offsets = transform_directions(frames, local.offsets.float())
            normals = local.normals.float()
            if self.config.normals is Normals.body:
                normals = normals + normals.new_tensor([0.0, 0.0, 1.0])  # the third axis of a frame is the normal
            return Prediction(
                points=interpolate(batch.vertices, self.patches)[:, patch] + offsets,
                normals=normalize(transform_directions(frames, normals), dim=-1),
                offsets=offsets,
            )


class Scale(PointMethod):
    """SCALE, of one outfit."""

    name = "scale"
    Settings = ScaleConfig
    network = ScaleAvatar
