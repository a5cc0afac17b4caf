"""Benchmarks: results agree, ratios are valid, tables keep rows that are not measured again. No test asserts a time."""

import math
import time

import pytest
import torch
import yaml

from avatar.checks import AvatarError
from avatar.config import CONF
from avatar.evaluation.scores import read_scores
from benchmarks.bench import BenchConfig, bench
from benchmarks.comparisons import Comparison, Job, run_comparison
from benchmarks.growth import ball, ball_batch
from benchmarks.memory import peak_memory

CONFIGS = {
    method: yaml.safe_load((CONF / "method_size" / f"{method}_small.yaml").read_text()) for method in ("closet", "pop")
}
AVATARS = {f"{method}_small": options for method, options in CONFIGS.items()}
JOB = Job(True, "cpu", AVATARS, {})


def run_quick(out, *only: str, **options):
    """A quick benchmark; gives its rows."""
    canonicalizers = {"small": yaml.safe_load((CONF / "canonicalizer_size" / "small.yaml").read_text())}
    options = {"quick": True, "memory": False, "repeats": 2, "avatars": AVATARS} | options
    bench(BenchConfig(only=only, out=out, canonicalizers=canonicalizers, **options))
    return read_scores(out / "bench.csv").rows


def allocating_comparisons(job: Job) -> list[Comparison]:
    """Two candidates that allocate 100 and 10 MiB for a moment."""

    def prepare(mebibytes: int):
        return lambda: float(torch.ones(mebibytes << 18).sum())

    return [Comparison("allocation", "", {str(size): lambda size=size: prepare(size) for size in (100, 10)}, "10")]


def test_a_comparison_orders_its_candidates_and_gives_the_difference_of_results():
    def sleeper(seconds: float):
        return lambda: lambda: time.sleep(seconds) or seconds

    candidates = {"long": sleeper(0.05), "short": sleeper(0.01)}
    comparison = Comparison("sleep", "", candidates, "short", lambda mine, base: mine - base)
    found = {(figure.candidate, figure.metric): figure for figure in run_comparison(comparison, 3)}
    assert found["short", "ratio"].value == 1 < found["long", "ratio"].value
    assert len(found["long", "seconds"].rounds) == 3
    assert found["long", "gap"].value == pytest.approx(0.04) and found["short", "gap"].value == 0
    with pytest.raises(AvatarError, match="baseline"):
        run_comparison(Comparison("sleep", "", {"long": sleeper(0)}, "short"), 1)


def test_peak_memory_is_that_of_one_candidate_in_its_own_process():
    large, small = (peak_memory(allocating_comparisons, JOB, 0, name) for name in ("100", "10"))
    assert 100 <= large < 120 and 10 <= small < 30


def test_references_agree_and_every_topic_has_its_rows(tmp_path):
    topics = ("nearest", "chamfer", "pointnet2", "step", "predict", "canonicalizer", "extraction", "mesh")
    rows = run_quick(tmp_path, *topics)
    assert {row.outfit for row in rows} == {"machine", *topics}
    ratios = [row for row in rows if row.metric in ("ratio", "processor_ratio")]
    assert all(0 < row.value < math.inf for row in ratios)
    assert {row.method for row in ratios if row.outfit == "nearest"} == {"ours", "brute force", "scipy", "open3d"}
    assert {row.method for row in ratios if row.outfit == "step"} == {"closet_small", "pop_small"}
    assert "layered_small" in {row.method for row in ratios if row.outfit == "mesh"}
    gaps = {(row.outfit, row.method): row.value for row in rows if row.metric == "gap"}
    assert len(gaps) == 4 + 3 + 4 + 2 and max(gaps.values()) < 1e-3
    assert all(row.unit and math.isnan(row.value) for row in rows if row.metric == "absent")
    text = (tmp_path / "bench.md").read_text()
    assert text.count("compiling needs CUDA here") == sum(row.metric == "absent" for row in rows) > 0
    assert len(read_scores(tmp_path / "bench.csv").frames) > len(ratios)


def test_topics_that_are_not_run_again_stay(tmp_path):
    before = run_quick(tmp_path, "chamfer", "extraction")
    after = run_quick(tmp_path, "extraction", repeats=1)
    kept = [row for row in before if row.outfit == "chamfer"]
    assert [row for row in after if row.outfit == "chamfer"] == kept and kept
    assert {row.frames for row in after if row.outfit == "extraction"} == {1}


def test_growth_and_ceilings_have_their_figures(tmp_path):
    rows = run_quick(tmp_path, "growth", "ceilings", repeats=1)
    exponents = [row.variant.split()[0] for row in rows if row.metric == "exponent"]
    assert exponents == ["points", "vertices", "outfits", "frames"]
    work = {row.method: row.value for row in rows if row.metric == "work"}
    assert set(work) == set(AVATARS) and min(work.values()) > 0
    assert all(row.value > 0 for row in rows if row.metric in ("share", "rate"))


def test_growth_is_measured_on_a_ball_in_turns_of_outfits():
    template = ball(3)
    batch = ball_batch(template, 4, 2, 30)
    torch.testing.assert_close(batch.scan_points.norm(dim=-1), torch.ones(4, 30))
    assert batch.outfit_ids.tolist() == [0, 1, 0, 1] and batch.vertices.shape == (4, len(template.vertices), 3)


def test_unknown_topics_and_no_rounds_are_refused():
    with pytest.raises(AvatarError, match=r"only: expected some of nearest.*got speed"):
        BenchConfig(only=("speed",))
    with pytest.raises(AvatarError, match="repeats"):
        BenchConfig(repeats=0)
