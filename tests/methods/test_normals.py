"""What decoded normals start from: one option, the same in every method."""

import pytest
import torch
from cut_sphere import ATLASED
from spheres import DECODER, random_batch, small_config

from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.methods.pop import PopConfig
from avatar.methods.registry import METHODS, find_method
from avatar.methods.scale import ScaleConfig
from avatar.nn.decoders import Normals, ShapeDecoder
from avatar.nn.unet import UNetConfig

UV = {"map_size": 32, "pose_encoder": UNetConfig(3, 4, 6)}
POP = {"pose_decoder": DECODER, "garment_decoder": DECODER, "code_channels": 5}
CASES = {
    "closet": ("closet", lambda normals: small_config(normals=normals)),
    "csf": ("closet", lambda normals: small_config(normals=normals, template=False)),
    "static": ("closet", lambda normals: small_config(normals=normals, pose=False)),
    "pop": ("pop", lambda normals: PopConfig(**UV, **POP, normals=normals)),
    "pop_etd": ("pop", lambda normals: PopConfig(**UV, **POP, template=True, normals=normals)),
    "scale": ("scale", lambda normals: ScaleConfig(**UV, decoder=DECODER, normals=normals)),
}


def predict(case: str, normals: Normals, decoded: tuple[float, float, float]):
    """A network's prediction for one frame where all its decoders together give one local normal everywhere."""
    torch.manual_seed(0)
    name, settings = CASES[case]
    model = find_method(name).network(ATLASED, 1, settings(normals)).eval()
    decoders = [module for module in model.modules() if isinstance(module, ShapeDecoder)]
    for decoder in decoders:
        torch.nn.init.zeros_(decoder.normal_branch[-1].weight)
        decoder.normal_branch[-1].bias.data = torch.tensor(decoded) / len(decoders)
    batch = random_batch(1, (0,))
    generator = torch.Generator().manual_seed(0)
    own = model.template_samples(300) if name == "scale" else None
    samples = own or sample_surface(ATLASED.vertices, ATLASED.faces, 300, generator)
    return model, batch, samples, model(batch, samples)


POINT_METHODS = [name for name, method in METHODS.items() if method.on_body]


@pytest.mark.parametrize("name", POINT_METHODS)
def test_every_method_corrects_the_bodys_normals_unless_asked_not_to(name):
    assert METHODS[name].Settings().normals is Normals.body
    assert {case[0] for case in CASES.values()} == set(POINT_METHODS)


@pytest.mark.parametrize("case", CASES)
def test_decoders_that_give_nothing_leave_the_bodys_normals_or_none(case):
    _, batch, samples, prediction = predict(case, Normals.body, (0.0, 0.0, 0.0))
    linear = batch.vertex_transforms[:, 0, :3, :3]
    if case == "scale":  # a patch's normal is that of its triangle
        corners = batch.vertices[0, samples.vertex_ids]
        expected = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[None]
    else:
        skin = vertex_normals(ATLASED.vertices, ATLASED.faces)
        expected = interpolate(skin, samples) @ linear.transpose(1, 2)
    expected = torch.nn.functional.normalize(expected, dim=-1)
    torch.testing.assert_close(prediction.normals, expected, atol=1e-4, rtol=0)
    *_, prediction = predict(case, Normals.free, (0.0, 0.0, 0.0))
    assert not prediction.normals.any()


@pytest.mark.parametrize("case", ["closet", "csf", "static", "pop", "pop_etd"])
def test_what_decoders_give_is_added_to_the_bodys_normals_or_stands_alone(case):
    given = torch.tensor([0.3, 2.0, -0.5])
    for normals in Normals:
        _, batch, samples, prediction = predict(case, normals, tuple(given.tolist()))
        skin = interpolate(vertex_normals(ATLASED.vertices, ATLASED.faces), samples)
        local = given + skin if normals is Normals.body else given.expand_as(skin)
        linear = batch.vertex_transforms[0, 0, :3, :3]
        expected = torch.nn.functional.normalize(local @ linear.T, dim=-1)
        torch.testing.assert_close(prediction.normals[0], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("case", ["static", "pop_etd"])
def test_garment_template_has_the_same_start(case):
    given = (0.3, 2.0, -0.5)
    for normals in Normals:
        model, _, samples, _ = predict(case, normals, given)
        alone = torch.tensor(given) / (2 if case == "pop_etd" else 1)
        skin = interpolate(vertex_normals(ATLASED.vertices, ATLASED.faces), samples)
        local = alone + skin if normals is Normals.body else alone.expand_as(skin)
        found = model.garment_template(0, samples).normals[0]
        torch.testing.assert_close(found, torch.nn.functional.normalize(local, dim=-1), atol=1e-5, rtol=0)
