"""The shape decoder against a second writing of it, layer by layer."""

import torch
from torch.nn.functional import batch_norm, linear, softplus

from avatar.nn.decoders import DecoderConfig, ShapeDecoder
from avatar.nn.layers import PointNorm


def test_decoder_written_out():
    """A trunk, the input joined again, two branches; normalised by running statistics, which no channel shares."""
    torch.manual_seed(0)
    decoder = ShapeDecoder(7, DecoderConfig(width=6, trunk=3, branch=2)).double().eval()
    for norm in [module for module in decoder.modules() if isinstance(module, PointNorm)]:
        for value in (norm.weight.data, norm.bias.data, norm.running_mean, norm.running_var):
            value.copy_(0.5 + torch.rand(6))
    features, places = torch.randn(2, 11, 4, dtype=torch.float64), torch.randn(11, 3, dtype=torch.float64)

    def layer(x, parts, place):
        weights, norm, _ = parts[3 * place : 3 * place + 3]
        x = linear(x, weights.weight, weights.bias).flatten(0, 1)
        return softplus(batch_norm(x, norm.running_mean, norm.running_var, norm.weight, norm.bias)).view(2, 11, 6)

    joined = torch.cat([features, places.expand(2, -1, -1)], dim=-1)
    x = joined
    for place in range(3):
        x = layer(x, decoder.trunk, place)
    x = layer(torch.cat([joined, x], dim=-1), decoder.join, 0)
    decoded = decoder(features, places)
    for branch, found in ((decoder.offset_branch, decoded.offsets), (decoder.normal_branch, decoded.normals)):
        hidden = layer(layer(x, branch, 0), branch, 1)
        torch.testing.assert_close(found, linear(hidden, branch[-1].weight, branch[-1].bias))
