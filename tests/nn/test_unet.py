"""The U-Net: its published size, a second writing of it layer by layer, and what it refuses."""

import pytest
import torch
from torch.nn.functional import batch_norm, conv2d, conv_transpose2d, interpolate, leaky_relu, relu

from avatar.checks import AvatarError
from avatar.nn.unet import Doubling, UNet, UNetConfig


def parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_pop_and_scale_have_their_sizes():
    assert parameters(UNet(3, UNetConfig())) == 10_348_192  # POP's, as counted from its instantiated network
    down = 16 * (3 * 32 + 32 * 64 + 64 * 128 + 128 * 256 + 256 * 256)
    up = 16 * (256 * 256 + 512 * 128) + 9 * (256 * 64 + 128 * 32 + 64 * 64) + 64 + 32 + 64
    norms = 2 * (64 + 128 + 256 + 256 + 128 + 64 + 32)
    assert parameters(UNet(3, UNetConfig(levels=5, affine=True))) == down + up + norms


def test_four_levels_written_out():
    """POP's recipe with its one transposed convolution; by running statistics, which hide no scale or bias."""
    torch.manual_seed(0)
    net = UNet(3, UNetConfig(levels=4, width=4, out_channels=5, affine=True)).double().eval()
    image = torch.randn(2, 3, 32, 32, dtype=torch.float64)
    for norm in [module for module in net.modules() if isinstance(module, torch.nn.BatchNorm2d)]:
        for value in (norm.weight.data, norm.bias.data, norm.running_mean, norm.running_var):
            value.copy_(0.5 + torch.rand_like(value))

    def normed(x, block):
        norm = block[-1]
        return batch_norm(x, norm.running_mean, norm.running_var, norm.weight, norm.bias)

    def smooth(x, layer):
        x = interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        return conv2d(x, layer.weight, layer.bias, padding=1)

    kernels = [next(m.weight for m in down if isinstance(m, torch.nn.Conv2d)) for down in net.downs]
    first = conv2d(image, kernels[0], stride=2, padding=1)
    second = normed(conv2d(leaky_relu(first, 0.2), kernels[1], stride=2, padding=1), net.downs[1])
    third = normed(conv2d(leaky_relu(second, 0.2), kernels[2], stride=2, padding=1), net.downs[2])
    deepest = conv2d(leaky_relu(third, 0.2), kernels[3], stride=2, padding=1)
    up = normed(conv_transpose2d(relu(deepest), net.ups[0][1].weight, stride=2, padding=1), net.ups[0])
    for skip, layer in ((third, net.ups[1]), (second, net.ups[2])):
        up = normed(smooth(relu(torch.cat([up, skip], dim=1)), layer[2]), layer)
    up = smooth(relu(torch.cat([up, first], dim=1)), net.ups[3][2])
    torch.testing.assert_close(net(image), up)
    assert up.shape == (2, 5, 32, 32)


def test_every_pixel_sees_the_whole_image():
    torch.manual_seed(0)
    net = UNet(1, UNetConfig(levels=3, width=4, out_channels=1)).eval()
    image = torch.randn(1, 1, 8, 8, requires_grad=True)
    net(image)[0, 0, 0, 0].backward()
    assert (image.grad != 0).all()


def test_images_do_not_see_each_other_and_one_alone_can_be_trained_on():
    net = UNet(3, UNetConfig(levels=4, width=4))
    assert net(torch.randn(1, 3, 16, 16)).isfinite().all()  # the deepest image is one pixel: no normalisation there
    images = torch.randn(3, 3, 32, 48)
    torch.testing.assert_close(net.eval()(images)[1:2], net(images[1:2]))


@pytest.mark.parametrize("affine", [False, True])
def test_normalisations_learn_a_scale_when_told_to(affine):
    """All levels but the first and the deepest on the way down, all but the last on the way up."""
    norms = [m for m in UNet(3, UNetConfig(affine=affine)).modules() if isinstance(m, torch.nn.BatchNorm2d)]
    assert len(norms) == 5 + 6 and {norm.affine for norm in norms} == {affine}


def test_bad_sizes_are_refused():
    with pytest.raises(AvatarError, match=r"multiple of 16.*got 24 x 16"):
        UNet(3, UNetConfig(levels=4, width=2))(torch.zeros(1, 3, 24, 16))
    with pytest.raises(AvatarError, match="image: expected shape"):
        UNet(3, UNetConfig(levels=4, width=2))(torch.zeros(1, 2, 16, 16))
    for wrong in ({"levels": 2}, {"width": 0}, {"out_channels": 0}):
        with pytest.raises(AvatarError, match=f"{next(iter(wrong))}: expected at least"):
            UNetConfig(**wrong)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (8, 4)])
def test_doubling_and_its_gradient_are_those_of_interpolation(size):
    image = torch.randn(2, 3, *size, dtype=torch.float64, requires_grad=True)
    slow = interpolate(image, scale_factor=2, mode="bilinear", align_corners=False)
    fast = Doubling()(image)
    torch.testing.assert_close(fast, slow)
    gradient = torch.randn_like(slow)
    for mine, theirs in zip(*(torch.autograd.grad(found, image, gradient) for found in (fast, slow))):
        torch.testing.assert_close(mine, theirs)
    assert Doubling()(image.bfloat16()).dtype == torch.bfloat16
