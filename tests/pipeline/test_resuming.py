"""Long work goes on where it stopped: finished pieces are checked by hash and left, damaged ones are done again."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from concurrent_jobs import WAIT, run_at_once

from avatar.checks import AvatarError, DataError
from avatar.evaluation import scoring
from avatar.evaluation.metrics import METRICS as METRIC_TABLE
from avatar.evaluation.scores import read_scores
from avatar.evaluation.scoring import ScoreConfig
from avatar.export import meshing
from avatar.export.meshing import PoissonConfig
from avatar.io.checkpoints import save_checkpoint
from avatar.io.points import read_points, write_points
from avatar.methods import points as point_methods
from avatar.methods.settings import RunConfig
from avatar.pipeline.scores import (
    EvaluateConfig,
    PredictConfig,
    are_current,
    evaluate,
    floors_folder,
    floors_root,
    predict,
)
from avatar.pipeline.surfaces import ExportConfig, MeshConfig, mesh
from avatar.runs.training import load_avatar
from avatar.settings import settings_from_dict
from avatar.training.trainer import FORMAT
from reliability.small_jobs import folder_of, train_job

ROOT = Path(__file__).parents[2]
METRICS = ["cd_point", "normal_l1"]


@pytest.fixture
def count(monkeypatch):
    """Counts the calls of a function of a module."""

    def watch(module, name: str) -> list[int]:
        calls, real = [], getattr(module, name)

        def counted(*arguments, **options):
            calls.append(1)
            return real(*arguments, **options)

        monkeypatch.setattr(module, name, counted)
        return calls

    return watch


def spoil(path: Path) -> bytes:
    """Flips the lowest bit of a file's last number, which stays one of its kind; gives what the file was."""
    data = path.read_bytes()
    path.write_bytes(data[:-4] + bytes([data[-4] ^ 1]) + data[-3:])
    return data


def test_predict_mesh_and_evaluate_do_what_is_missing_or_damaged_and_nothing_else(run, count, capsys):
    points, frames = {"points": 1500, "device": "cpu"}, 2
    (folder,) = predict(PredictConfig(run=run, **points))
    clouds = sorted(folder.glob("*.ply"))
    calls = count(point_methods, "predict")
    predict(PredictConfig(run=run, **points))
    assert calls == []
    valid = spoil(clouds[1])
    predict(PredictConfig(run=run, **points))
    assert len(calls) == 1 and clouds[1].read_bytes() == valid
    predict(PredictConfig(run=run, points=1600, device="cpu"))
    assert len(calls) == 1 + frames
    predict(PredictConfig(run=run, **points))
    assert len(calls) == 1 + 2 * frames

    settings = {"run": run, "formats": ("ply",), "poisson": PoissonConfig(depth=5, max_hole=1.0, min_part=0.0)}
    (target,) = mesh(MeshConfig(**settings))
    calls = count(meshing.PoissonMesher, "mesh")
    mesh(MeshConfig(**settings))
    assert calls == []
    valid = spoil(sorted(target.glob("*.ply"))[0])
    mesh(MeshConfig(**settings))
    assert len(calls) == 1 and sorted(target.glob("*.ply"))[0].read_bytes() == valid

    config = EvaluateConfig(runs=(run,), score=ScoreConfig(scan_points=500, metrics=METRICS))
    first = evaluate(config)
    calls = count(scoring, "read_points")
    scored = (run / "scores.csv").read_text()
    assert evaluate(config).rows == first.rows and calls == []
    assert (run / "scores.csv").read_text() == scored  # to the bit
    spoil(clouds[0])
    evaluate(config)
    assert len(calls) == 1
    capsys.readouterr()


def test_scores_are_made_again_when_a_metric_or_a_prediction_changes_and_not_else(
    run, count, monkeypatch, change_source, capsys
):
    """A fixed metric must not keep its old numbers, and a change elsewhere must not cost a day of scoring."""
    predict(PredictConfig(run=run, points=1500, device="cpu"))
    config = EvaluateConfig(runs=(run,), score=ScoreConfig(scan_points=300, metrics=METRICS))
    before = {(row.method, row.metric): row.value for row in evaluate(config).rows}
    predictions, every = count(scoring, "read_points"), count(scoring, "draw_scan")

    def again() -> tuple[int, int]:
        """How many predictions and floors a call scores."""
        predictions.clear()
        every.clear()
        evaluate(config)
        return len(predictions), len(every) - len(predictions)

    change_source("avatar.evaluation.plots")
    change_source("avatar.pipeline.experiments")
    assert again() == (0, 0) and are_current(run / "scores.csv")
    change_source("avatar.evaluation.metrics")
    real = METRIC_TABLE["cd_point"]
    monkeypatch.setitem(METRIC_TABLE, "cd_point", replace(real, measure=lambda c: 2 * real.measure(c)))
    assert not are_current(run / "scores.csv")
    assert again() == (2, 4) and again() == (0, 0)  # two frames; two floors of each
    after = {(row.method, row.metric): row.value for row in evaluate(config).rows}
    assert after == {key: value * (2 if key[1] == "cd_point" else 1) for key, value in before.items()}
    assert after["closet", "cd_point"] in {row.value for row in read_scores(run / "scores.csv").rows}
    cloud = min((run / "predictions" / "test").rglob("*.ply"))
    points = read_points(cloud)
    write_points(cloud, replace(points, points=points.points + np.float32(0.01)))
    assert again() == (1, 0)
    capsys.readouterr()


def test_floors_keep_the_metrics_and_the_point_counts_of_earlier_tables(run, count, capsys):
    """Tables of one outfit ask for other metrics, and methods for other point counts: none takes another's away."""
    predictions, every = count(scoring, "read_points"), count(scoring, "draw_scan")

    def ask(metrics: list[str], points: int = 1500, seed: int = 0) -> tuple[set[str], set[str], int]:
        predictions.clear()
        every.clear()
        predict(PredictConfig(run=run, points=points, device="cpu"))
        config = EvaluateConfig(runs=(run,), score=ScoreConfig(scan_points=400, metrics=metrics, seed=seed))
        shown = {row.metric for row in evaluate(config).rows if row.method in ("sampling", "body")}
        file = floors_folder(run.parents[3], "open", run.parent.name, points) / "scores.csv"
        assert {row.points for row in read_scores(file).rows} == {points}
        return shown, {row.metric for row in read_scores(file).rows}, len(every) - len(predictions)

    both = {"normal_l1", "cd_point"}
    assert ask(["cd_point"]) == ({"cd_point"}, {"cd_point"}, 4)
    assert ask(["normal_l1", "cd_point"]) == (both, both, 4)  # the second metric alone
    assert ask(["cd_point"]) == ({"cd_point"}, both, 0)
    assert ask(["cd_point"], points=1444) == ({"cd_point"}, {"cd_point"}, 4)
    assert ask(["normal_l1", "cd_point"]) == (both, both, 0)
    assert ask(["cd_point"], seed=1) == ({"cd_point"}, {"cd_point"}, 4)
    assert ask(["cd_point"]) == ({"cd_point"}, {"cd_point"}, 0)
    capsys.readouterr()


FLOORS_JOB = f"""
import sys, time
from pathlib import Path
from avatar.data.layouts import find_outfit
from avatar.data.scanner import ScanConfig
from avatar.evaluation.scoring import ScoreConfig
from avatar.pipeline import scores
metric, root = sys.argv[1], Path(sys.argv[2])
outfit = find_outfit(root / "data", "open", sys.argv[3], ScanConfig(points=500))
real = scores.save_scores
def late(*arguments):
    (root / metric).touch()  # waits for the other job to have read the file, as long as one may have to
    end = time.monotonic() + 3
    while time.monotonic() < end and len(list(root.glob("*_*"))) < 2:
        time.sleep(0.01)
    real(*arguments)
scores.save_scores = late
config = scores.EvaluateConfig(score=ScoreConfig(scan_points=300, metrics=[metric]))
{WAIT}scores.score_floors(outfit, config, 500, root / "floors" / "scores.csv")
"""


def test_two_processes_that_score_the_same_floors_at_once_lose_nothing(tiny_folder, tmp_path):
    (tmp_path / "data").symlink_to(tiny_folder.parents[1])
    metrics = ("cd_point", "normal_l1")
    run_at_once(FLOORS_JOB, [(metric, str(tmp_path), tiny_folder.name) for metric in metrics])
    found = read_scores(tmp_path / "floors" / "scores.csv")
    assert {(row.method, row.metric) for row in found.rows} == {(m, n) for m in ("sampling", "body") for n in metrics}
    assert len(found.frames) == 4 * 3  # three frames


def test_what_a_foreign_run_says_of_its_root_is_not_believed(run, tmp_path):
    config = load_avatar(run, device="cpu").config
    assert floors_root(run, config) == config.runs_root
    assert floors_root(tmp_path / "elsewhere", config) == tmp_path / "elsewhere"


def describe(run: Path, folder: Path, **changes) -> Path:
    """A copy of a run whose description says something else."""
    folder.mkdir()
    for path in run.iterdir():
        if path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    description = json.loads((run / "avatar.json").read_text())
    (folder / "avatar.json").write_text(json.dumps(description | changes))
    return folder


def test_weights_that_do_not_fit_their_description_are_one_error(run, tmp_path):
    config = json.loads((run / "avatar.json").read_text())["config"]

    def with_settings(**changes) -> dict:
        method = config["method"]
        return {"config": config | {"method": method | {"settings": method["settings"] | changes}}}

    wide = {**config["method"]["settings"]["garment_decoder"], "width": 1 << 21}
    for name, changes, reason in (
        ("huge", with_settings(garment_decoder=wide), "ask for a network of"),
        ("other", with_settings(code_channels=3), "do not fit this run"),
        ("steps", {"steps": "many"}, "do not fit this run"),
    ):
        with pytest.raises(AvatarError, match=reason):
            load_avatar(describe(run, tmp_path / name, **changes), device="cpu")
    folder = describe(run, tmp_path / "none")
    (folder / "avatar.json").write_text(json.dumps({"sha256": "0"}))
    with pytest.raises(DataError, match="config is missing"):
        load_avatar(folder, device="cpu")


@pytest.mark.parametrize("name", ["../up", "/etc", "", "a/b", "a\nb", "x" * 65])
def test_names_that_could_lead_elsewhere_are_refused_wherever_they_stand(run, name):
    plain = json.loads((run / "avatar.json").read_text())["config"]
    for change in ({"name": name}, {"dataset": name}, {"outfit": [name]}, {"canonical": name}):
        with pytest.raises(AvatarError, match="expected a plain name"):
            settings_from_dict(RunConfig, plain | change)
    for kind in (MeshConfig, ExportConfig):
        with pytest.raises(AvatarError, match="expected a plain name"):
            kind(predictions=name)
    with pytest.raises(AvatarError, match="together"):
        settings_from_dict(RunConfig, plain | {"outfit": [f"{letter}{'x' * 60}" for letter in "abcd"]})


def test_a_checkpoint_that_does_not_fit_is_one_error(run):
    root = run.parents[4]
    folder = folder_of("closet", root, "forged")
    for number, state in enumerate(({"model": {}, "step": 3}, {"model": 5}, {})):
        save_checkpoint(folder / "checkpoints", state | {"format": FORMAT}, number + 1)
        with pytest.raises(DataError, match="do not fit this run"):
            train_job("closet", root, "forged")
    save_checkpoint(folder / "checkpoints", {"model": {}, "step": 3}, 4)
    with pytest.raises(DataError, match=r"expected checkpoints of format 2, got 1.*another name"):
        train_job("closet", root, "forged")
