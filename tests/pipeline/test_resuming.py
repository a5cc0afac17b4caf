"""Long work goes on where it stopped: finished pieces are checked by hash and left, damaged ones are done again."""

import json
from pathlib import Path

import pytest

from avatar.checks import AvatarError, DataError
from avatar.evaluation import scoring
from avatar.evaluation.scores import read_scores
from avatar.evaluation.scoring import ScoreConfig
from avatar.export import meshing
from avatar.export.meshing import PoissonConfig
from avatar.pipeline import scores
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, floors_root, predict
from avatar.pipeline.surfaces import ExportConfig, MeshConfig, mesh
from avatar.pipeline.torture.miniature import folder_of, prepare, train_job
from avatar.settings import settings_from_dict
from avatar.training import prediction
from avatar.training.checkpoints import save_checkpoint
from avatar.training.runs import RunConfig, load_run

METRICS = ["cd_point", "normal_l1"]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("resuming")
    prepare(root)
    return train_job("closet", root)


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
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    return data


def test_predict_mesh_and_evaluate_do_what_is_missing_or_damaged_and_nothing_else(run, count, capsys):
    points, frames = {"points": 1500, "device": "cpu"}, 2
    (folder,) = predict(PredictConfig(run=run, **points))
    clouds = sorted(folder.glob("*.ply"))
    calls = count(prediction, "predict")
    predict(PredictConfig(run=run, **points))
    assert calls == []
    sound = spoil(clouds[1])
    predict(PredictConfig(run=run, **points))
    assert len(calls) == 1 and clouds[1].read_bytes() == sound
    predict(PredictConfig(run=run, points=1600, device="cpu"))
    assert len(calls) == 1 + frames
    predict(PredictConfig(run=run, **points))
    assert len(calls) == 1 + 2 * frames

    settings = {"run": run, "formats": ("ply",), "poisson": PoissonConfig(depth=5, max_hole=1.0, min_part=0.0)}
    (target,) = mesh(MeshConfig(**settings))
    calls = count(meshing.PoissonMesher, "mesh")
    mesh(MeshConfig(**settings))
    assert calls == []
    sound = spoil(sorted(target.glob("*.ply"))[0])
    mesh(MeshConfig(**settings))
    assert len(calls) == 1 and sorted(target.glob("*.ply"))[0].read_bytes() == sound

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


def test_floors_keep_the_metrics_of_earlier_tables(run, count, capsys):
    """Two tables of one outfit ask for other metrics; neither may take the other's floors away."""
    predict(PredictConfig(run=run, points=1500, device="cpu"))
    calls = count(scores, "score_sampling_floor")

    def floors(metrics: list[str], seed: int = 0) -> tuple[set[str], set[str]]:
        config = EvaluateConfig(runs=(run,), score=ScoreConfig(scan_points=400, metrics=metrics, seed=seed))
        shown = {row.metric for row in evaluate(config).rows if row.method in ("sampling", "body")}
        (file,) = (run.parents[3] / "floors").rglob("scores.csv")
        return shown, {row.metric for row in read_scores(file).rows}

    assert floors(["cd_point"]) == ({"cd_point"}, {"cd_point"})
    assert floors(["normal_l1", "cd_point"]) == ({"normal_l1", "cd_point"}, {"normal_l1", "cd_point"})
    assert floors(["cd_point"]) == ({"cd_point"}, {"normal_l1", "cd_point"})
    assert len(calls) == 2
    assert floors(["cd_point"], seed=1) == ({"cd_point"}, {"cd_point"})
    capsys.readouterr()


def test_what_a_foreign_run_says_of_its_root_is_not_believed(run, tmp_path):
    config = load_run(run, device="cpu").config
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
            load_run(describe(run, tmp_path / name, **changes), device="cpu")
    folder = describe(run, tmp_path / "none")
    (folder / "avatar.json").write_text(json.dumps({"sha256": "0"}))
    with pytest.raises(DataError, match="config is missing"):
        load_run(folder, device="cpu")


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
        save_checkpoint(folder / "checkpoints", state, number + 1)
        with pytest.raises(DataError, match="do not fit this run"):
            train_job("closet", root, "forged")
