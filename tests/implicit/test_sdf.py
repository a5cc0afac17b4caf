"""The signed distance network: the paper's size, a sphere at first, metres everywhere, the input seen twice."""

import pytest
import torch

from avatar.checks import AvatarError
from avatar.geometry.transforms import fourier_features
from avatar.implicit.networks import MlpConfig, PosedSdf, SdfConfig, SkipMlp

BOX = torch.tensor([[-0.9, -1.0, -0.4], [1.1, 0.8, 0.4]])
SMALL = {"widths": (64, 64, 64, 64), "skip": 2, "orders": 4}


def test_full_size_is_the_papers():
    """Paper A.1: 51 waves of a point and 92 of a 24-joint pose; seven layers, the fourth as wide as 343."""
    network = PosedSdf(92, BOX, SdfConfig()).mlp
    sizes = [(143, 512), (512, 512), (512, 512), (512, 343), (343 + 143, 512), (512, 512), (512, 1)]
    assert [(layer.in_features, layer.out_features) for layer in (*network.layers, network.head)] == sizes
    expected = sum(inputs * outputs + 2 * outputs for inputs, outputs in sizes)  # weights, biases, norms
    assert sum(parameter.numel() for parameter in network.parameters()) == expected == 1_290_416


def test_it_starts_as_a_sphere_that_no_pose_moves():
    torch.manual_seed(0)
    sdf = PosedSdf(8, BOX, SdfConfig())
    directions = torch.nn.functional.normalize(torch.randn(400, 3), dim=-1)
    centre, scale = BOX.mean(dim=0), 1.0  # half of the longest side
    values = {}
    for radius in (0.2, 0.5, 0.9):
        points = (centre + radius * scale * directions)[None]
        values[radius] = sdf(points, torch.randn(1, 400, 8))
        torch.testing.assert_close(values[radius], sdf(points, torch.zeros(1, 400, 8)))
        assert values[radius].std() < 0.1 * (radius + 0.5)
    assert values[0.2].max() < 0 < values[0.9].min()
    slope = (values[0.9] - values[0.5]).mean() / 0.4
    assert slope.item() == pytest.approx(1, abs=0.3)


def test_distances_are_in_metres_whatever_the_box():
    """The same network over a box twice as large describes everything twice as large."""
    torch.manual_seed(0)
    sdf = PosedSdf(0, BOX, SdfConfig(**SMALL))
    twice = PosedSdf(0, 2 * BOX, SdfConfig(**SMALL))
    twice.mlp.load_state_dict(sdf.mlp.state_dict())
    points, pose = torch.rand(1, 50, 3), torch.zeros(1, 50, 0)
    torch.testing.assert_close(twice(2 * points, pose), 2 * sdf(points, pose))


def test_forward_is_the_plain_formula():
    torch.manual_seed(0)
    config = MlpConfig(widths=(6, 5, 7), skip=1, orders=0, beta=3.0)
    network, inputs = SkipMlp(4, 2, config).double(), torch.randn(10, 4, dtype=torch.float64)

    def softplus(x):
        return torch.log1p(torch.exp(3 * x)) / 3

    first, second, third = network.layers
    hidden = softplus(inputs @ first.weight.T + first.bias)
    hidden = softplus(torch.cat([hidden, inputs], dim=1) / 2**0.5 @ second.weight.T + second.bias)
    hidden = softplus(hidden @ third.weight.T + third.bias)
    torch.testing.assert_close(network.features(inputs), hidden)
    torch.testing.assert_close(network(inputs), hidden @ network.head.weight.T + network.head.bias)


def test_waves_are_sines_and_cosines_of_powers_of_two():
    point = torch.tensor([[0.3, -0.7, 1.1]], dtype=torch.float64)
    expected = [point]
    for order in range(3):
        expected += [torch.sin(2**order * point), torch.cos(2**order * point)]
    torch.testing.assert_close(fourier_features(point, 3), torch.cat(expected, dim=1))


def test_waves_and_pose_are_learned_though_they_start_at_zero():
    torch.manual_seed(0)
    sdf = PosedSdf(5, BOX, SdfConfig(**SMALL))
    points, pose = torch.rand(2, 30, 3), torch.randn(2, 30, 5, requires_grad=True)
    sdf(points, pose).square().mean().backward()
    with torch.no_grad():
        for parameter in sdf.parameters():
            parameter -= 0.1 * parameter.grad
    sdf(points, pose).sum().backward()
    assert pose.grad.abs().max() > 1e-4


def test_gradients_of_gradients_are_right():
    torch.manual_seed(0)
    sdf = PosedSdf(2, BOX, SdfConfig(widths=(8, 8), skip=1, orders=1, beta=5.0)).double()
    points = torch.rand(1, 3, 3, dtype=torch.float64, requires_grad=True)
    pose = torch.randn(1, 3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(lambda x, p: sdf(x, p), (points, pose))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"widths": ()}, "widths"),
        ({"widths": (8, 8), "skip": 2}, "skip: expected at least 1 and at most 1, got 2"),
        ({"orders": 20}, "orders: expected at least 0 and at most 16"),
        ({"beta": 0.0}, "beta: expected above 0"),
        ({"radius": 1.5}, "radius"),
    ],
)
def test_bad_sizes_are_refused(options, message):
    with pytest.raises(AvatarError, match=message):
        SdfConfig(**options)


def test_a_wrong_pose_width_is_refused():
    with pytest.raises(AvatarError, match="pose"):
        PosedSdf(5, BOX, SdfConfig(**SMALL))(torch.rand(1, 4, 3), torch.rand(1, 4, 6))
