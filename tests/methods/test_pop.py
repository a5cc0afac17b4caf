"""POP's network: its published sizes, its equations, its switches, and the seams that CloSET was made to avoid."""

from dataclasses import replace

import pytest
import torch
from cut_sphere import ATLASED, both_sides_of_a_seam
from spheres import DECODER, TEMPLATE, random_batch, small_config
from torch.nn.functional import grid_sample

from avatar.body.open import open_body
from avatar.checks import AvatarError
from avatar.geometry.surface import interpolate, sample_surface
from avatar.methods.closet import ClosetAvatar
from avatar.methods.pop import PointSource, PopAvatar, PopConfig
from avatar.methods.registry import find_method
from avatar.nn.atlas import Atlas, LookUp
from avatar.nn.unet import UNetConfig
from avatar.records import SurfaceSamples


def parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def template_points(count: int = 200) -> SurfaceSamples:
    return sample_surface(ATLASED.vertices, ATLASED.faces, count, torch.Generator().manual_seed(0))


def avatar(**switches) -> PopAvatar:
    torch.manual_seed(0)
    config = PopConfig(UNetConfig(3, 4, 6), DECODER, DECODER, map_size=32, code_channels=5, code_std=0.5, **switches)
    return PopAvatar(ATLASED, 2, config).eval()


def test_full_network_has_the_published_sizes():
    model = PopAvatar(open_body().template, 1, PopConfig())
    assert parameters(model.pose_encoder) == 10_348_192
    assert parameters(model.garment_encoder) == 307_200
    assert parameters(model.pose_decoder) == 600_326
    assert parameters(model) - model.codes.numel() == 11_255_718
    assert model.codes.shape == (1, 64, 128, 128)
    assert float(model.codes.detach().std()) == pytest.approx(0.01, rel=0.01)
    assert PopConfig().offset_scale == 0.02


def test_points_are_the_transformed_offset_on_the_posed_body():
    batch, samples = random_batch(), template_points()
    model = avatar()
    prediction = model(batch, samples)
    linear = batch.vertex_transforms[:, 0, :3, :3]  # one transform a frame in this batch
    expected = interpolate(batch.vertices, samples) + prediction.offsets @ linear.transpose(1, 2)
    torch.testing.assert_close(prediction.points, expected)
    torch.testing.assert_close(prediction.normals.norm(dim=-1), torch.ones(3, 200))
    model.config.offset_scale *= 2
    torch.testing.assert_close(model(batch, samples).offsets, 2 * prediction.offsets)


@pytest.mark.parametrize("template", [False, True])
def test_without_offsets_the_points_are_the_posed_body(template):
    batch, samples = random_batch(), template_points()
    model = avatar(template=template)
    for decoder in (model.pose_decoder, *([model.garment_decoder] if template else [])):
        for value in decoder.offset_branch[-1].parameters():
            torch.nn.init.zeros_(value)
    torch.testing.assert_close(model(batch, samples).points, interpolate(batch.vertices, samples))


def test_decoder_is_asked_with_features_place_and_zeros():
    """Pose and garment features of a pixel, its UV coordinates, and POP's two zeros, in this order."""
    batch = random_batch()
    model = avatar()
    pixel = 137
    grid = model.atlas.grid
    sample = SurfaceSamples(*(value[pixel : pixel + 1] for value in vars(grid.samples).values()))
    row, column = divmod(int(grid.pixels[pixel]), 32)
    pose = model.pose_encoder(model.atlas.position_map(batch.pose_vertices))[:, :, row, column]
    garment = model.garment_encoder(model.codes)[batch.outfit_ids][:, :, row, column]
    place = torch.tensor([[(column + 0.5) / 32, (row + 0.5) / 32, 0, 0]])
    decoded = model.pose_decoder(torch.cat([pose, garment], dim=1)[:, None], place)
    torch.testing.assert_close(model(batch, sample).offsets, decoded.offsets * 0.02, rtol=1e-4, atol=1e-6)


def test_position_map_has_the_body_under_its_pixels():
    atlas = Atlas(ATLASED, 32)
    image = atlas.position_map(ATLASED.vertices[None])
    spots = interpolate(ATLASED.vertices, atlas.grid.samples)
    for pixel, spot in zip(atlas.grid.pixels.tolist()[::50], spots[::50]):
        torch.testing.assert_close(image[0, :, pixel // 32, pixel % 32], spot)
    assert float(image.abs().sum(dim=1).flatten().count_nonzero()) == len(spots)
    u, v = (torch.tensor([pixel % 32, pixel // 32]) + 0.5).float() / 32
    assert spots[::50][-1, 0] == pytest.approx(float((u - (0.25 if u < 0.5 else 0.75)) / 0.24), abs=1e-4)
    assert spots[::50][-1, 1] == pytest.approx(float((v - 0.5) / 0.24), abs=1e-4)


def test_look_up_is_bilinear_between_pixel_centres():
    torch.manual_seed(0)
    image, uv = torch.randn(2, 3, 8, 8), torch.rand(40, 2) * 0.8 + 0.1
    slow = torch.zeros(2, 40, 3)
    for i, (x, y) in enumerate((uv * 8 - 0.5).tolist()):
        for column in (int(x), int(x) + 1):
            for row in (int(y), int(y) + 1):
                slow[:, i] += (1 - abs(x - column)) * (1 - abs(y - row)) * image[:, :, row, column]
    torch.testing.assert_close(LookUp(uv, 8)(image), slow, rtol=1e-4, atol=1e-5)
    half = torch.arange(256.0).expand(1, 1, 256, -1).bfloat16()  # whole numbers up to 256 are exact in it
    between = LookUp(torch.tensor([[0.7013, 0.5]]), 256)(half)
    torch.testing.assert_close(between.item(), 0.7013 * 256 - 0.5)
    corner = LookUp(torch.zeros(1, 2), 8)(image)  # beyond the outermost centres the image goes on as it ends
    torch.testing.assert_close(corner[:, 0], image[:, :, 0, 0])


def test_look_up_and_its_gradient_are_those_of_grid_sample():
    torch.manual_seed(0)
    image, uv = torch.randn(2, 3, 8, 8, dtype=torch.float64, requires_grad=True), torch.rand(200, 2).double()
    where = (2 * uv - 1).expand(2, 1, -1, -1)
    slow = grid_sample(image, where, padding_mode="border", align_corners=False)[:, :, 0].transpose(1, 2)
    fast = LookUp(uv, 8)(image)
    torch.testing.assert_close(fast, slow)
    gradient = torch.randn_like(slow)
    for mine, theirs in zip(*(torch.autograd.grad(found, image, gradient) for found in (fast, slow))):
        torch.testing.assert_close(mine, theirs)


def test_points_of_other_samples_are_looked_up_anew():
    atlas = Atlas(ATLASED, 8)
    draws = (torch.Generator().manual_seed(seed) for seed in (0, 1))
    first, second = (sample_surface(ATLASED.vertices, ATLASED.faces, 9, draw) for draw in draws)
    image = torch.rand(1, 2, 8, 8)
    expected = [LookUp(atlas.place(samples), 8)(image) for samples in (first, second)]
    assert atlas.look_up_at(first) is atlas.look_up_at(replace(first))
    for samples, features in zip((first, second, first), (*expected, expected[0])):
        assert torch.equal(atlas.look_up_at(samples)(image), features)


def test_features_jump_at_seams_where_closet_goes_on():
    """One surface point, asked for from both sides of a cut: POP gives two answers, CloSET one."""
    batch, samples = random_batch(), both_sides_of_a_seam()
    torch.manual_seed(0)
    surface = ClosetAvatar(TEMPLATE, 2, small_config()).eval()(batch, samples).points
    torch.testing.assert_close(surface[:, 0], surface[:, 1])
    torch.testing.assert_close(*interpolate(batch.vertices, samples).unbind(dim=1))
    plane = avatar()(batch, samples).points
    assert (plane[:, 0] - plane[:, 1]).norm(dim=-1).min() > 1e-4


def test_points_are_the_pixels_of_a_grid_or_the_callers():
    model = avatar()
    samples = model.template_samples(1000)
    assert abs(len(samples.face_ids) - 1000) < 30
    pixels = (model.atlas.place(samples) * round((1000 / 0.36) ** 0.5)).frac()
    torch.testing.assert_close(pixels, torch.full_like(pixels, 0.5), rtol=0, atol=1e-3)
    assert torch.equal(model.template_samples(1000).barycentric, samples.barycentric)
    assert len(model.template_samples(300).face_ids) < 330
    assert avatar(points=PointSource.surface).template_samples(1000) is None


def test_point_count_is_free_and_points_are_independent():
    batch, many = random_batch(), template_points(400)
    model = avatar()
    few = SurfaceSamples(many.vertex_ids[::4], many.barycentric[::4], many.face_ids[::4])
    torch.testing.assert_close(model(batch, few).points, model(batch, many).points[:, ::4], rtol=1e-5, atol=1e-5)


def test_frames_do_not_see_each_other_and_pose_and_outfit_matter():
    batch, samples = random_batch(), template_points()
    model = avatar()
    tensors = {key: value[:1] for key, value in vars(batch).items() if isinstance(value, torch.Tensor)}
    together = model(batch, samples)
    torch.testing.assert_close(
        model(replace(batch, **tensors), samples).points, together.points[:1], rtol=1e-5, atol=1e-5
    )
    assert (together.offsets[0] - together.offsets[2]).abs().max() > 0  # one outfit, two poses
    away = model(replace(batch, vertices=batch.vertices + 1), samples)  # the place in the world is not the pose
    torch.testing.assert_close(away.offsets, together.offsets)
    swapped = replace(batch, outfit_ids=1 - batch.outfit_ids)
    others = model(swapped, samples)
    assert ((others.offsets - together.offsets).abs().amax(dim=(1, 2)) > 0).all()
    second = model(replace(batch, outfit_ids=torch.ones_like(batch.outfit_ids)), samples)
    assert torch.equal(second.codes, model.codes[1:])
    torch.testing.assert_close(second.offsets[::2], others.offsets[::2], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("template", [False, True])
def test_each_frame_is_decoded_from_its_own_outfit_and_pose(template):
    """CloSET eq. 3 frame by frame; outfits that are neither all there nor in their order."""
    torch.manual_seed(0)
    config = replace(avatar().config, code_std=1.0, template=template)
    model = PopAvatar(ATLASED, 3, config).eval()
    batch, samples = replace(random_batch(), outfit_ids=torch.tensor([2, 1, 2])), template_points()
    prediction, look_up = model(batch, samples), model.atlas.look_up_at(samples)
    for frame, outfit in enumerate(batch.outfit_ids):
        garment = model.garment_features(model.codes[None, outfit], samples)
        pose = look_up(model.pose_encoder(model.atlas.position_map(batch.pose_vertices[None, frame])))
        decoded = model.pose_decoder(torch.cat([pose, garment], dim=-1), model.places(samples))
        offsets = decoded.offsets[0] * config.offset_scale
        if template:
            torch.testing.assert_close(prediction.wrinkle_offsets[frame], offsets, rtol=1e-4, atol=1e-6)
            torch.testing.assert_close(prediction.wrinkle_normals[frame], decoded.normals[0], rtol=1e-4, atol=1e-5)
            offsets = offsets + model.garment_decoder(garment, model.places(samples)).offsets[0] * config.offset_scale
        torch.testing.assert_close(prediction.offsets[frame], offsets, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(prediction.codes, model.codes[1:])  # each outfit of the batch once


def test_the_garment_template_is_the_prediction_at_rest_without_wrinkles():
    batch, samples = random_batch(), template_points()
    resting = ATLASED.vertices.expand(3, -1, -1)
    rest = replace(batch, vertices=resting, vertex_transforms=torch.eye(4).expand(3, resting.shape[1], 4, 4))
    model = avatar(template=True)
    expected = model(rest, samples, wrinkles=False)
    for frame, outfit in enumerate(batch.outfit_ids.tolist()):
        template = model.garment_template(outfit, samples)
        torch.testing.assert_close(template.points[0], expected.points[frame])
        torch.testing.assert_close(template.normals[0], expected.normals[frame])


def test_garment_map_is_smoothed_without_a_nonlinearity():
    model = avatar()
    a, b = torch.randn(2, 1, 5, 32, 32)
    torch.testing.assert_close(
        model.garment_encoder(a + 2 * b), model.garment_encoder(a) + 2 * model.garment_encoder(b), rtol=1e-4, atol=1e-5
    )


def test_explicit_template_is_one_for_all_poses():
    batch, samples = random_batch(), template_points()
    model = avatar(template=True)
    prediction = model(batch, samples)
    torch.testing.assert_close(prediction.offsets, prediction.garment_offsets + prediction.wrinkle_offsets)
    torch.testing.assert_close(prediction.garment_offsets[0], prediction.garment_offsets[2])
    assert (prediction.garment_offsets[0] - prediction.garment_offsets[1]).abs().max() > 0
    alone = model(batch, samples, wrinkles=False)
    torch.testing.assert_close(alone.offsets, prediction.garment_offsets)
    assert alone.wrinkle_offsets is None and alone.wrinkle_normals is None
    plain = avatar()(batch, samples)
    assert plain.wrinkle_offsets is plain.wrinkle_normals is None  # weights of wrinkles are not for the whole offset
    turned = interpolate(batch.vertex_transforms[..., :3, :3].flatten(-2), samples).unflatten(-1, (3, 3))
    added = (turned.inverse() @ prediction.normals[..., None])[..., 0]
    garment = (turned.inverse() @ alone.normals[..., None])[..., 0]
    spanned = torch.stack([added, garment, prediction.wrinkle_normals], dim=-1)  # both with the body's in them
    assert torch.linalg.det(spanned).abs().max() < 1e-5  # n is garment's plus what the pose adds, up to length
    template = model.garment_template(1, samples)
    resting = interpolate(ATLASED.vertices, samples)
    torch.testing.assert_close(template.points[0], resting + prediction.garment_offsets[1])
    plain = avatar()
    assert plain(batch, samples).garment_offsets is None
    for refused in (lambda: plain(batch, samples, wrinkles=False), lambda: plain.garment_template(0, samples)):
        with pytest.raises(AvatarError, match="without"):
            refused()


@pytest.mark.parametrize("template", [False, True])
def test_every_parameter_gets_a_gradient(template):
    model = avatar(template=template).train()
    prediction = model(random_batch(), model.template_samples(300))
    (prediction.points.square().sum() + prediction.normals[..., 0].sum()).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.isfinite().all()] == []
    assert [name for name, p in model.named_parameters() if not p.grad.any() and "norm" not in name] == []


def test_bodies_without_atlas_and_bad_sizes_are_refused():
    with pytest.raises(AvatarError, match="UV coordinates"):
        find_method("pop").network(TEMPLATE, 1, PopConfig())
    with pytest.raises(AvatarError, match="multiple of 128"):
        PopConfig(map_size=64)
    for wrong in ({"code_channels": 0}, {"smoothing": -1}, {"offset_scale": 0}, {"code_std": -1}):
        with pytest.raises(AvatarError, match=next(iter(wrong))):
            PopConfig(**wrong)
    with pytest.raises(AvatarError, match="pose_vertices"):
        avatar()(replace(random_batch(), pose_vertices=torch.zeros(3, 5, 3)), template_points())
