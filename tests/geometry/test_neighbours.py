"""Nearest neighbours against loops; ties, ball queries, bad input and speed."""

import time

import numpy as np
import pretended
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import ball_loop, nearest_loop, ranked_ball_loop

from avatar.checks import AvatarError
from avatar.geometry import neighbours
from avatar.geometry.neighbours import (
    FixedPoints,
    _k_nearest_chunked,
    ball_query,
    correspond,
    k_nearest,
    nearest,
)
from avatar.geometry.surface import farthest_points
from avatar.geometry.trees import build_tree


def cloud(batch: int, count: int, seed: int) -> torch.Tensor:
    return torch.rand(batch, count, 3, generator=torch.Generator().manual_seed(seed))


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 1000))
def test_k_nearest_agrees_with_loop(queries, points, seed):
    q, p = cloud(2, queries, seed), cloud(2, points, seed + 1)
    k = min(points, 4)
    found = k_nearest(q, p, k)
    assert found.shape == (2, queries, k) and found.dtype == torch.long
    for b in range(2):
        np.testing.assert_array_equal(found[b].numpy(), nearest_loop(q[b].double().numpy(), p[b].double().numpy(), k))


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 200), st.integers(1, 200), st.integers(0, 1000))
def test_both_ways_agree_with_loop(points, others, seed):
    p, q = cloud(2, points, seed), cloud(2, others, seed + 1)
    found = correspond(p, q)
    there, back = found.scan_of_point, found.point_of_scan
    for b, (first, second) in enumerate(zip(p.double().numpy(), q.double().numpy())):
        np.testing.assert_array_equal(there[b, :, None].numpy(), nearest_loop(first, second, 1))
        np.testing.assert_array_equal(back[b, :, None].numpy(), nearest_loop(second, first, 1))


def test_chunked_search_of_devices_agrees_with_the_tree(monkeypatch):
    monkeypatch.setattr("avatar.geometry.neighbours.CHUNK_PAIRS", 1000)  # several chunks, the last one short
    q, p = cloud(1, 333, 0), cloud(1, 200, 1)
    for k in (1, 5):
        torch.testing.assert_close(_k_nearest_chunked(q[0], p[0], k), k_nearest(q, p, k)[0])


def test_near_ties_that_the_expanded_product_form_gets_wrong():
    """Far from the origin |a|^2 - 2ab + |b|^2 cancels in float32; squares of differences do not."""
    points = torch.tensor([[[1000.0, 1000.0, 1000.0], [1000.01, 1000.0, 1000.0]]])
    queries = torch.tensor([[[1000.006, 1000.0, 1000.0], [1000.002, 1000.0, 1000.0]]])
    assert nearest(queries, points).tolist() == [[1, 0]]
    assert _k_nearest_chunked(queries[0], points[0], 1).tolist() == [[1], [0]]


def test_ties_give_a_nearest_point_and_the_same_one_each_time():
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)[None]
    points = torch.cat([corners, corners], dim=1)
    queries = torch.zeros(1, 10, 3)
    first = k_nearest(queries, points, 6)
    assert torch.equal(first, k_nearest(queries, points, 6))
    assert all(len(set(row)) == 6 for row in first[0].tolist())
    assert nearest(points, points).remainder(8).tolist() == [list(range(8)) * 2]


def test_batch_of_one_is_batch_of_many():
    q, p = cloud(3, 50, 0), cloud(3, 40, 1)
    torch.testing.assert_close(k_nearest(q, p, 3)[1:2], k_nearest(q[1:2], p[1:2], 3))


def test_other_dtypes_and_gradients_pass_in():
    q, p = cloud(1, 20, 0), cloud(1, 20, 1)
    expected = nearest(q.bfloat16().float(), p.bfloat16().float())
    assert torch.equal(nearest(q.bfloat16(), p.bfloat16()), expected)
    assert not nearest(q.clone().requires_grad_(), p.clone().requires_grad_()).requires_grad


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("where", ["queries", "points"])
def test_non_finite_coordinates_are_refused(bad, where):
    q, p = cloud(1, 5, 0), cloud(1, 5, 1)
    (q if where == "queries" else p)[0, 2, 1] = bad
    with pytest.raises(AvatarError, match="finite"):
        nearest(q, p)
    with pytest.raises(AvatarError, match="finite"):
        correspond(q, p)


def test_chunked_search_carries_nan_through_with_indices_in_range():
    q, p = cloud(1, 5, 0)[0], cloud(1, 7, 1)[0]
    q[2] = float("nan")
    ids = _k_nearest_chunked(q, p, 1)
    assert ids.min() >= 0 and ids.max() < 7
    assert (q - p[ids[:, 0]])[2].isnan().all()


def test_counts_and_shapes_are_checked():
    with pytest.raises(AvatarError, match="k of 1 to the 5 points, got 6"):
        k_nearest(cloud(1, 5, 0), cloud(1, 5, 1), 6)
    with pytest.raises(AvatarError, match="k of 1 to the 5 points, got 0"):
        k_nearest(cloud(1, 5, 0), cloud(1, 5, 1), 0)
    with pytest.raises(AvatarError, match="B=1"):
        nearest(cloud(1, 5, 0), cloud(2, 5, 1))
    with pytest.raises(AvatarError, match="k of 1 to the 0 points, got 1"):
        nearest(cloud(1, 5, 0), torch.zeros(1, 0, 3))


@pytest.mark.parametrize("radius", [0.05, 0.3, 5.0])
def test_ball_query_agrees_with_loop(radius):
    centres, points = cloud(1, 12, 0)[0], cloud(1, 60, 1)[0]
    found = ball_query(centres, points, radius, 8)
    assert found.tolist() == ball_loop(centres.double().numpy(), points.double().numpy(), radius, 8)


@pytest.mark.parametrize("radius", [0.05, 0.3, 1.0, 5.0])
def test_ranked_ball_query_agrees_with_loop(radius):
    centres, points = cloud(1, 12, 0)[0], cloud(1, 60, 1)[0]
    ranks = torch.randperm(60, generator=torch.Generator().manual_seed(2))
    found = ball_query(centres, points, radius, 8, ranks)
    slow = ranked_ball_loop(centres.double().numpy(), points.double().numpy(), radius, 8, ranks.tolist())
    assert found.tolist() == slow


def test_ranked_groups_reach_as_far_as_their_balls_not_as_far_as_their_number():
    """12 of 6,000 points on a square metre: the nearest lie within 3 cm, a ball of 15 cm holds hundreds."""
    points = torch.rand(6000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1.0, 0.0])
    centres = torch.tensor([[0.5, 0.5, 0.0], [0.3, 0.6, 0.0]])
    ranks = farthest_points(points, len(points)).argsort()
    for order, least, most in ((ranks, 0.1, 0.15), (None, 0.0, 0.03)):
        reach = (points[ball_query(centres, points, 0.15, 12, order)] - centres[:, None]).norm(dim=-1).amax(dim=1)
        assert (least < reach).all() and (reach <= most).all()


def test_ball_query_groups_longer_than_the_cloud_repeat_the_nearest():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert ball_query(torch.tensor([[0.9, 0, 0]]), points, 1.0, 5).tolist() == [[1, 0, 1, 1, 1]]


def test_full_size_search_is_fast():
    """50,000 x 40,000 takes 0.15 s of processor time (brute force: 20 s); with room for a machine that others use."""
    q, p = cloud(1, 50_000, 0), cloud(1, 40_000, 1)
    nearest(q, p)
    start = time.process_time()
    nearest(q, p)
    assert time.process_time() - start < 1.0


@pytest.mark.parametrize("device", ["cpu", pytest.param(pretended.NAME, marks=pytest.mark.pretended)])
def test_fixed_points_are_searched_as_others_and_their_tree_is_built_once(monkeypatch, device):
    points, queries = cloud(1, 60, 0), cloud(3, 40, 1)
    expected = k_nearest(queries, points.expand(3, -1, -1), 4)
    built = []
    monkeypatch.setattr(neighbours, "build_tree", lambda *given: built.append(1) or build_tree(*given))
    fixed = FixedPoints(points[0])
    for _ in range(3):
        assert torch.equal(fixed.k_nearest(queries.to(device), 4).cpu(), expected)
    assert len(built) == (device == "cpu")
    with pytest.raises(AvatarError, match="k of 1 to the 60 points"):
        fixed.k_nearest(queries, 61)


@pytest.mark.pretended
@pytest.mark.parametrize("search", [k_nearest, correspond])
def test_a_device_searches_by_itself(search):
    points, queries = cloud(2, 50, 0), cloud(2, 40, 1)
    more = (3,) if search is k_nearest else ()
    there, here = search(queries.to(pretended.NAME), points.to(pretended.NAME), *more), search(queries, points, *more)
    for found, expected in [(there, here)] if search is k_nearest else zip(vars(there).values(), vars(here).values()):
        torch.testing.assert_close(found.cpu(), expected)
