"""Experiments: jobs make rows, rows make a table; what is finished is not done again, what fails stops nothing."""

import itertools
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny import SETTINGS, quick_training

from avatar.checks import AvatarError
from avatar.data.scanner import ScanConfig
from avatar.data.splits import SplitConfig
from avatar.evaluation import scoring
from avatar.evaluation.scores import read_scores
from avatar.evaluation.scoring import ScoreConfig
from avatar.evaluation.tables import Axis, FormConfig, ReportedTable
from avatar.implicit.extraction import ExtractionConfig
from avatar.methods.canonicalizer import CanonicalizeConfig, WeightSource
from avatar.methods.settings import MethodChoice
from avatar.pipeline.experiments import (
    ExperimentConfig,
    canonicalizers_of,
    charged,
    counted,
    experiment,
    front_end_seconds,
    tabulate_experiment,
)
from avatar.pipeline.reporting import CompareConfig, compare
from avatar.pipeline.scores import label_of
from avatar.runs.training import load_avatar

ROOT = Path(__file__).parents[2]
METRICS = ("cd_point", "normal_l1")
IMPLICIT = {"avatar": {"sdf": {"widths": [24, 24, 24], "skip": 1, "orders": 4}, "gate_spacing": 0.1}}
IMPLICIT["train"] = {"queries": {"near_points": 100, "box_points": 50, "boundary_points": 30}, "decay_at": []}


@pytest.fixture(scope="module")
def first(tiny_folder, tmp_path_factory) -> ExperimentConfig:
    """The settings of an experiment's first job, CloSET's static floor on the tiny outfit."""
    folder = tmp_path_factory.mktemp("experiment")
    form = FormConfig(rows=(Axis.metric,), columns=(Axis.method,))
    return ExperimentConfig(
        method=MethodChoice("closet", "static", SETTINGS | {"pose": False}),
        dataset=tiny_folder.parent.name,
        outfit=(tiny_folder.name,),
        name="small",
        data_root=tiny_folder.parents[1],
        runs_root=folder / "runs",
        train=quick_training(steps=4, points=500, scan_points=500, validate_every=2),
        points=1000,
        score=ScoreConfig(scan_points=1000, metrics=list(METRICS)),
        compare=CompareConfig(
            table="small",
            metrics=METRICS,
            form=form,
            baseline="static",
            reported=ReportedTable("a paper, table 9", ("POP",), {"CD": (7.34,)}),
            pictures=2,
        ),
    )


@pytest.fixture(scope="module")
def jobs(first) -> list[ExperimentConfig]:
    """Three finished jobs: the floor, CloSET, and CloSET from half of the frames."""
    closet = replace(first, method=MethodChoice("closet", "closet", SETTINGS))
    found = [first, closet, replace(closet, split=SplitConfig(train_fraction=0.5))]
    for job in found:
        experiment(job)
    return found


def test_a_job_leaves_predictions_and_scores_with_what_tells_it_apart(jobs):
    half = jobs[2].run.folder
    assert half.name == "small_4steps_0.5_seed0"
    assert len(list((half / "predictions" / "test" / "tiny").glob("*.ply"))) == 3
    rows = read_scores(half / "scores.csv").rows
    assert {row.metric for row in rows} == set(METRICS)
    assert {(row.method, row.variant, row.fraction, row.steps, row.dataset) for row in rows} == {
        ("closet", "50%", 0.5, 4, "open")
    }


def test_what_is_finished_is_not_done_again_and_what_changed_is(jobs, monkeypatch, change_source):
    run, read, real = jobs[1].run.folder, [], scoring.read_points
    monkeypatch.setattr(scoring, "read_points", lambda path: read.append(path.name) or real(path))
    (run / "scored.txt").write_text("of an older version: not believed")

    def again(job: ExperimentConfig) -> int:
        """How many predictions the job scores."""
        read.clear()
        experiment(job)
        return len(read)

    cloud = run / "predictions" / "test" / "tiny" / "check.00000.ply"
    before = {path: path.read_bytes() for path in (cloud, run / "avatar.safetensors", run / "scores.csv")}
    cloud.unlink()
    assert again(jobs[1]) == 0
    assert before == {path: path.read_bytes() for path in before}
    other = replace(jobs[1], score=replace(jobs[1].score, seed=5))
    assert again(other) == 3 and (run / "scores.csv").read_bytes() != before[run / "scores.csv"]
    assert again(jobs[1]) == 0
    change_source("avatar.geometry.closest")
    assert again(jobs[1]) == 3 and again(jobs[1]) == 0
    assert before == {path: path.read_bytes() for path in before}


def test_the_table_has_every_form(jobs):
    out = jobs[0].runs_root / "tables"
    text = tabulate_experiment(jobs).read_text()
    assert "| metric | sampling | body | static | closet | closet (50%) |" in text
    assert "Equal steps: 4 each." in text and "Reported: a paper, table 9" in text and "excess over the" in text
    made = {path.name.removeprefix("small.") for path in out.iterdir()}
    pictures = {f"{name}.png" for name in ("outfits", "times", "fractions", "progress")} | {"poses.jpg"}
    assert made == {"csv", "frames.csv", "md", "tex", "differences.csv"} | pictures
    tex = (out / "small.tex").read_text()
    assert tex.count("\\begin{tabular}") == tex.count("\\end{tabular}") == text.count("\n|---")
    assert "closet (50\\%)" in tex
    rows = read_scores(out / "small.csv").rows
    assert {row.table for row in rows} == {"small"}
    expected = sum(len(read_scores(job.run.folder / "scores.csv").rows) for job in jobs)
    assert len([row for row in rows if row.method in ("static", "closet")]) == expected
    sheet = np.asarray(Image.open(out / "small.poses.jpg"))
    assert 2 * 600 < sheet.shape[0] < 3 * 600 and 4 * 400 < sheet.shape[1] < 5 * 400  # two poses, three methods, truth


def test_budgets_have_a_table_each_and_one_file_of_scores(jobs, tmp_path):
    longer = replace(jobs[1], train=replace(jobs[1].train, steps=5), compare=replace(jobs[1].compare, out=tmp_path))
    other = replace(longer, train=replace(longer.train, seed=1), one_seed=("closet",))
    experiment(longer)
    assert experiment(other) == [] and not other.run.folder.exists()
    shorter = [replace(job, compare=longer.compare) for job in jobs[:2]]
    assert tabulate_experiment([*shorter, longer, other]) == tmp_path / "small.csv"
    assert "Equal steps: 4 each." in (tmp_path / "small_4steps.md").read_text()
    with pytest.raises(AvatarError, match="one_seed: expected a job of seed 0"):
        tabulate_experiment([other])
    with pytest.raises(AvatarError, match="one_seed: expected variants of conf/method, got clsoet"):
        replace(other, one_seed=("clsoet",))
    with pytest.raises(AvatarError, match=r"compare\.table: expected a plain name"):
        replace(other, compare=replace(other.compare, table="a" * 60))
    assert "Equal steps: 5 each." in (tmp_path / "small_5steps.md").read_text()
    rows = [row for row in read_scores(tmp_path / "small.csv").rows if row.method == "closet"]
    assert {(row.table, row.steps) for row in rows} == {("small_4steps", 4), ("small_5steps", 5)}


def test_scores_of_a_foreign_program_stand_in_the_same_table(jobs, tmp_path, tiny_folder):
    theirs = tmp_path / "theirs"
    shutil.copytree(jobs[1].run.folder / "predictions" / "test" / "tiny", theirs)
    scores = (jobs[1].run.folder / "scores.csv").read_text().replace(",closet,", ",theirs,")
    (theirs / "scores.csv").write_text(scores)
    config = replace(jobs[0].compare, runs=(jobs[0].run.folder, theirs), runs_root=jobs[0].runs_root, out=tmp_path)
    text = compare(replace(config, data_root=tiny_folder.parents[1], plots=False)).read_text()
    assert "| metric | sampling | body | static | theirs |" in text
    assert np.asarray(Image.open(tmp_path / "small.poses.jpg")).shape[1] > 3 * 400


def test_outfits_of_one_name_in_two_data_sets_are_refused(jobs, tmp_path):
    shutil.copytree(jobs[1].run.folder, tmp_path / "run")
    path = tmp_path / "run" / "scores.csv"
    path.write_text(path.read_text().replace(",open,", ",elsewhere,"))
    config = replace(jobs[0].compare, runs=(jobs[0].run.folder, tmp_path / "run"), out=tmp_path)
    with pytest.raises(AvatarError, match=r"outfit 'tiny' is in several data sets \(elsewhere, open\)"):
        compare(config)


def test_two_trainings_that_nothing_tells_apart_are_refused(jobs, tmp_path):
    shutil.copytree(jobs[1].run.folder, tmp_path / "run")
    config = replace(jobs[0].compare, runs=(jobs[1].run.folder, tmp_path / "run"), out=tmp_path, pictures=0)
    with pytest.raises(AvatarError, match="two scores of cd_point for closet on tiny, seed 0"):
        compare(config)


@pytest.mark.slow
def test_a_method_that_takes_a_canonicalizer_gets_it_made_and_scored(first, tiny_outfit, tmp_path):
    canonicalizer = CanonicalizeConfig(weights=WeightSource.knn, scan=ScanConfig(points=2000), scored=1)
    job = replace(
        first,
        method=MethodChoice("scanimate", "scanimate", IMPLICIT),
        canonical="knn",
        canonicalizer=canonicalizer,
        surface=ExtractionConfig(32),
        compare=replace(first.compare, baseline="", pictures=0, out=tmp_path),
    )
    run = experiment(job)
    scans = first.runs_root / "canonical" / "open" / "tiny" / "knn" / "scans"
    assert {path.stem for path in scans.glob("*/*.npz")} == {
        name for split in ("train", "test") for name in tiny_outfit.frames(split)
    }
    assert (run / "meshes" / "test" / "tiny").is_dir()
    text = tabulate_experiment([job]).read_text()
    assert "scanimate" in text and "All methods: knn." in text
    assert "**tiny: canonical scans of test frames**" in text and "| truth_cm (cm) |" in text
    counted = front_end_seconds(scans.parent)
    experiment(job)
    assert 0 < counted == front_end_seconds(scans.parent)  # what is not made again is not counted again
    timed, makers = replace(job, train=replace(job.train, minutes=15.0)), canonicalizers_of(job)
    assert charged(timed, makers).train.minutes == 15
    timed = replace(timed, front_end=True)
    assert charged(timed, makers).train.minutes == pytest.approx(15 - counted / 60)
    assert charged(timed, makers).spent == counted and charged(timed, []).spent == 0
    assert charged(timed, makers).folder == timed.run.folder and charged(timed, []).train.minutes == 15
    avatar = load_avatar(run)
    started = replace(avatar, config=replace(avatar.config, spent=60.0))
    assert label_of(started).seconds == label_of(avatar).seconds + 60  # what tables show
    with pytest.raises(AvatarError, match=r"train\.minutes: expected more than the front end took"):
        charged(replace(timed, train=replace(timed.train, minutes=counted / 60)), makers)


@pytest.mark.slow
def test_one_command_runs_all_jobs_names_the_failure_and_tables_the_rest(tiny_folder, tmp_path):
    for name in ("one", "two"):
        shutil.copytree(tiny_folder, tmp_path / "data" / "open" / name)
    for frame in (tmp_path / "data/open/two/train").glob("*.npz"):
        frame.write_bytes(frame.read_bytes()[:1000])
    options = "experiment=closet5 dataset=open outfit=one,two method=static train.steps=2 train.points=500 points=1000"
    options += " train.scan_points=500 train.batch=1 train.mirror=false score.scan_points=500 compare.baseline=static"
    options += " compare.metrics=[cd_point] compare.pictures=0 compare.plots=false"
    line = [sys.executable, str(ROOT / "tools/experiment.py"), *options.split()]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    published = {path: path.stat().st_mtime_ns for path in (ROOT / "docs").rglob("*")}
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 2, done.stderr
    assert "2 jobs: 1 finished, 1 failed." in done.stderr and "Traceback" not in done.stderr
    failed = [line for line in done.stderr.splitlines() if line.startswith("  failed: ")]
    assert len(failed) == 1 and "outfit=two" in failed[0] and ".npz" in failed[0]
    tables = tmp_path / "runs" / "tables"
    assert {row.method for row in read_scores(tables / "closet5.csv").rows} == {"sampling", "body", "static"}
    assert "Reported: CloSET, table 5" in (tables / "closet5.md").read_text()
    assert "written: runs/tables/closet5.*" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"data", "runs"}
    assert published == {path: path.stat().st_mtime_ns for path in published}  # not what this checkout publishes


def test_a_front_end_that_goes_on_counts_together_and_one_made_anew_counts_once(tmp_path):
    def work(seconds: float) -> None:
        started = time.process_time()
        while time.process_time() < started + seconds:
            pass

    def make(seconds: float, fail: bool = False) -> None:
        with counted(tmp_path, "template", "*.npz"):
            work(seconds)
            if fail:
                raise KeyboardInterrupt
            (tmp_path / "template.npz").write_bytes(b"")
            os.utime(tmp_path / "template.npz", (next(clock), next(clock)))

    clock = itertools.count(1)
    with pytest.raises(KeyboardInterrupt):
        make(0.4, fail=True)
    assert front_end_seconds(tmp_path) == pytest.approx(0.4, abs=0.11)
    make(0.4)
    assert front_end_seconds(tmp_path) == pytest.approx(0.8, abs=0.21)
    make(0.3)
    assert front_end_seconds(tmp_path) == pytest.approx(0.3, abs=0.11)
    with counted(tmp_path, "template", "*.npz"):
        work(0.2)  # nothing is made
    with pytest.raises(KeyboardInterrupt):
        make(0.2, fail=True)  # nothing either, and the part is there
    assert front_end_seconds(tmp_path) == pytest.approx(0.3, abs=0.11)
