"""bfloat16 by autocast on the CPU: positions reach every network as float32, and features stay near float32's."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor, nn

from avatar.body.open import open_body
from avatar.canonical.fields import SkinningField, SkinningFieldConfig
from avatar.geometry.surface import interpolate, sample_surface
from avatar.implicit.networks import PosedSdf, SdfConfig
from avatar.methods.closet import ClosetAvatar, ClosetConfig, PoseLocality
from avatar.methods.pop import PopAvatar, PopConfig
from avatar.methods.scale import PointNetConfig, PoseFeature, ScaleAvatar, ScaleConfig
from avatar.nn.decoders import DecoderConfig
from avatar.nn.encoders import Encoder, PointNet2Config
from avatar.nn.hierarchy import HierarchyConfig
from avatar.nn.layers import PointNorm
from avatar.nn.locality import LocalPoseConfig
from avatar.nn.unet import UNetConfig
from avatar.records import Batch, SurfaceSamples

BODY = open_body()
TEMPLATE = BODY.template
ENCODER = PointNet2Config(HierarchyConfig((1024, 256), (0.06, 0.2), 16), ((16, 16), (32, 32)), ((32,), (16,)))
NEAREST = replace(ENCODER, hierarchy=replace(ENCODER.hierarchy, spread=False))  # groups reach a third as far
DECODER = DecoderConfig(width=32, trunk=2, branch=1)
UNET = UNetConfig(4, 8, 16)
SAMPLES = sample_surface(TEMPLATE.vertices, TEMPLATE.faces, 500, torch.Generator().manual_seed(0))


def posed_batch() -> Batch:
    """Two frames of the body: arms and legs bent at random."""
    generator = torch.Generator().manual_seed(0)
    poses = 0.4 * torch.randn(2, len(TEMPLATE.parents), 3, generator=generator)
    poses[:, 0] = 0
    posed = BODY(poses, torch.zeros(2, 3))
    return Batch(
        pose_vertices=posed.vertices,
        vertices=posed.vertices,
        vertex_transforms=posed.vertex_transforms,
        joint_transforms=posed.joint_transforms,
        scan_points=posed.vertices,
        scan_normals=posed.vertices,
        outfit_ids=torch.tensor([0, 0]),
        names=("a", "b"),
    )


BATCH = posed_batch()


def closet(sizes: PointNet2Config = ENCODER, **switches) -> ClosetAvatar:
    return ClosetAvatar(TEMPLATE, 1, ClosetConfig(sizes, sizes, DECODER, DECODER, 6, code_std=1.0, **switches))


def scale(feature: PoseFeature) -> ScaleAvatar:
    encoder = replace(UNET, affine=True)
    return ScaleAvatar(TEMPLATE, 1, ScaleConfig(encoder, PointNetConfig((16, 32), (16,)), DECODER, 32, 200, feature))


NETWORKS = {
    "pointnet2": closet,
    "pointmlp": lambda: closet(encoder=Encoder.pointmlp),
    "pointmlp_near": lambda: closet(NEAREST, encoder=Encoder.pointmlp, rest_vertices=False),
    "pointnext": lambda: closet(encoder=Encoder.pointnext),
    "kinematic": lambda: closet(
        pose_locality=PoseLocality.kinematic, local_encoder=LocalPoseConfig(widths=(32, 16), orders=4)
    ),
    "pop": lambda: PopAvatar(TEMPLATE, 1, PopConfig(UNET, DECODER, DECODER, 64, 6, code_std=1.0, template=True)),
    "scale": lambda: scale(PoseFeature.local),
    "scale_global": lambda: scale(PoseFeature.whole),
}


@cache
def network(name: str) -> nn.Module:
    torch.manual_seed(0)
    return NETWORKS[name]().train()


def first_norm_inputs(part: nn.Module, run, narrow: bool) -> Tensor:
    """What the first normalisation of a part of a network is given; all that comes before it is linear in positions."""
    seen = []
    norm = next(layer for layer in part.modules() if isinstance(layer, (PointNorm, nn.BatchNorm2d)))
    hook = norm.register_forward_hook(lambda layer, inputs, output: seen.append(inputs[0].detach().clone()))
    with torch.autocast("cpu", torch.bfloat16, enabled=narrow):
        run()
    hook.remove()
    return seen[0]


@pytest.mark.parametrize("name", NETWORKS)
def test_what_is_linear_in_the_posed_body_is_that_of_float32(name):
    """PointMLP alone has its layer on each neighbour in half precision, behind the difference: 0.4% at most."""
    model = network(name)
    wide, narrow = (
        first_norm_inputs(model.pose_encoder, lambda: model(BATCH, SAMPLES), half) for half in (False, True)
    )
    assert narrow.dtype is torch.float32
    if name.startswith("pointmlp"):
        assert (narrow - wide).norm() < 4e-3 * (wide - wide.mean(dim=(0, 1, 2))).norm()
    else:
        assert torch.equal(narrow, wide)


@pytest.mark.parametrize("name", ["pointnet2", "pop", "scale"])
def test_decoders_see_places_in_float32(name):
    model = network(name)
    decoder = getattr(model, "garment_decoder", None) or model.decoder
    places = interpolate(TEMPLATE.vertices, SAMPLES)
    places = nn.functional.pad(places, (0, 3 if name == "pointnet2" else 4))[:, : 3 if name == "pointnet2" else 4]
    channels = decoder.trunk[0].in_features - places.shape[1]
    nothing = torch.zeros(1, len(places), channels)
    with torch.no_grad():  # the trunk is half precision, and has no part in what the join sees
        decoder.join[0].weight[:, channels + places.shape[1] :] = 0
    for part in (decoder.trunk, decoder.join):
        wide, narrow = (first_norm_inputs(part, lambda: decoder(nothing, places), half) for half in (False, True))
        assert torch.equal(narrow, wide)
    with torch.autocast("cpu", torch.bfloat16):
        decoded = decoder(nothing, places)
    assert decoded.offsets.dtype is decoded.normals.dtype is torch.float32


@pytest.mark.parametrize(
    ("name", "bound"),
    [
        ("pointnet2", 0.018),
        ("pointmlp_near", 0.026),
        ("pointmlp", 0.033),
        ("pointnext", 0.018),
        ("kinematic", 0.0065),
        ("pop", 0.0095),
        ("scale", 0.011),
    ],
)
def test_pose_features_are_near_those_of_float32(name, bound):
    """Root mean square of the error, of features less their mean (which the next normalisation takes away)."""
    model, found = network(name), []
    model.pose_encoder.register_forward_hook(lambda layer, inputs, output: found.append(output.detach().float()))
    for half in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            model(BATCH, SAMPLES)
    wide, narrow = (value.flatten(2).transpose(1, 2) if value.ndim == 4 else value for value in found)
    assert (narrow - wide).norm() < bound * (wide - wide.mean(dim=(0, 1))).norm()


def test_fields_of_space_are_those_of_float32():
    torch.manual_seed(0)
    box = torch.stack([TEMPLATE.vertices.amin(dim=0), TEMPLATE.vertices.amax(dim=0)])
    points = TEMPLATE.vertices[None, :200]
    skinning, sdf = SkinningField(3, SkinningFieldConfig(width=16), box), PosedSdf(0, box, SdfConfig((16, 16, 16), 1))
    pose = points.new_zeros(1, 200, 0)
    with torch.no_grad():
        expected = skinning(points), sdf(points, pose)
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.equal(skinning(points), expected[0]) and torch.equal(sdf(points, pose), expected[1])


def test_samples_of_the_template_are_float32():
    with torch.autocast("cpu", torch.bfloat16):
        assert interpolate(TEMPLATE.vertices, SurfaceSamples(*vars(SAMPLES).values())).dtype is torch.float32
