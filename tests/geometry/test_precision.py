"""Full precision: what is wrapped computes under autocast as without, in float32 or wider."""

import pytest
import torch
from torch.nn.functional import linear

from avatar.geometry.precision import full_precision, widen


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_a_wrapped_function_does_not_notice_autocast(kind):
    torch.manual_seed(0)
    points, weight = torch.randn(50, 3, dtype=kind), torch.randn(4, 3, dtype=kind)
    expected = linear(points, weight)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(full_precision(linear)(points, weight), expected)
        assert linear(points.float(), weight.float()).dtype is torch.bfloat16


def test_half_precision_is_widened_and_nothing_else():
    half = torch.ones(2, dtype=torch.bfloat16)
    assert widen(half).dtype is torch.float32 and widen(half.double()).dtype is torch.float64
    assert widen(None) is None and widen(torch.arange(2)).dtype is torch.int64
    assert full_precision(torch.add)(half, half).dtype is torch.float32
