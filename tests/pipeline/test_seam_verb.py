"""The seam test of real runs: POP jumps where the atlas is cut, a network on the surface nowhere."""

import csv

import pytest
from tiny import SETTINGS, quick_training

from avatar.checks import AvatarError
from avatar.methods.settings import MethodChoice, RunConfig
from avatar.pipeline.seams import SeamsConfig, seams
from avatar.runs.training import train as train_run

POP = {"map_size": 16, "code_channels": 4, "code_std": 0.5, "pose_encoder": {"levels": 3, "width": 4}}
POP |= {"pose_decoder": {"width": 24, "trunk": 2, "branch": 0}}


@pytest.fixture(scope="module")
def runs(tiny_folder, tmp_path_factory):
    """Runs of POP and CloSET on the tiny outfit, two steps each."""
    found = []
    for method in (MethodChoice("pop", "pop", POP), MethodChoice("closet", "closet", SETTINGS)):
        config = RunConfig(
            method=method,
            dataset=tiny_folder.parent.name,
            outfit=(tiny_folder.name,),
            data_root=tiny_folder.parents[1],
            runs_root=tmp_path_factory.mktemp("runs"),
            train=quick_training(steps=2, points=500, scan_points=500),
        )
        found.append(train_run(config))
    return tuple(found)


def test_pop_jumps_at_seams_and_the_surface_nowhere(runs, tmp_path, capsys):
    text = seams(SeamsConfig(runs=runs, points=3000, frames=2, baseline="closet", out=tmp_path)).read_text()
    assert text in capsys.readouterr().out and "**tiny: seams, difference**" in text
    rows = list(csv.DictReader((tmp_path / "seams.csv").read_text().splitlines()))
    jumps = {(r["method"], r["where"]): float(r["value"]) for r in rows if r["metric"] == "jump"}
    assert jumps["pop", "seams"] > 1e-5
    others = [value for (method, where), value in jumps.items() if (method, where) != ("pop", "seams")]
    assert len(others) == 3 and max(others) < 1e-6
    near = {r["method"]: r for r in rows if (r["metric"], r["low"]) == ("distance", "0.0")}
    assert near["pop"]["points"] != "0" and near["pop"]["frames"] == "2" and near["pop"]["dataset"] == "open"


def test_what_cannot_be_asked_is_refused_before_anything_is_measured(runs, tmp_path, monkeypatch):
    monkeypatch.setattr("avatar.pipeline.seams.probe_seams", lambda *_: pytest.fail("something was measured"))
    with pytest.raises(AvatarError, match="folders of trained runs"):
        seams(SeamsConfig())
    with pytest.raises(AvatarError, match="baseline: expected one of pop, got 'csf'"):
        seams(SeamsConfig(runs=runs[:1], points=1000, frames=1, baseline="csf", out=tmp_path))
