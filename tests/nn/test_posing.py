"""Learned skinning: the body's own where the field is the body's, each subject's own, differentiable in the points."""

from dataclasses import replace

import pytest
import torch
from subjects import BodyField, SmoothField, posed_batch, vertex_samples

from avatar.body.open import open_body
from avatar.body.registry import canonical_pose
from avatar.checks import AvatarError
from avatar.geometry.transforms import transform_points
from avatar.nn.posing import LearnedSkinning

IDS = torch.arange(0, 12272, 23)


def posed(skinning: LearnedSkinning, points: torch.Tensor, batch) -> torch.Tensor:
    return transform_points(skinning(points, batch.joint_transforms, batch.outfit_ids), points)


@pytest.mark.parametrize("canonical", ["t", "apart"])
def test_the_bodys_weights_give_the_posed_body_of_each_subject(canonical):
    names = open_body("female").joint_names
    bodies = [open_body(shape).with_canonical_pose(canonical_pose(canonical, names)) for shape in ("female", "male")]
    templates = [body.template for body in bodies]
    skinning = LearnedSkinning([BodyField(template) for template in templates], templates)
    batch = posed_batch(bodies, [1, 0, 1])
    skin = skinning.skin(batch.outfit_ids, vertex_samples(IDS))
    torch.testing.assert_close(skin[1], templates[0].vertices[IDS])
    torch.testing.assert_close(posed(skinning, skin, batch), batch.vertices[:, IDS], atol=1e-5, rtol=0)
    swapped = replace(batch, outfit_ids=torch.tensor([0, 1, 0]))  # the other's bind pose and field are not its own
    assert (posed(skinning, skin, swapped) - batch.vertices[:, IDS]).norm(dim=-1).max() > 1e-3


def test_a_body_bound_at_rest_is_skinned_plainly():
    body = open_body("female")
    template = replace(body.template, canonical_from_bind=None)
    field, batch = SmoothField(22), posed_batch([body], [0, 0])
    points = body.template.vertices[IDS].expand(2, -1, -1)
    blended = torch.einsum("bnj,bjrc->bnrc", field(points), batch.joint_transforms)
    torch.testing.assert_close(
        posed(LearnedSkinning([field], [template]), points, batch), transform_points(blended, points)
    )


def test_gradients_go_through_the_weights():
    body = open_body("female").double()
    torch.manual_seed(0)
    skinning = LearnedSkinning([SmoothField(22).double()], [body.template])
    draw = torch.Generator().manual_seed(0)
    pose = 0.5 * torch.randn(2, 22, 3, generator=draw, dtype=torch.float64)
    transforms, ids = body(pose).joint_transforms, torch.zeros(2, dtype=torch.long)
    points = torch.randn(2, 3, 3, generator=draw, dtype=torch.float64, requires_grad=True)

    def carried(points: torch.Tensor) -> torch.Tensor:
        return transform_points(skinning(points, transforms, ids), points)

    assert torch.autograd.gradcheck(carried, points)
    (whole,) = torch.autograd.grad(carried(points).sum(), points)
    fixed = skinning(points, transforms, ids).detach()
    (rigid,) = torch.autograd.grad(transform_points(fixed, points).sum(), points)
    assert (whole - rigid).abs().max() > 0.1  # what moving through the field adds


@pytest.mark.parametrize("trainable", [True, False])
def test_fields_are_frozen_unless_asked(trainable):
    body = open_body("female")
    skinning = LearnedSkinning([SmoothField(22), SmoothField(22)], [body.template] * 2, trainable)
    batch = posed_batch([body, body], [0, 1])
    points = body.template.vertices[IDS].repeat(2, 1, 1).requires_grad_()
    posed(skinning, points, batch).sum().backward()
    assert all((p.grad is not None and bool(p.grad.any())) == trainable for p in skinning.parameters())
    assert bool(points.grad.any())


def test_its_bodies_are_saved_with_its_fields():
    bodies = [open_body("female"), open_body("male")]
    whole = LearnedSkinning([SmoothField(22), SmoothField(22)], [body.template for body in bodies])
    again = LearnedSkinning([SmoothField(22), SmoothField(22)], [bodies[0].template] * 2)
    again.load_state_dict(whole.state_dict())
    batch = posed_batch(bodies, [0, 1])
    skin = again.skin(batch.outfit_ids, vertex_samples(IDS))
    torch.testing.assert_close(posed(again, skin, batch), posed(whole, skin, batch), rtol=0, atol=0)
    torch.testing.assert_close(skin[1], bodies[1].template.vertices[IDS])


def test_one_field_an_outfit_is_expected():
    template = open_body("female").template
    with pytest.raises(AvatarError, match="expected one for each of 2 outfits, got 1"):
        LearnedSkinning([SmoothField(22)], [template] * 2)
    with pytest.raises(AvatarError, match="of 0 outfits"):
        LearnedSkinning([], [])
