"""The main job from data to report, on the tiny outfit and at the smallest size that still learns."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny import SETTINGS, quick_training

from avatar.canonical.canonicalizer import CanonicalizerConfig
from avatar.canonical.fields import SkinningFieldConfig
from avatar.canonical.scans import DrawConfig
from avatar.checks import AvatarError, DataError
from avatar.data.scanner import ScanConfig
from avatar.data.splits import split_outfit
from avatar.evaluation.scores import read_scores
from avatar.evaluation.scoring import ScoreConfig
from avatar.io.meshes import read_mesh
from avatar.io.motions import write_motion
from avatar.io.points import read_points
from avatar.methods.canonicalizer import CanonicalizeConfig, CycleConfig
from avatar.methods.settings import MethodChoice
from avatar.pipeline.experiments import DemoConfig, demo
from avatar.pipeline.reporting import CompareConfig, compare
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, predict
from avatar.pipeline.surfaces import ExportConfig, MeshConfig, export, mesh
from avatar.simulate.angles import authored_motion

pytestmark = pytest.mark.slow
METRICS = ["cd_point", "cd_pop", "normal_l1", "penetration_share"]


@pytest.fixture(scope="module")
def job(tiny_folder, tmp_path_factory) -> tuple[DemoConfig, dict]:
    """The settings of a finished main job and its summary."""
    train = quick_training(steps=120, points=2000, scan_points=2000, validate_every=60)
    config = DemoConfig(
        method=MethodChoice("closet", "closet", SETTINGS),
        dataset=tiny_folder.parent.name,
        outfit=(tiny_folder.name,),
        data_root=tiny_folder.parents[1],
        runs_root=tmp_path_factory.mktemp("runs"),
        canonicalizer=CanonicalizeConfig(
            scan=ScanConfig(points=2000),
            canonicalizer=CanonicalizerConfig(SkinningFieldConfig(width=16), SkinningFieldConfig(width=16, latent=4)),
            train=CycleConfig(first_steps=5, second_steps=5, batch=2, draw=DrawConfig(pool=500), code_steps=2),
            pictures=1,
        ),
        train=train,
        points=12_000,
        meshes=2,
        score=ScoreConfig(scan_points=4000, metrics=METRICS),
        static_share=1.0,
    )
    return config, json.loads(demo(config).read_text())


def test_summary_names_every_stage_and_file(job):
    config, summary = job
    stages = {"canonicalize", "train", "train static floor", "predict", "evaluate", "mesh", "report", "total"}
    assert set(summary["seconds"]) == stages
    made = summary["made"]
    assert all(Path(path).exists() for path in (made["report"], made["weights"], *made["points"], *made["meshes"]))
    (scans,) = (Path(path) for path in made["canonical scans"])
    assert scans.is_relative_to(config.runs_root) and len(list((scans / "train").glob("*.npz"))) == 6
    assert Path(made["report"]).is_relative_to(config.runs_root)


def test_every_test_frame_is_predicted_scored_and_some_are_meshed(job, tiny_outfit):
    config, summary = job
    folder = config.folder / "predictions" / "test" / "tiny"
    clouds = {path.stem: read_points(path) for path in folder.glob("*.ply")}
    assert set(clouds) == set(tiny_outfit.frames("test"))
    assert all(len(cloud.points) == 12_000 for cloud in clouds.values())
    meshes = [read_mesh(path) for path in (config.folder / "meshes" / "test" / "tiny").glob("[!.]*")]
    assert len(meshes) == 2 * 3
    assert all(1.2 < np.ptp(found.vertices[:, 1]) < 2 for found in meshes)
    rows = {(row["method"], row["metric"]): row["value"] for row in summary["metrics"]}
    assert {method for method, _ in rows} == {"sampling", "body", "static", "closet"}
    cd = {method: rows[method, "cd_point"] for method in ("sampling", "body", "static", "closet")}
    assert min(cd, key=cd.get) == "sampling"
    assert cd["closet"] < cd["body"]
    assert len(read_scores(config.folder / "scores.csv").frames) == len(METRICS) * len(clouds)


def test_report_opens_in_a_browser_with_its_pictures(job, browser):
    _, summary = job
    page, complaints, requests = browser.new_page(), [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(Path(summary["made"]["report"]).as_uri(), wait_until="load")
    assert complaints == []
    assert [url for url in requests if not url.startswith(("data:", "file:"))] == []
    images = page.locator("img")
    poses = 3  # each with ground truth, prediction, template and error; two with a mesh; one template at rest
    assert images.count() == 4 * poses + 2 + 1
    for index in range(images.count()):
        spread = images.nth(index).evaluate(
            "async image => { await image.decode(); const c = document.createElement('canvas');"
            "c.width = image.naturalWidth; c.height = image.naturalHeight; const g = c.getContext('2d');"
            "g.drawImage(image, 0, 0); const d = g.getImageData(0, 0, c.width, c.height).data;"
            "return new Set(d).size; }"
        )
        assert spread > 20  # many grey levels: not blank
    page.close()
    sheet = np.asarray(Image.open(Path(summary["made"]["report"]).with_name("pictures.png")))
    assert sheet.shape[1] > 4 * 600 and sheet.std() > 10


def test_going_on_with_a_finished_job_repeats_nothing(job):
    config, summary = job
    weights = (config.folder / "avatar.safetensors").read_bytes()
    again = json.loads(demo(config).read_text())
    assert (config.folder / "avatar.safetensors").read_bytes() == weights
    assert {**again, "seconds": None} == {**summary, "seconds": None}


def test_a_motion_becomes_points_meshes_and_animation_files(job, tmp_path):
    config, _ = job
    motion = tmp_path / "stroll.npz"
    write_motion(motion, authored_motion("walk", fps=5, seconds=0.6))
    (folder,) = predict(PredictConfig(run=config.folder, motion=motion, fps=5, points=4000))
    frames = sorted(folder.glob("*.ply"))
    assert len(frames) >= 3
    mesh(MeshConfig(run=config.folder, predictions=folder.parent.name, formats=("ply",), frames=2))
    made = export(ExportConfig(run=config.folder, predictions=folder.parent.name, motion=motion))
    assert {path.name for path in made} == {"points.usdc", "meshes.usdc", "preview.webp", "frames.png", "body.glb"}
    assert all(path.stat().st_size > 1000 for path in made)


def test_foreign_predictions_are_scored_from_their_folder(job, capsys):
    config, _ = job
    folder = config.folder / "predictions" / "test" / "tiny"
    settings = EvaluateConfig(
        predictions=folder,
        label="theirs",
        dataset=config.dataset,
        outfit="tiny",
        data_root=config.data_root,
        score=config.score,
        out=config.runs_root / "theirs",
        floors=False,
    )
    scores = evaluate(settings)
    assert {row.method for row in scores.rows} == {"theirs"}
    assert "theirs" in capsys.readouterr().out
    with pytest.raises(DataError, match=r"no such folder.*tools/predict\.py"):
        evaluate(replace(settings, predictions=folder / "none"))


def test_runs_are_compared_in_one_table_with_their_floors(job, tmp_path):
    config, summary = job
    settings = CompareConfig(
        table="tiny",
        runs_root=config.runs_root,
        dataset=(config.dataset, "elsewhere"),
        metrics=("cd_point",),
        out=tmp_path,
    )
    text = compare(settings).read_text()
    assert "excess" in text and all(method in text for method in ("sampling", "body", "static", "closet"))
    rows = {(row.method, row.metric): row.value for row in read_scores(tmp_path / "tiny.csv").rows}
    assert rows == {(row["method"], row["metric"]): row["value"] for row in summary["metrics"]}
    with pytest.raises(AvatarError, match=r"no scores below.*tools/evaluate\.py"):
        compare(replace(settings, runs_root=tmp_path))


def test_frames_held_back_are_a_split_that_is_predicted_scored_and_compared(job, tiny_outfit, tmp_path):
    config, _ = job
    held = split_outfit(tiny_outfit, config.split).validation
    (folder,) = predict(PredictConfig(run=config.folder, split="validation", points=2000))
    assert folder.parent.name == "validation" and {path.stem for path in folder.glob("*.ply")} == set(held)
    before = (config.folder / "scores.csv").read_bytes()
    scores = evaluate(EvaluateConfig(runs=(config.folder,), split="validation", score=config.score, floors=False))
    assert {row.frame for row in scores.frames} == set(held) and {row.split for row in scores.rows} == {"validation"}
    assert (config.folder / "scores.csv").read_bytes() == before
    settings = CompareConfig(table="both", runs=(config.folder,), runs_root=config.runs_root, metrics=("cd_point",))
    settings = replace(settings, splits=("test", "validation"), pictures=0, plots=False, out=tmp_path)
    text = compare(settings).read_text()
    assert "test: cd_point" in text and "validation: cd_point" in text


def test_what_was_not_made_yet_is_named(job):
    config, _ = job
    with pytest.raises(DataError, match=r"no predictions here.*tools/predict\.py"):
        mesh(MeshConfig(run=config.folder, predictions="dance"))
    with pytest.raises(DataError, match=r"no predictions here.*tools/predict\.py"):
        export(ExportConfig(run=config.folder, predictions="dance"))
    with pytest.raises(AvatarError, match="split: expected train, test or interpolation"):
        predict(PredictConfig(run=config.folder, split="tests"))
