"""Every loss term against its equation, and its switches."""

import pytest
import torch

from avatar.checks import AvatarError
from avatar.methods.losses import TERMS, Chamfer, LossConfig, point_avatar_loss
from avatar.records import Batch, Prediction


def plane(count: int, height: float, generator: torch.Generator) -> torch.Tensor:
    points = torch.rand(1, count, 3, generator=generator, dtype=torch.float64)
    points[..., 1] = height
    return points


def make(prediction_points, prediction_normals, scan_points, scan_normals, **extra):
    zeros = torch.zeros_like(prediction_points)
    prediction = Prediction(prediction_points, prediction_normals, **({"offsets": zeros} | extra))
    nothing = torch.zeros(1, 1, 3)
    frames = len(scan_points)
    batch = Batch(
        nothing, nothing, nothing, nothing, scan_points, scan_normals, torch.zeros(frames).long(), ("a.0",) * frames
    )
    return prediction, batch


def up(points):
    return torch.tensor([0.0, 1, 0], dtype=points.dtype).expand_as(points)


def test_chamfer_between_parallel_planes_is_twice_the_squared_distance():
    generator = torch.Generator().manual_seed(0)
    scan = plane(300, 0.0, generator)
    points = scan + torch.tensor([0, 0.1, 0], dtype=torch.float64)
    prediction, batch = make(points, up(points), scan, up(scan))
    raw = point_avatar_loss(prediction, batch, LossConfig(), 1.0).raw
    assert raw["scan_to_points"].item() == pytest.approx(0.01)
    assert raw["points_to_scan"].item() == pytest.approx(0.01)
    assert raw["normal"].item() == pytest.approx(0.0)


def test_plane_distance_forgives_sliding_and_point_distance_does_not():
    generator = torch.Generator().manual_seed(0)
    scan = plane(50, 0.0, generator)
    points = scan + torch.tensor([0.003, 0.01, 0], dtype=torch.float64)
    prediction, batch = make(points, up(points), scan, up(scan))
    plane_loss = point_avatar_loss(prediction, batch, LossConfig(chamfer=Chamfer.plane), 1.0).raw["points_to_scan"]
    point_loss = point_avatar_loss(prediction, batch, LossConfig(), 1.0).raw["points_to_scan"]
    assert plane_loss.item() == pytest.approx(1e-4)
    assert point_loss > plane_loss


def test_normal_term_is_a_third_of_the_l1_difference_and_starts_late():
    scan = torch.rand(1, 20, 3, dtype=torch.float64)
    sideways = torch.tensor([1.0, 0, 0], dtype=torch.float64).expand_as(scan)
    prediction, batch = make(scan.clone(), sideways, scan, up(scan))
    config = LossConfig(normal=0.5, normal_start=0.6)
    late = point_avatar_loss(prediction, batch, config, 0.6)
    assert late.raw["normal"].item() == pytest.approx(2 / 3)
    assert late.weighted["normal"].item() == pytest.approx(0.5 * 2 / 3)
    early = point_avatar_loss(prediction, batch, config, 0.59)
    assert early.raw["normal"] == late.raw["normal"] and "normal" not in early.weighted


def test_regularisers_are_mean_squares_with_their_weights():
    scan = torch.rand(2, 20, 3)
    offsets = torch.full_like(scan, 0.1)
    wrinkles = torch.full_like(scan, 0.2)
    codes = torch.full((1, 5, 4), 0.3)
    extra = {"offsets": offsets, "wrinkle_offsets": wrinkles, "wrinkle_normals": 2 * wrinkles, "codes": codes}
    prediction, batch = make(scan.clone(), up(scan), scan, up(scan), **extra)
    terms = point_avatar_loss(prediction, batch, LossConfig(offset=10, wrinkle=100, wrinkle_normal=3, code=2), 1.0)
    assert terms.weighted["offset"].item() == pytest.approx(10 * 0.03, rel=1e-5)
    assert terms.weighted["wrinkle"].item() == pytest.approx(100 * 0.12, rel=1e-5)
    assert terms.weighted["wrinkle_normal"].item() == pytest.approx(3 * 0.48, rel=1e-5)
    assert terms.weighted["code"].item() == pytest.approx(2 * 0.09, rel=1e-5)
    torch.testing.assert_close(terms.total, sum(terms.weighted.values()))


def test_every_term_pulls_at_what_it_measures():
    """Each alone has a gradient, and to its own input only; both Chamfer halves reach the points."""
    inputs = ("points", "normals", "offsets", "wrinkle_offsets", "wrinkle_normals", "codes")
    targets, scan = dict(zip(TERMS, ("points", *inputs))), torch.rand(2, 20, 3)
    for term, chamfer in [*((term, Chamfer.point) for term in TERMS), ("points_to_scan", Chamfer.plane)]:
        values = {name: torch.rand(2, 20, 3, requires_grad=True) for name in inputs}
        points, normals, *_ = values.values()
        others = {name: values[name] for name in inputs[2:]}
        prediction, batch = make(points, normals, scan, up(scan), **others)
        config = LossConfig(chamfer, **(dict.fromkeys(TERMS, 0.0) | {term: 1.0}))
        point_avatar_loss(prediction, batch, config, 1.0).total.backward()
        reached = {name for name, value in values.items() if value.grad is not None and value.grad.any()}
        assert reached == {targets[term]}, term


def test_each_frame_is_compared_with_its_own_scan():
    torch.manual_seed(0)
    unit = torch.nn.functional.normalize
    points, scan = torch.randn(3, 30, 3), torch.randn(3, 40, 3)
    normals, scan_normals = unit(torch.randn(3, 30, 3), dim=-1), unit(torch.randn(3, 40, 3), dim=-1)
    for chamfer in Chamfer:
        whole, *single = (
            point_avatar_loss(*make(points[rows], normals[rows], scan[rows], scan_normals[rows]), config, 1.0).raw
            for config in [LossConfig(chamfer)]
            for rows in (slice(3), slice(1), slice(1, 2), slice(2, 3))
        )
        for name, value in whole.items():
            torch.testing.assert_close(value, sum(frame[name] for frame in single) / 3)


def test_weights_of_pop_are_the_defaults():
    config = LossConfig()
    assert [getattr(config, term) for term in TERMS] == [1e4, 1e4, 1, 2e3, 0, 0, 1]
    assert config.normal_start == 0.6 and config.chamfer is Chamfer.point


def test_loss_pulls_points_onto_the_scan():
    torch.manual_seed(0)
    scan = torch.nn.functional.normalize(torch.randn(1, 400, 3), dim=-1)
    points = torch.nn.Parameter(scan[:, :200] * 1.3)
    optimiser = torch.optim.Adam([points], lr=0.01)
    for _ in range(80):
        prediction, batch = make(points, torch.nn.functional.normalize(points, dim=-1), scan, scan)
        optimiser.zero_grad()
        point_avatar_loss(prediction, batch, LossConfig(), 1.0).total.backward()
        optimiser.step()
    assert (points.norm(dim=-1) - 1).abs().max() < 0.05


def test_bad_weights_are_refused_by_name():
    with pytest.raises(AvatarError, match="offset"):
        LossConfig(offset=-1)
    with pytest.raises(AvatarError, match="normal_start"):
        LossConfig(normal_start=1.5)
