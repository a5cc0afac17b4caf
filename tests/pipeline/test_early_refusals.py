"""What cannot be finished is refused before any work: options, data and machines that a later step would refuse."""

from dataclasses import replace

import pytest
from tiny import SETTINGS, quick_training

from avatar.checks import AvatarError, DataError
from avatar.data.packed_layout import write_packed_outfit
from avatar.data.scanner import ScanConfig
from avatar.data.splits import SplitConfig
from avatar.evaluation.scores import Score, Scores, write_scores
from avatar.evaluation.scoring import ScoreConfig
from avatar.methods.canonicalizer import CanonicalizeConfig
from avatar.methods.settings import MethodChoice, RunConfig
from avatar.pipeline import canonicalization, experiments, scores
from avatar.pipeline.canonicalization import canonicalize
from avatar.pipeline.experiments import DemoConfig, ExperimentConfig, demo, experiment, has_baseline
from avatar.pipeline.reporting import CompareConfig
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, predict
from avatar.runs.training import train as train_run
from avatar.simulate.recording import SimulateConfig


@pytest.fixture
def untruthful(tiny_outfit, tmp_path):
    """Where a packed outfit is whose scans do not know where they belong at rest, and that has no test frames."""
    folder = tmp_path / "data" / "theirs" / "coat"

    class Untruthful:
        """The tiny outfit without the truth."""

        dataset, name, path, template = tiny_outfit.dataset, "coat", folder, tiny_outfit.template

        def __getattr__(self, name):
            return getattr(tiny_outfit, name)

        def has_frames(self, split):
            return split == "train"

        def load(self, split, name):
            frame = tiny_outfit.load(split, name)
            return replace(frame, scan=replace(frame.scan, canonical=None, labels=None))

    (folder / "train").mkdir(parents=True)
    write_packed_outfit(Untruthful(), folder)
    return {"data_root": tmp_path / "data", "runs_root": tmp_path / "runs", "dataset": "theirs"}


@pytest.fixture
def idle(monkeypatch):
    """Fails the test where something is trained or canonicalized."""

    def refuse(*_):
        raise AssertionError("work was begun")

    for module, names in {
        canonicalization: ("train_canonicalizer",),
        experiments: ("train", "make_canonical_scans", "canonicalize"),
    }.items():
        for name in names:
            monkeypatch.setattr(module, name, refuse)


def test_canonical_scans_without_truth_are_not_scored(untruthful, idle):
    with pytest.raises(AvatarError, match=r"scored, theirs/coat: scan: expected labels.*Hint: leave out scored"):
        canonicalize(CanonicalizeConfig(outfit="coat", scored=2, **untruthful))
    choice = MethodChoice("closet", "closet_learned", SETTINGS | {"skinning": "learned"})
    job = ExperimentConfig(
        method=choice,
        outfit=("coat",),
        canonicalizer=CanonicalizeConfig(scored=2),
        compare=CompareConfig(splits=("train",), pictures=0),
        **untruthful,
    )
    with pytest.raises(AvatarError, match=r"scored, theirs/coat"):
        experiment(job)


def test_pictures_and_meshes_on_a_machine_that_cannot_make_them(untruthful, tiny_folder, idle, monkeypatch):
    def refuse():
        raise AvatarError("cannot draw")

    for module in (canonicalization, experiments):
        monkeypatch.setattr(module, "load_pyvista", refuse)
    with pytest.raises(AvatarError, match="cannot draw"):
        canonicalize(CanonicalizeConfig(outfit="coat", **untruthful))
    where = {"dataset": "open", "outfit": (tiny_folder.name,), "data_root": tiny_folder.parents[1]}
    with pytest.raises(AvatarError, match="cannot draw"):
        experiment(ExperimentConfig(**where))
    with pytest.raises(AvatarError, match="cannot draw"):
        demo(DemoConfig(**where))
    monkeypatch.setattr("avatar.export.meshing.find_spec", lambda name: None)
    with pytest.raises(AvatarError, match="meshing needs open3d"):
        demo(DemoConfig(**where))


def test_an_experiment_without_what_its_scores_need(untruthful, idle):
    with pytest.raises(DataError, match=r"coat/test"):
        experiment(ExperimentConfig(outfit=("coat",), **untruthful))
    with pytest.raises(DataError, match=r"coat/test"):
        demo(DemoConfig(outfit=("coat",), **untruthful))
    with pytest.raises(AvatarError, match="points: expected 1,000"):
        ExperimentConfig(points=10)
    with pytest.raises(AvatarError, match="points: expected 1,000"):
        DemoConfig(points=10)
    with pytest.raises(
        AvatarError, match=r"compare\.splits: expected some of train, test, interpolation, validation, got tests"
    ):
        ExperimentConfig(compare=CompareConfig(splits=("tests",)))
    with pytest.raises(AvatarError, match=r"split\.validation_share: expected above 0"):
        ExperimentConfig(split=SplitConfig(validation_share=0), compare=CompareConfig(splits=("validation",)))
    with pytest.raises(AvatarError, match=r"method: .* static floor.*got pop.*tools/train\.py method=pop"):
        DemoConfig(method=MethodChoice("pop", "pop", {}))


def test_a_table_without_its_baseline_is_made_without_differences(tmp_path):
    """A job that failed, or was not asked for, leaves its place empty; it does not take the table with it."""
    row = Score("main", "dress", "pop", "", "cd_point", 1.0, "m2", 1, 0, 1, 1.0, 1000, "", "sample", 1.0)
    write_scores(tmp_path / "run" / "scores.csv", Scores([row]))
    settings = CompareConfig(runs=(tmp_path / "run",))
    there = {name: has_baseline(replace(settings, baseline=name)) for name in ("pop", "body", "closet")}
    assert there == {"pop": True, "body": True, "closet": False}


def test_no_run_is_scored_where_another_was_not_predicted(tiny_folder, tmp_path, monkeypatch):
    config = RunConfig(
        method=MethodChoice("closet", "static", SETTINGS | {"pose": False}),
        dataset="open",
        outfit=(tiny_folder.name,),
        data_root=tiny_folder.parents[1],
        runs_root=tmp_path,
        scan=ScanConfig(points=1000),
        train=quick_training(steps=1, points=200, scan_points=200),
    )
    runs = [train_run(replace(config, name=name)) for name in ("first", "second")]
    predict(PredictConfig(run=runs[0], points=1000))
    monkeypatch.setattr(scores, "score_predictions", lambda *_: pytest.fail("a run was scored"))
    with pytest.raises(DataError, match=r"second.*no such folder of predictions"):
        evaluate(EvaluateConfig(runs=tuple(runs), score=ScoreConfig(scan_points=500), floors=False))


def test_nobody_wears_clothes_who_is_not_there(tmp_path):
    with pytest.raises(AvatarError, match=r"shapes: .*tall\.npz: expected a file of tools/make_body\.py"):
        SimulateConfig(shapes=["female", str(tmp_path / "tall.npz")])
