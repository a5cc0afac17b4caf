"""CloSET's network: its equations, its switches and its invariances, on a small body."""

from dataclasses import replace

import pytest
import torch
from spheres import TEMPLATE, random_batch, small_config
from subjects import BodyField, SmoothField, posed_batch, vertex_samples

from avatar.body.open import open_body
from avatar.checks import AvatarError
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.geometry.transforms import transform_directions, transform_points
from avatar.methods.closet import FREE_RATE, ClosetAvatar, ClosetConfig, PoseLocality, Skinning
from avatar.methods.registry import find_method
from avatar.nn.decoders import Decoded
from avatar.nn.encoders import PointNet2Config
from avatar.nn.hierarchy import HierarchyConfig
from avatar.nn.locality import LocalPoseConfig
from avatar.nn.posing import LearnedSkinning
from avatar.records import Batch

LOCAL = {"pose_locality": PoseLocality.kinematic, "local_encoder": LocalPoseConfig(widths=(8, 4))}


def template_points(count: int = 200):
    return sample_surface(TEMPLATE.vertices, TEMPLATE.faces, count, torch.Generator().manual_seed(0))


def avatar(**switches) -> ClosetAvatar:
    torch.manual_seed(0)
    return ClosetAvatar(TEMPLATE, 2, small_config(**switches)).eval()


def frames_of(batch: Batch, chosen: slice) -> Batch:
    tensors = {key: value for key, value in vars(batch).items() if isinstance(value, torch.Tensor)}
    return replace(batch, **{key: value[chosen] for key, value in tensors.items()}, names=batch.names[chosen])


def silence(model: ClosetAvatar) -> ClosetAvatar:
    """The model with decoders that say nothing."""
    for decoder in (model.garment_decoder, model.pose_decoder):
        for branch in (decoder.offset_branch, decoder.normal_branch):
            torch.nn.init.zeros_(branch[-1].weight)
            torch.nn.init.zeros_(branch[-1].bias)
    return model


def test_points_are_the_transformed_offset_on_the_posed_body():
    batch, samples = random_batch(), template_points()
    prediction = avatar()(batch, samples)
    bodies = interpolate(batch.vertices, samples)
    linear = batch.vertex_transforms[:, 0, :3, :3]  # one transform a frame in this batch
    expected = bodies + prediction.offsets @ linear.transpose(1, 2)
    torch.testing.assert_close(prediction.points, expected)
    torch.testing.assert_close(prediction.normals.norm(dim=-1), torch.ones(3, 200))


def test_offset_is_garment_plus_wrinkle_and_scaled():
    batch, samples = random_batch(), template_points()
    model = avatar()
    prediction = model(batch, samples)
    torch.testing.assert_close(prediction.offsets, prediction.garment_offsets + prediction.wrinkle_offsets)
    model.config.offset_scale *= 2
    torch.testing.assert_close(model(batch, samples).offsets, 2 * prediction.offsets)


def test_template_is_one_for_all_poses_and_differs_by_outfit():
    batch, samples = random_batch(), template_points()
    model = avatar()
    prediction = model(batch, samples)
    torch.testing.assert_close(prediction.garment_offsets[0], prediction.garment_offsets[2])
    assert (prediction.garment_offsets[0] - prediction.garment_offsets[1]).abs().max() > 0
    assert (prediction.wrinkle_offsets[0] - prediction.wrinkle_offsets[2]).abs().max() > 0
    template = model.garment_template(0, samples)
    resting = interpolate(TEMPLATE.vertices, samples)
    torch.testing.assert_close(template.points[0], resting + prediction.garment_offsets[0])


@pytest.mark.parametrize("rest_vertices", [True, False])
def test_each_frame_is_decoded_from_its_own_outfit_and_pose(rest_vertices):
    """CloSET eq. 3, frame by frame; outfits that are neither all there nor in their order, and codes that matter."""
    torch.manual_seed(0)
    model = ClosetAvatar(TEMPLATE, 3, small_config(code_std=1.0, rest_vertices=rest_vertices)).eval()
    batch, samples = replace(random_batch(), outfit_ids=torch.tensor([2, 1, 2])), template_points()
    prediction = model(batch, samples)
    scale, skin = model.config.offset_scale, vertex_normals(TEMPLATE.vertices, TEMPLATE.faces)
    for frame, outfit in enumerate(batch.outfit_ids):
        garment = model.garment_features(model.codes[None, outfit], samples)
        places = interpolate(TEMPLATE.vertices, samples)
        seen = [batch.pose_vertices[None, frame], *([TEMPLATE.vertices[None]] if rest_vertices else [])]
        pose = interpolate(model.pose_encoder(torch.cat(seen, dim=-1)), samples)
        template = model.garment_decoder(garment, places)
        wrinkles = model.pose_decoder(torch.cat([pose, garment], dim=-1), places)
        expected = {
            "garment_offsets": template.offsets * scale,
            "wrinkle_offsets": wrinkles.offsets * scale,
            "wrinkle_normals": wrinkles.normals,
        }
        for name, value in expected.items():
            torch.testing.assert_close(getattr(prediction, name)[frame], value[0], rtol=1e-4, atol=1e-6)
        added = interpolate(skin, samples) + template.normals[0] + wrinkles.normals[0]
        added = added @ batch.vertex_transforms[frame, 0, :3, :3].T
        torch.testing.assert_close(prediction.normals[frame], torch.nn.functional.normalize(added, dim=-1))
    torch.testing.assert_close(prediction.codes, model.codes[1:])  # each outfit of the batch once


def test_decoders_may_see_the_code_itself_and_vertices_have_offsets_of_their_own():
    torch.manual_seed(0)
    model = ClosetAvatar(TEMPLATE, 2, small_config(code_std=1.0, code_skip=True, free_offsets=True)).eval()
    batch, samples, channels = random_batch(), template_points(), model.config.code_channels
    features = model.garment_features(model.codes, samples)
    own = interpolate(model.codes[..., :channels], samples)
    torch.testing.assert_close(features[..., -channels:], own)
    assert (model.codes[..., channels:] == 0).all()
    before, rest = model(batch, samples), model.garment_template(1, samples)
    free = torch.randn(len(TEMPLATE.vertices), 3)
    model.codes.data[1, :, channels:] = free
    moved, added = model(batch, samples), interpolate(free, samples) * FREE_RATE * model.config.offset_scale
    for frame, outfit in enumerate(batch.outfit_ids):
        expected = added if outfit == 1 else torch.zeros_like(added)
        found = moved.garment_offsets[frame] - before.garment_offsets[frame]
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(
        model.garment_template(1, samples).offsets - rest.offsets, added[None], rtol=1e-4, atol=1e-6
    )
    with pytest.raises(AvatarError, match="free_offsets: they are part of the explicit template"):
        small_config(free_offsets=True, template=False)


def test_the_garment_template_is_the_prediction_at_rest_without_wrinkles():
    batch, samples = random_batch(), template_points()
    resting = TEMPLATE.vertices.expand(3, -1, -1)
    rest = replace(batch, vertices=resting, vertex_transforms=torch.eye(4).expand(3, len(TEMPLATE.vertices), 4, 4))
    model = avatar(code_std=1.0)
    expected = model(rest, samples, wrinkles=False)
    for frame, outfit in enumerate(batch.outfit_ids.tolist()):
        template = model.garment_template(outfit, samples)
        torch.testing.assert_close(template.points[0], expected.points[frame])
        torch.testing.assert_close(template.normals[0], expected.normals[frame])
    bare = silence(model).garment_template(0, samples).normals  # a correction of the body's own
    skin = torch.nn.functional.normalize(interpolate(TEMPLATE.vertices, samples), dim=-1)
    assert ((bare[0] * skin).sum(dim=-1) > 0.98).all()


def test_static_floor_ignores_the_pose_and_csf_has_no_template():
    batch, samples = random_batch(), template_points()
    static = avatar(pose=False)
    prediction = static(batch, samples)
    assert prediction.wrinkle_offsets is None
    torch.testing.assert_close(prediction.offsets[0], prediction.offsets[2])
    csf = avatar(template=False)
    prediction = csf(batch, samples)
    assert prediction.garment_offsets is None
    assert prediction.wrinkle_offsets is prediction.wrinkle_normals is None  # weights of wrinkles are not for the whole
    assert (prediction.offsets[0] - prediction.offsets[2]).abs().max() > 0
    with pytest.raises(AvatarError, match="without an explicit garment template"):
        csf.garment_template(0, samples)
    with pytest.raises(AvatarError, match="at least one branch"):
        small_config(template=False, pose=False)


def test_garment_branch_runs_once_an_outfit(monkeypatch):
    model, seen = avatar(), []
    forward = model.garment_encoder.forward
    monkeypatch.setattr(model.garment_encoder, "forward", lambda codes: seen.append(len(codes)) or forward(codes))
    model(random_batch(), template_points())
    assert seen == [2]


def test_point_count_is_free_and_points_are_independent():
    batch, many = random_batch(), template_points(400)
    model = avatar()
    few = type(many)(many.vertex_ids[::4], many.barycentric[::4], many.face_ids[::4])
    torch.testing.assert_close(model(batch, few).points, model(batch, many).points[:, ::4], rtol=1e-5, atol=1e-5)


def test_frames_do_not_see_each_other():
    batch, samples = random_batch(), template_points()
    model = avatar()
    alone = frames_of(batch, slice(1))
    torch.testing.assert_close(model(alone, samples).points, model(batch, samples).points[:1], rtol=1e-5, atol=1e-5)


def test_sizes_of_pop_are_the_defaults_and_fresh_codes_are_small():
    config = ClosetConfig()
    assert (config.offset_scale, config.code_std, config.code_channels, config.pose_noise) == (0.02, 0.01, 64, 0)
    assert float(avatar(code_std=0.3).codes.detach().std()) == pytest.approx(0.3, rel=0.1)


def test_pose_noise_acts_in_training_only(monkeypatch):
    batch, samples = random_batch(), template_points()
    quiet, noisy = avatar(), avatar(pose_noise=0.1)
    torch.testing.assert_close(noisy(batch, samples).points, quiet(batch, samples).points)
    torch.manual_seed(0)
    first = noisy.train()(batch, samples).points
    assert (first - noisy(batch, samples).points).abs().max() > 1e-6
    encode, seen = noisy.pose_encoder.forward, []
    monkeypatch.setattr(noisy.pose_encoder, "forward", lambda vertices: seen.append(vertices) or encode(vertices))
    noisy(batch, samples)
    assert float((seen[0][..., :3] - batch.pose_vertices).std()) == pytest.approx(0.1, rel=0.1)  # metres
    assert torch.equal(seen[0][..., 3:], TEMPLATE.vertices.expand_as(batch.pose_vertices))  # without noise


def test_every_parameter_gets_a_gradient():
    model = avatar().train()
    prediction = model(random_batch(), template_points())
    (prediction.points.square().sum() + prediction.normals[..., 0].sum()).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.isfinite().all()] == []


def test_registry_names_its_methods():
    with pytest.raises(AvatarError, match="closet"):
        find_method("clsoet")
    assert isinstance(find_method("closet").untrained(small_config(), TEMPLATE), ClosetAvatar)


def test_without_offsets_the_prediction_is_the_bare_body_with_its_normals():
    batch, samples = random_batch(), template_points()
    prediction = silence(avatar())(batch, samples)
    torch.testing.assert_close(prediction.points, interpolate(batch.vertices, samples))
    skin = interpolate(TEMPLATE.vertices, samples)  # a sphere's normals point as its points do
    expected = torch.nn.functional.normalize(skin @ batch.vertex_transforms[:, 0, :3, :3].transpose(1, 2), dim=-1)
    assert ((prediction.normals * expected).sum(dim=-1) > 0.98).all()


def dressed(body, fields, **switches) -> ClosetAvatar:
    """A small avatar on the open body, skinned by fields."""
    torch.manual_seed(0)
    model = ClosetAvatar(body.template, len(fields), small_config(skinning=Skinning.learned, **switches)).eval()
    model.skin_with(LearnedSkinning(fields, [body.template] * len(fields), model.config.train_field))
    return model


def test_with_the_bodys_own_field_and_no_offset_learned_skinning_is_the_bodys():
    body, samples = open_body("female"), vertex_samples(torch.arange(0, 12272, 17))
    batch = posed_batch([body], [0, 0])
    learned = silence(dressed(body, [BodyField(body.template)]))
    by_body = silence(ClosetAvatar(body.template, 1, small_config()).eval())
    expected, found = by_body(batch, samples), learned(batch, samples)
    torch.testing.assert_close(found.points, expected.points, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.normals, expected.normals, atol=1e-4, rtol=0)


def test_the_field_is_asked_at_the_offset_point_and_moves_points_and_normals():
    body, samples = open_body("female"), vertex_samples(torch.arange(0, 12272, 500))
    batch, fields = posed_batch([body], [0, 0]), [SmoothField(22), SmoothField(22)]
    batch = replace(batch, outfit_ids=torch.tensor([1, 0]))
    model = dressed(body, fields, offset_scale=0.5)
    prediction = model(batch, samples)
    resting = interpolate(body.template.vertices, samples) + prediction.offsets
    transforms = model.skinning(resting, batch.joint_transforms, batch.outfit_ids)
    torch.testing.assert_close(prediction.points, transform_points(transforms, resting))
    local = model(
        replace(batch, canonical=True, vertex_transforms=torch.eye(4).expand(2, 12272, 4, 4)), samples
    ).normals
    turned = torch.nn.functional.normalize(transform_directions(transforms, local), dim=-1)
    torch.testing.assert_close(prediction.normals, turned, atol=1e-5, rtol=0)
    skin = interpolate(body.template.vertices, samples).expand(2, -1, -1)
    elsewhere = model.skinning(skin, batch.joint_transforms, batch.outfit_ids)
    assert (transform_points(elsewhere, resting) - prediction.points).abs().max() > 1e-3


def test_learned_skinning_starts_from_each_subject_s_own_body_not_from_the_mean():
    """A network of several outfits is built on their mean body; what is posed is each subject's own."""
    bodies, samples = [open_body(shape) for shape in ("female", "male")], vertex_samples(torch.arange(0, 12272, 23))
    templates = [body.template for body in bodies]
    mean = replace(templates[0], vertices=(templates[0].vertices + templates[1].vertices) / 2)
    model = ClosetAvatar(mean, 2, small_config(skinning=Skinning.learned)).eval()
    model.skin_with(LearnedSkinning([BodyField(template) for template in templates], templates))
    batch = posed_batch(bodies, [1, 0, 1])
    found = silence(model)(batch, samples).points
    torch.testing.assert_close(found, interpolate(batch.vertices, samples), atol=1e-5, rtol=0)


@pytest.mark.parametrize("train_field", [True, False])
def test_learned_skinning_teaches_offsets_and_its_fields_when_asked(train_field):
    body, samples = open_body("female"), vertex_samples(torch.arange(0, 12272, 100))
    model = dressed(body, [SmoothField(22)], train_field=train_field).train()
    model(posed_batch([body], [0, 0]), samples).points.square().sum().backward()
    missing = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    silent = [name for name in missing if "normal_branch" not in name]
    assert silent == ([] if train_field else ["skinning.fields.0.layer.weight", "skinning.fields.0.layer.bias"])


def test_canonical_batches_are_left_at_rest():
    body, samples = open_body("female"), vertex_samples(torch.arange(0, 12272, 100))
    resting = body.template.vertices.expand(2, -1, -1)
    batch = replace(
        posed_batch([body], [0, 0]),
        vertices=resting,
        vertex_transforms=torch.eye(4).expand(2, 12272, 4, 4),
        canonical=True,
    )
    prediction = dressed(body, [SmoothField(22)])(batch, samples)
    torch.testing.assert_close(prediction.points, interpolate(resting, samples) + prediction.offsets)
    assert (prediction.wrinkle_offsets[0] - prediction.wrinkle_offsets[1]).abs().max() > 0  # still told the pose


@pytest.mark.parametrize("skinning", ["body", "learned"])
def test_half_precision_ends_before_posing(skinning):
    body, samples = open_body("female"), vertex_samples(torch.arange(0, 12272, 100))
    batch, scale = posed_batch([body], [0]), {"offset_scale": 5.0}  # offsets of decimetres, so that rounding shows
    torch.manual_seed(0)
    by_body = ClosetAvatar(body.template, 1, small_config(**scale, **LOCAL)).eval()
    model = by_body if skinning == "body" else dressed(body, [SmoothField(22)], **scale)
    with torch.autocast("cpu", torch.bfloat16):
        prediction = model(batch, samples)
    again = model.pose_points(Decoded(prediction.offsets, prediction.offsets), batch, samples)
    torch.testing.assert_close(prediction.points, again.points, atol=1e-6, rtol=0)


def test_a_turned_wrist_is_felt_at_the_foot_by_the_global_encoder_only():
    body = open_body("female")
    template, pose = body.template, torch.zeros(2, 22, 3)
    wrist, foot = (template.joint_names.index(name) for name in ("left_wrist", "right_foot"))
    pose[1, wrist] = torch.tensor([0.0, 0.5, 0.8])
    posed = body(pose)
    batch = replace(
        posed_batch([body], [0, 0]),
        pose_vertices=posed.vertices,
        vertices=posed.vertices,
        vertex_transforms=posed.vertex_transforms,
        joint_transforms=posed.joint_transforms,
    )
    samples = sample_surface(template.vertices, template.faces, 4000, torch.Generator().manual_seed(0))
    on_foot, on_hand = (interpolate(template.weights[:, [joint]], samples)[:, 0] > 0.5 for joint in (foot, wrist))
    reaching = PointNet2Config(HierarchyConfig((64, 4), (0.5, 3.0), 64), ((8,), (8,)), ((8,), (4,)))

    @torch.no_grad()
    def felt(where: torch.Tensor, **switches) -> tuple[float, float]:
        torch.manual_seed(0)
        model = ClosetAvatar(template, 1, replace(small_config(**switches), pose_encoder=reaching)).eval()
        prediction = model(batch, samples)
        moved = ((value[1] - value[0])[where] for value in (prediction.points, prediction.wrinkle_offsets))
        return tuple(float(change.abs().max()) for change in moved)

    assert felt(on_foot, **LOCAL) == (0.0, 0.0)  # to the bit
    assert felt(on_hand, **LOCAL)[1] > 1e-6
    assert felt(on_foot)[0] > 0


def test_kinematic_locality_needs_the_joints_alone():
    body, samples = open_body("female"), vertex_samples(torch.arange(0, 12272, 100))
    batch = posed_batch([body], [0])
    torch.manual_seed(0)
    model = ClosetAvatar(body.template, 1, small_config(**LOCAL)).eval()
    blind = replace(batch, pose_vertices=torch.zeros_like(batch.pose_vertices))
    torch.testing.assert_close(model(blind, samples).points, model(batch, samples).points, rtol=0, atol=0)
    with pytest.raises(AvatarError, match="two joints or more"):
        avatar(**LOCAL)  # the sphere has one


def test_switches_that_do_not_go_together_are_refused():
    with pytest.raises(AvatarError, match=r"pose_noise.*kinematic"):
        small_config(pose_noise=0.1, **LOCAL)
    with pytest.raises(AvatarError, match=r"train_field.*skinning=learned"):
        small_config(train_field=True)
    fields = LearnedSkinning([torch.nn.Identity()], [TEMPLATE])
    with pytest.raises(AvatarError, match="skinned by the body"):
        avatar().skin_with(fields)
    learned = avatar(skinning=Skinning.learned)
    with pytest.raises(AvatarError, match="one for each of 2 outfits, got 1"):
        learned.skin_with(fields)
    with pytest.raises(AvatarError, match=r"fields of a canonicalizer \(skin_with\)"):
        learned(random_batch(), template_points())
