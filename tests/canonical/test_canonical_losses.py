"""Every term of canonicalization against its equation; that it counts, with its sign; and its schedule."""

from dataclasses import replace

import pytest
import torch
from limbs import arm_frame, arm_template

from avatar.canonical.canonicalizer import (
    TERMS,
    Canonicalizer,
    CanonicalizerConfig,
    CanonicalLossConfig,
    Cycle,
    cycle_loss,
)
from avatar.canonical.fields import BodyField, SkinningFieldConfig
from avatar.canonical.scans import DrawConfig, draw_batch, prepare_scan
from avatar.checks import AvatarError

TEMPLATE = arm_template()
SILENT = dict.fromkeys(TERMS, 0.0)
SMALL = CanonicalizerConfig(SkinningFieldConfig(width=16), SkinningFieldConfig(width=16, orders=8, latent=4))

SCANS = [prepare_scan(arm_frame(bend), TEMPLATE, 500) for bend in (0.2, 1.3)]
NEAREST = BodyField(TEMPLATE, 1)


def batch_of(frames=(0, 1)):
    draw = DrawConfig(scan=60, body=40, edges=30)
    return draw_batch(SCANS, frames, TEMPLATE.weights, draw, torch.Generator().manual_seed(0))


def weights_at(*shape: int, seed: int = 0):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed)).softmax(dim=-1)


def perfect_cycle(batch) -> Cycle:
    """A cycle that comes back, with the nearest body's weights everywhere and codes of nothing."""
    middle = torch.tensor([0.0, 0.2, 0.0])  # a canonical place whose nearest vertex is skinned to the root alone
    one = torch.tensor([1.0, 0, 0]).expand_as(batch.nearest_weights)
    return Cycle(
        scan_weights=batch.nearest_weights,
        canonical=middle.expand_as(batch.points),
        canonical_weights=one,
        body_weights=batch.body_weights,
        canonical_body_weights=batch.body_weights,
        codes=torch.zeros(2, 4),
        reposed=batch.points,
        edge_weights=weights_at(2, 30, 1).expand(2, 30, 2, 3),
    )


def test_terms_are_the_equations():
    batch = batch_of()
    cycle = perfect_cycle(batch)
    raw = cycle_loss(cycle, batch, NEAREST, CanonicalLossConfig()).raw
    assert set(raw) == set(TERMS)
    for name in ("body", "smoothness", "cycle_points", "latent"):
        assert float(raw[name]) == 0, name
    assert float(raw["nearest"]) < 1e-6

    off = weights_at(2, 60, seed=1)
    guess, true = weights_at(2, 40, seed=2), batch.body_weights
    ends = weights_at(2, 30, 2, seed=3)
    codes = torch.arange(8.0).reshape(2, 4)
    wrong = Cycle(off, cycle.canonical, off.flip(1), guess, guess.flip(1), codes, batch.points + 0.03, ends)
    raw = cycle_loss(wrong, batch, NEAREST, CanonicalLossConfig(beta=0.5)).raw

    def squares(a, b):
        return float(((a - b) ** 2).sum(-1).mean())

    one = cycle.canonical_weights
    expected = {
        "body": squares(guess, true) + squares(guess.flip(1), true),
        "nearest": squares(off, batch.nearest_weights) + squares(off.flip(1), one),
        "cycle_weights": squares(off, off.flip(1)),
        "cycle_points": 0.03 * 3**0.5,
        "sparsity": float(off.sqrt().sum(-1).mean()),
        "smoothness": squares(ends[:, :, 0], ends[:, :, 1]),
        "latent": float((codes**2).sum(-1).mean()),
    }
    assert {name: float(value) for name, value in raw.items()} == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("term", TERMS)
def test_every_term_counts_with_its_weight_and_its_gradient_lowers_it(term):
    """Fails where a term is dropped from the objective, or enters it with the wrong sign."""
    torch.manual_seed(0)
    model, batch = Canonicalizer(TEMPLATE, 2, SMALL), batch_of()
    config = CanonicalLossConfig(**(SILENT | {term: 2.5}))

    def loss():
        return cycle_loss(model(batch, model.batch_codes(batch), True), batch, NEAREST, config)

    before = loss()
    assert list(before.weighted) == [term]
    assert float(before.total) == pytest.approx(2.5 * float(before.raw[term])) and float(before.total) > 0
    optimiser = torch.optim.SGD(model.parameters(), lr=0.01)
    for _ in range(5):
        optimiser.zero_grad()
        loss().total.backward()
        optimiser.step()
    assert float(loss().raw[term]) < float(before.raw[term])


@pytest.mark.parametrize("term", TERMS)
def test_weight_zero_ablates_a_term_and_no_other(term):
    batch = batch_of()
    cycle = replace(perfect_cycle(batch), codes=torch.ones(2, 4), reposed=batch.points + 1)
    whole = cycle_loss(cycle, batch, NEAREST, CanonicalLossConfig())
    less = cycle_loss(cycle, batch, NEAREST, CanonicalLossConfig(**{term: 0.0}))
    assert set(whole.weighted) - set(less.weighted) == {term}
    assert set(less.raw) == set(TERMS)  # still measured
    torch.testing.assert_close(whole.total - whole.weighted[term], less.total)


def test_cycle_terms_wait_for_the_second_stage_and_grow_in_its_second_half():
    batch = batch_of()
    cycle = replace(perfect_cycle(batch), reposed=batch.points + 1)
    apart = replace(cycle, reposed=None, edge_weights=None)
    first = cycle_loss(apart, batch, NEAREST, CanonicalLossConfig()).weighted
    assert set(first) == {"body", "nearest", "sparsity", "latent"}
    late, early = (
        cycle_loss(cycle, batch, NEAREST, CanonicalLossConfig(), progress).weighted for progress in (0.5, 0.49)
    )
    torch.testing.assert_close(late["cycle_points"], 10 * early["cycle_points"])
    torch.testing.assert_close(late["cycle_weights"], early["cycle_weights"])


def test_paper_weights_are_the_defaults():
    config = CanonicalLossConfig()
    assert [getattr(config, term) for term in TERMS] == [10, 1, 1, 1, 1e-3, 0.1, 0.01]
    assert config.beta == 0.8


def test_sparsity_prefers_one_joint_and_stays_finite_at_zero_weights():
    batch = batch_of()
    for weights in (torch.eye(3)[torch.zeros(2, 60).long()], weights_at(2, 60)):
        weights = weights.clone().requires_grad_()
        cycle = replace(perfect_cycle(batch), scan_weights=weights)
        value = cycle_loss(cycle, batch, NEAREST, CanonicalLossConfig()).raw["sparsity"]
        value.backward()
        assert torch.isfinite(weights.grad).all()
        assert float(value) == pytest.approx(1, abs=1e-3) if weights.max() == 1 else float(value) > 1.1


def test_bad_weights_are_refused_by_name():
    for options in ({"smoothness": -1.0}, {"beta": 0.0}, {"beta": 1.5}):
        with pytest.raises(AvatarError, match=next(iter(options))):
            CanonicalLossConfig(**options)
