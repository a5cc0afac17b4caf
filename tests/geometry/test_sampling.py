"""Farthest-point sampling against its loop and on degenerate clouds."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import farthest_loop

from avatar.checks import AvatarError
from avatar.geometry.surface import farthest_points


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 40), st.integers(0, 1000))
def test_agrees_with_loop(count, seed):
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    start = seed % 40
    assert farthest_points(points, count, start).tolist() == farthest_loop(points.numpy(), count, start)


def test_line_is_halved_again_and_again():
    points = torch.zeros(9, 3)
    points[:, 0] = torch.arange(9.0)
    assert farthest_points(points, 5).tolist() == [0, 8, 4, 2, 6]


def test_rigid_motion_changes_nothing():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(100, 3, generator=generator, dtype=torch.float64)
    turned = points @ torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0] + 5
    assert torch.equal(farthest_points(points, 20), farthest_points(turned, 20))


def test_no_index_twice_even_where_points_coincide():
    points = torch.zeros(10, 3)
    assert sorted(farthest_points(points, 10, start=3).tolist()) == list(range(10))


@pytest.mark.parametrize("count", [0, 11])
def test_count_is_checked(count):
    with pytest.raises(AvatarError, match="count: expected 1 to 10"):
        farthest_points(torch.rand(10, 3), count)


@pytest.mark.parametrize("start", [-1, 10])
def test_start_is_checked(start):
    with pytest.raises(AvatarError, match="start: expected an index"):
        farthest_points(torch.rand(10, 3), 2, start)


def test_nan_is_refused():
    with pytest.raises(AvatarError, match="points: expected finite"):
        farthest_points(torch.full((10, 3), float("nan")), 2)
