"""The canonicalizer: the cycle it goes through, which gradients pass, and its two switches."""

from dataclasses import replace

import pytest
import torch
from limbs import JOINTS, arm_frame, arm_template, true_weights

from avatar.body.open import open_body
from avatar.body.skinning import skin_transforms
from avatar.canonical.canonicalizer import CODE_SPREAD, Canonicalizer, CanonicalizerConfig, Latent
from avatar.canonical.fields import SkinningFieldConfig
from avatar.canonical.scans import DrawConfig, draw_batch, prepare_scan
from avatar.checks import AvatarError
from avatar.geometry.transforms import transform_points

TEMPLATE = arm_template()
FORWARD, INVERSE = SkinningFieldConfig(width=16), SkinningFieldConfig(width=16, orders=8, latent=4)
FRAMES = [arm_frame(bend, 0.4) for bend in (0.0, 0.7, 1.4)]
SCANS = [prepare_scan(frame, TEMPLATE, 500) for frame in FRAMES]


def make(frames: int = 3, **switches) -> Canonicalizer:
    torch.manual_seed(0)
    return Canonicalizer(TEMPLATE, frames, CanonicalizerConfig(FORWARD, INVERSE, **switches))


def batch_of(*frames: int):
    draw = DrawConfig(scan=80, body=40, edges=30)
    return draw_batch(SCANS, frames, TEMPLATE.weights, draw, torch.Generator().manual_seed(0))


def test_true_weights_carry_the_sleeve_home_and_back(monkeypatch):
    model, batch = make(), batch_of(1, 2)
    homes = [torch.from_numpy(FRAMES[frame].scan.canonical) for frame in (1, 2)]
    chosen = [torch.cdist(batch.points[i], SCANS[f].points).argmin(1) for i, f in enumerate((1, 2))]
    # the points of a prepared scan are a permutation of the scan's: find their true home by posing all homes
    posed = [
        transform_points(skin_transforms(true_weights(h), SCANS[f].joint_transforms[None])[0], h)
        for h, f in zip(homes, (1, 2))
    ]
    homes = torch.stack(
        [h[torch.cdist(SCANS[f].points[c], p).argmin(1)] for h, f, c, p in zip(homes, (1, 2), chosen, posed)]
    )
    truth = torch.stack([true_weights(home) for home in homes])
    answer = torch.cat([truth, batch.body_weights, torch.zeros(2, 60, 3) + 1 / 3], dim=1)
    monkeypatch.setattr(model.inverse, "forward", lambda points, codes, boxes: answer)
    monkeypatch.setattr(model.separate, "forward", lambda points: true_weights(points[0])[None].expand(2, -1, -1))
    cycle = model(batch, model.batch_codes(batch), together=True)
    torch.testing.assert_close(cycle.canonical, homes, atol=2e-5, rtol=0)
    first = cycle.reposed[0] - batch.points[0]
    assert float(first.abs().max()) < 2e-5
    assert cycle.edge_weights.shape == (2, 30, 2, 3)


def test_points_go_there_by_the_inverse_field_and_back_by_the_forward_one():
    model, batch = make(), batch_of(0, 2)
    cycle = model(batch, model.batch_codes(batch), together=True)
    for weights, start, end in (
        (cycle.scan_weights, cycle.canonical, batch.points),
        (cycle.canonical_weights, cycle.canonical, cycle.reposed),
    ):
        moved = transform_points(skin_transforms(weights, batch.joint_transforms), start)
        torch.testing.assert_close(moved, end, atol=1e-5, rtol=0)
    torch.testing.assert_close(cycle.canonical_weights, model.canonical_weights(cycle.canonical))
    assert (cycle.canonical_weights - cycle.scan_weights).abs().max() > 1e-3


def test_apart_the_inverse_field_learns_nothing_from_the_forward_one_and_together_it_does():
    model, batch = make(), batch_of(0, 1)
    for together in (False, True):
        model.zero_grad()
        cycle = model(batch, model.batch_codes(batch), together)
        cycle.canonical_weights[..., 0].sum().backward()
        reached = model.inverse.head.weight.grad is not None and model.inverse.head.weight.grad.abs().sum() > 0
        assert bool(reached) == together
        assert (cycle.reposed is not None) == (cycle.edge_weights is not None) == together


def test_a_canonical_space_apart_from_the_bind_pose_is_skinned_through_it():
    """On the open body, bound in an A-pose, blending posed_from_canonical itself is millimetres off."""
    body = open_body("female")
    template = body.template
    assert template.canonical_from_bind is not None
    pose = torch.zeros(1, 22, 3)
    pose[0, 16, 2], pose[0, 1, 0] = -1.2, -0.8
    posed = body(pose)
    model = Canonicalizer(template, 1, CanonicalizerConfig(FORWARD, INVERSE))
    transforms = model.transforms(template.weights[None], posed.joint_transforms)
    torch.testing.assert_close(transform_points(transforms, template.vertices), posed.vertices, atol=1e-4, rtol=0)
    plain = transform_points(skin_transforms(template.weights[None], posed.joint_transforms), template.vertices)
    assert float((plain - posed.vertices).norm(dim=-1).max()) > 0.005


def test_codes_start_small_and_belong_to_their_frames():
    model = make(frames=2000)
    assert float(model.codes.std()) == pytest.approx(CODE_SPREAD, rel=0.05)
    model, batch = make(), batch_of(2, 0)
    codes = model.batch_codes(batch)
    assert torch.equal(codes, model.codes[[2, 0]])
    model(batch, codes, True).scan_weights[0].sum(dim=-1).sum().backward()
    assert float(model.codes.grad[1].abs().sum()) == 0


def test_pose_in_place_of_codes():
    model, batch = make(latent=Latent.pose), batch_of(0, 2)
    codes = model.batch_codes(batch)
    assert torch.equal(codes, torch.stack([SCANS[0].pose, SCANS[2].pose])) and codes.shape == (2, 6)
    cycle = model(batch, codes, True)
    assert cycle.codes is None  # E_Z has nothing to hold
    assert not torch.allclose(cycle.scan_weights, model(batch, codes.flip(0), True).scan_weights)


def test_one_shared_network_for_both_spaces():
    model, apart = make(shared=True), make()
    assert not hasattr(model, "separate")
    count = [sum(parameter.numel() for parameter in made.parameters()) for made in (model, apart)]
    assert count[0] < count[1]
    points = torch.rand(1, 50, 3)
    torch.testing.assert_close(model.forward_field(points), model.canonical_weights(points), atol=1e-6, rtol=1e-5)
    assert model.forward_field.config.latent == 0
    model(batch_of(0, 1), model.codes[:2], True).canonical_weights[..., 0].sum().backward()
    assert float(model.canonical_code.grad.abs().sum()) > 0


def test_any_number_of_joints_and_bodies():
    for joints in (1, 2):
        parents = tuple(range(-1, joints - 1))
        weights = torch.ones(len(TEMPLATE.vertices), joints) / joints
        names = tuple("ab"[:joints])
        template = replace(TEMPLATE, weights=weights, joints=JOINTS[:joints], parents=parents, joint_names=names)
        model = Canonicalizer(template, 1, CanonicalizerConfig(FORWARD, INVERSE))
        assert model.forward_field(torch.rand(1, 5, 3)).shape == (1, 5, joints)


def test_impossible_settings_are_refused():
    with pytest.raises(AvatarError, match=r"forward\.latent"):
        CanonicalizerConfig(forward=SkinningFieldConfig(latent=3))
    with pytest.raises(AvatarError, match=r"inverse\.latent"):
        CanonicalizerConfig(inverse=SkinningFieldConfig())
