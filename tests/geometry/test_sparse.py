"""Sparse sums of rows against the loop they stand for, their transpose against the matrix, gradients of both orders."""

import pretended
import pytest
import torch

from avatar.checks import AvatarError
from avatar.geometry.sparse import SparseRows, gather_rows, gather_sum, pick

SOURCE = torch.Generator().manual_seed(0)
TABLE = torch.randint(0, 9, (20, 3), generator=SOURCE)  # of 12 rows, so that three are in no bag
WEIGHTS = torch.rand(20, 3, dtype=torch.float64, generator=SOURCE)


def as_matrix(bags: SparseRows) -> torch.Tensor:
    """The map as a dense matrix ``(R, V)``, entry by entry."""
    matrix = torch.zeros(len(bags.starts), bags.rows, dtype=torch.float64)
    ends = [*bags.starts[1:].tolist(), len(bags.ids)]
    for bag, (start, end) in enumerate(zip(bags.starts.tolist(), ends)):
        for place in range(start, end):
            matrix[bag, bags.ids[place]] += 1 if bags.weights is None else bags.weights[place]
    return matrix


@pytest.mark.parametrize("weights", [None, WEIGHTS])
def test_sums_and_their_transpose_agree_with_the_matrix(weights):
    bags = SparseRows.of_table(TABLE, 12, weights)
    matrix = as_matrix(bags)
    values = torch.randn(2, 4, 12, 5, dtype=torch.float64, generator=SOURCE)
    torch.testing.assert_close(gather_sum(values, bags), matrix @ values)
    torch.testing.assert_close(as_matrix(bags.transpose()), matrix.T)
    torch.testing.assert_close(as_matrix(bags.transpose().transpose()), matrix)


@pytest.mark.parametrize("kept", [True, False])
def test_gradients_of_both_orders(kept):
    bags = SparseRows.of_table(TABLE[:6], 12, WEIGHTS[:6])
    back = bags.transpose() if kept else None
    values = torch.randn(2, 12, 2, dtype=torch.float64, generator=SOURCE, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: gather_sum(v, bags, back), values)
    assert torch.autograd.gradgradcheck(lambda v: gather_sum(v, bags, back).sin(), values)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.bfloat16, 2e-2)])
def test_narrow_types_keep_their_type_and_agree_to_rounding(dtype, tolerance):
    bags = SparseRows.of_table(TABLE, 12, WEIGHTS)
    values = torch.rand(1, 12, 8, dtype=torch.float64, generator=SOURCE)
    found = gather_sum(values.to(dtype), bags)
    assert found.dtype == dtype
    torch.testing.assert_close(found.double(), as_matrix(bags) @ values, rtol=tolerance, atol=tolerance)


def test_gradients_do_not_depend_on_the_number_of_threads():
    table = torch.randint(0, 50, (4000, 3), generator=SOURCE)
    values = torch.randn(2, 50, 16, generator=SOURCE, requires_grad=True)
    gradient = torch.randn(2, 4000, 16, generator=SOURCE)
    threads, found = torch.get_num_threads(), []
    for count in (1, 2):
        torch.set_num_threads(count)
        found += torch.autograd.grad(gather_sum(values, SparseRows.of_table(table, 50)), values, gradient)
    torch.set_num_threads(threads)
    assert torch.equal(*found)


def test_values_of_another_number_of_rows_are_refused():
    with pytest.raises(AvatarError, match="V=12"):
        gather_sum(torch.zeros(11, 3), SparseRows.of_table(TABLE, 12))


@pytest.mark.parametrize("device", ["cpu", pytest.param(pretended.NAME, marks=pytest.mark.pretended)])
def test_picked_rows_and_their_gradients_agree_with_the_loop(device):
    ids = torch.randint(0, 5, (2, 40), generator=SOURCE)  # of 7 rows: many more than once, two never
    values = torch.randn(2, 7, 3, dtype=torch.float64, generator=SOURCE)
    gradient = torch.randn(2, 40, 3, dtype=torch.float64, generator=SOURCE)
    rows, back = torch.zeros_like(gradient), torch.zeros_like(values)
    for frame in range(2):
        for place, row in enumerate(ids[frame].tolist()):
            rows[frame, place] = values[frame, row]
            back[frame, row] += gradient[frame, place]
    there = values.to(device).requires_grad_()
    found = gather_rows(there, ids.to(device))
    assert torch.equal(found.cpu(), rows)
    (found,) = torch.autograd.grad(found, there, gradient.to(device))
    torch.testing.assert_close(found.cpu(), back)
    one = pick(there[0], ids[0].to(device))
    assert torch.equal(one.cpu(), rows[0])
    (found,) = torch.autograd.grad(one, there, gradient[0].to(device))
    torch.testing.assert_close(found.cpu(), torch.stack([back[0], 0 * back[1]]))


@pytest.mark.parametrize("device", ["cpu", pytest.param(pretended.NAME, marks=pytest.mark.pretended)])
def test_picking_and_its_backward_pass_are_repeatable(device):
    """No operation that torch knows to add in an order of chance, on the CPU or on a device."""
    torch.use_deterministic_algorithms(True)
    try:
        pretended.used.clear()
        values, ids = torch.randn(2, 9, 4, generator=SOURCE), torch.randint(0, 9, (2, 30), generator=SOURCE)
        there, ids = values.to(device).requires_grad_(), ids.to(device)
        (gather_rows(there, ids).square().sum() + pick(there, ids[0].clamp(max=1)).square().sum()).backward()
    finally:
        torch.use_deterministic_algorithms(False)
    assert bool(pretended.used) == (device != "cpu") and not pretended.used & pretended.BY_CHANCE
