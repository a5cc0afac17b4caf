"""Points a step asks the field at, and what the field answers: against finite differences, with every loss at work."""

import pytest
import torch
from spheres import sphere_template

from avatar.canonical.fields import BodyField
from avatar.checks import AvatarError
from avatar.implicit.avatar import ImplicitAvatar, ImplicitConfig
from avatar.implicit.losses import (
    ImplicitLossConfig,
    QueryConfig,
    QueryPoints,
    implicit_loss,
    query_field,
    sample_queries,
)
from avatar.implicit.networks import MlpConfig, SdfConfig

TEMPLATE = sphere_template(2)  # a unit sphere skinned to one joint
BOX = torch.tensor([[-1.5, -1.4, -1.3], [1.5, 1.4, 1.3]])
POSE = torch.eye(4).expand(1, 1, 4, 4)
SMALL = SdfConfig(widths=(48, 48, 48), skip=1, orders=2)


def make_avatar(**switches):
    torch.manual_seed(0)
    config = ImplicitConfig(sdf=SMALL, texture=MlpConfig(widths=(16, 16), skip=1, orders=2), **switches)
    return ImplicitAvatar(TEMPLATE, BodyField(TEMPLATE), BOX, config)


def draw(seed=0, **counts):
    scan = torch.nn.functional.normalize(torch.randn(2, 50, 3, generator=torch.Generator().manual_seed(9)), dim=-1)
    config = QueryConfig(
        **({"near_points": 400, "box_points": 300, "boundary_points": 200, "near_distance": 0.1} | counts)
    )
    return scan, sample_queries(scan, 10 + TEMPLATE.vertices, BOX, config, torch.Generator().manual_seed(seed))


def test_points_lie_where_they_are_said_to():
    scan, space = draw()
    assert (
        space.near.shape == (2, 400, 3) and space.uniform.shape == (2, 300, 3) and space.boundary.shape == (2, 200, 3)
    )
    about_scan, about_body = space.near[:, :200], space.near[:, 200:] - 10
    assert (about_scan.norm(dim=-1) - 1).abs().mean() < 0.12
    assert (about_body.norm(dim=-1) - 1).abs().mean() < 0.12
    spread = torch.cdist(about_scan, scan).min(dim=-1).values.mean()
    assert 0.05 < spread < 0.2
    _, still = draw(near_distance=1e-9)  # the same draw unshaken
    shaken = (space.near - still.near) / 0.1
    assert shaken.mean().abs() < 0.1 and float(shaken.std()) == pytest.approx(1, abs=0.1)
    for points in (space.uniform, space.boundary):
        assert (points >= BOX[0]).all() and (points <= BOX[1]).all()
    assert (space.uniform.amax(dim=1) > 0.9 * BOX[1]).all() and (space.uniform.amin(dim=1) < 0.9 * BOX[0]).all()
    on_side = ((space.boundary == BOX[0]) | (space.boundary == BOX[1])).sum(dim=-1)
    assert (on_side == 1).all()
    for axis in range(3):
        for side in range(2):
            assert (space.boundary[..., axis] == BOX[side, axis]).any()


def test_the_same_state_draws_the_same_points_and_another_draws_others():
    one, two, other = draw(0)[1], draw(0)[1], draw(1)[1]
    assert torch.equal(one.near, two.near) and torch.equal(one.boundary, two.boundary)
    assert not torch.equal(one.uniform, other.uniform)


def test_gradients_are_those_of_the_whole_field():
    avatar = make_avatar().double()
    generator = torch.Generator().manual_seed(0)
    places = [torch.randn(1, count, 3, generator=generator, dtype=torch.float64) for count in (5, 4, 3, 2)]
    values = query_field(avatar, places[0], QueryPoints(*places[1:]), POSE.double())
    found = torch.cat([values.surface_gradients, values.space_gradients], dim=1)
    points, step = torch.cat(places[:3], dim=1), 1e-5
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        slope = (avatar(points + shift, POSE.double()) - avatar(points - shift, POSE.double())) / (2 * step)
        torch.testing.assert_close(found[..., axis], slope, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(values.boundary, avatar(places[3], POSE.double()))
    torch.testing.assert_close(values.uniform, avatar(places[2], POSE.double()))


def test_validation_leaves_no_graph_and_sees_the_same():
    avatar = make_avatar()
    scan, space = draw()
    pose = POSE.expand(2, 1, 4, 4)
    learning = query_field(avatar, scan, space, pose)
    with torch.no_grad():
        looking = query_field(avatar, scan, space, pose)
    assert learning.surface_gradients.requires_grad and not looking.surface_gradients.requires_grad
    assert not looking.surface.requires_grad
    torch.testing.assert_close(looking.space_gradients, learning.space_gradients.detach())


def learn(loss: ImplicitLossConfig, steps=90, **switches):
    """Learns half a sphere of radius 0.7, its scan pointing outwards and reddish."""
    avatar = make_avatar(**switches)
    optimiser = torch.optim.Adam([p for p in avatar.parameters() if p.requires_grad], lr=5e-3)
    generator = torch.Generator().manual_seed(0)
    config = QueryConfig(near_points=200, box_points=150, boundary_points=60, near_distance=0.15)
    for _ in range(steps):
        normals = torch.nn.functional.normalize(torch.randn(1, 200, 3, generator=generator), dim=-1)
        normals = torch.where(normals[..., 1:2] < -0.3, -normals, normals)
        scan = 0.7 * normals
        space = sample_queries(scan, 0.7 * TEMPLATE.vertices, BOX, config, generator)
        colors = torch.tensor([0.9, 0.2, 0.1]).expand_as(scan)
        terms = implicit_loss(query_field(avatar, scan, space, POSE), normals, loss, colors)
        optimiser.zero_grad()
        terms.total.backward()
        optimiser.step()
    return avatar


def errors(avatar) -> dict[str, float]:
    """How far the learned field is from the true one, in what each term is about."""
    generator = torch.Generator().manual_seed(5)
    normals = torch.nn.functional.normalize(torch.randn(1, 500, 3, generator=generator), dim=-1)
    normals[..., 1] = normals[..., 1].abs()
    space = sample_queries(0.7 * normals, TEMPLATE.vertices, BOX, QueryConfig(400, 0.2, 400, 200), generator)
    with torch.no_grad():
        values = query_field(avatar, 0.7 * normals, space, POSE)
        return {name: value.item() for name, value in implicit_loss(values, normals, ImplicitLossConfig()).raw.items()}


def test_a_partial_scan_becomes_the_whole_sphere():
    avatar = learn(ImplicitLossConfig(surface=5))
    below = torch.nn.functional.normalize(torch.tensor([[[0.1, -1.0, 0.2], [-0.3, -0.9, 0.1]]]), dim=-1)
    with torch.no_grad():  # never seen, and yet inside within and outside without
        assert (avatar(0.4 * below, POSE) < 0).all() and (avatar(1.1 * below, POSE) > 0).all()
    assert errors(avatar)["surface"] < 0.04


@pytest.mark.parametrize("dropped", ["surface", "normal", "eikonal"])
def test_a_field_learned_without_a_term_is_worse_in_it(dropped):
    weights = ImplicitLossConfig(surface=5)
    full = errors(learn(weights, 40))
    without = errors(learn(ImplicitLossConfig(**(vars(weights) | {dropped: 0.0})), 40))
    assert without[dropped] > 1.3 * full[dropped]


def test_colours_are_learned_and_leave_the_geometry_alone():
    colored = learn(ImplicitLossConfig(), 50, colored=True)
    points = torch.nn.functional.normalize(torch.randn(1, 50, 3), dim=-1) * 0.7
    with torch.no_grad():
        found = colored.colors(points, POSE)[0]
        assert (found - torch.tensor([0.9, 0.2, 0.1])).abs().max() < 0.1
        start = make_avatar(colored=True)
        assert (start.colors(points, POSE)[0] - found).abs().mean() > 0.2
    colored.zero_grad()
    colored.colors(points, POSE).sum().backward()
    assert all(p.grad is None or not p.grad.any() for p in colored.sdf.parameters())
    with pytest.raises(AvatarError, match="without texture"):
        make_avatar().colors(points, POSE)


def test_bad_counts_are_refused():
    with pytest.raises(AvatarError, match="near_points"):
        QueryConfig(near_points=0)
    with pytest.raises(AvatarError, match="near_distance"):
        QueryConfig(near_distance=0.0)
