"""A method of a kind that the package does not have, in one class: trained, resumed, predicted, scored by the verbs."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from tiny import quick_training
from torch import Tensor, nn

from avatar.config import compose_settings
from avatar.data.batches import FrameDataset, name_frames
from avatar.data.scanner import ScanConfig
from avatar.data.splits import SplitConfig, split_outfit
from avatar.evaluation.scoring import ScoreConfig
from avatar.geometry.neighbours import correspond, point_to_point
from avatar.geometry.sparse import gather_rows
from avatar.geometry.surface import vertex_normals
from avatar.geometry.transforms import transform_directions
from avatar.implicit.avatar import sample_mesh
from avatar.io.meshes import read_mesh
from avatar.io.points import read_points
from avatar.methods.base import Method, Stage, Task
from avatar.methods.registry import METHODS
from avatar.methods.settings import MethodChoice, RunConfig
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, predict
from avatar.pipeline.surfaces import MeshConfig, mesh
from avatar.records import LossTerms, Mesh, Surface
from avatar.runs.training import load_avatar
from avatar.runs.training import train as train_run
from avatar.training.logs import read_log


@dataclass
class RegressionConfig:
    """Settings of the mesh regression."""

    scale: float = 0.1  # metres one unit of a weight stands for


class Regression(nn.Module):
    """Displacements along the body's normals, linear in the joints' rotations; the surface is the displaced body."""

    def __init__(self, template, scale: float):
        super().__init__()
        self.scale = scale
        self.register_buffer("faces", template.faces, persistent=False)
        self.register_buffer("normals", vertex_normals(template.vertices, template.faces), persistent=False)
        self.linear = nn.Linear(9 * len(template.parents), len(template.vertices))
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)

    def forward(self, joints: Tensor, transforms: Tensor, vertices: Tensor) -> Tensor:
        local = (joints[:, :1, :3, :3].transpose(-1, -2) @ joints[..., :3, :3]).flatten(1)
        displacements = self.scale * self.linear(local)[..., None] * self.normals
        return vertices + transform_directions(transforms, displacements)


class RegressionTask(Task):
    terms = ("distance",)
    criterion = "distance"

    def __init__(self, model: Regression, data: FrameDataset, checks: FrameDataset, config):
        self.model, self.data, self.checks = model, data, checks
        self.frames, self.batch = len(data), config.batch
        self.groups = (list(model.parameters()),)
        self.stages = (Stage(1.0, (config.lr,), config.rate_factor),)

    def inputs_at(self, step: int):
        return (self.data.batch_at(step, self.batch),)

    def held_back(self) -> Iterator:
        return ((batch,) for batch in self.checks.ordered_batches(self.batch))

    def loss(self, inputs, position) -> LossTerms:
        (batch,) = inputs
        points = self.model(batch.joint_transforms, batch.vertex_transforms, batch.vertices)
        near = gather_rows(points, correspond(points.detach(), batch.scan_points).point_of_scan)
        distance = point_to_point(batch.scan_points, near).mean()
        return LossTerms({"distance": distance}, {"distance": 1e4 * distance})


class MeshRegression(Method):
    name = "mesh_regression"
    Settings = RegressionConfig
    makes_meshes = True
    sources = ()  # outside the package

    def prepare(self, run, settings, template):
        (outfit,) = run.outfits()
        split = split_outfit(outfit, run.split)
        data, checks = (
            FrameDataset([outfit], name_frames([outfit], "train", [names]), run.train.scan_points, run.train.seed)
            for names in (split.train, split.validation)
        )
        return RegressionTask(self.untrained(settings, template), data, checks, run.train)

    def untrained(self, settings, template):
        return Regression(template, settings.scale)

    def rebuild(self, settings, template, outfits, facts, weights):
        return self.untrained(settings, template)

    def predictor(self, avatar, outfit, points, surface):
        avatar.outfit_index(outfit)

        def dress(body) -> Surface:
            arrays = (body.joint_transforms, body.vertex_transforms, body.vertices)
            with torch.no_grad():
                vertices = avatar.model(*(torch.as_tensor(array, dtype=torch.float32)[None] for array in arrays))[0]
            mesh = Mesh(vertices.numpy(), avatar.model.faces.numpy())
            return Surface(sample_mesh(mesh, points), mesh, constant=True)

        return dress


@pytest.fixture
def run(tiny_folder, tmp_path, monkeypatch) -> RunConfig:
    monkeypatch.setitem(METHODS, MeshRegression.name, MeshRegression())
    return RunConfig(
        method=MethodChoice("mesh_regression", "mesh_regression"),
        dataset=tiny_folder.parent.name,
        outfit=(tiny_folder.name,),
        data_root=tiny_folder.parents[1],
        runs_root=tmp_path / "runs",
        scan=ScanConfig(points=2000),
        split=SplitConfig(validation_share=0.2),
        train=quick_training(steps=12, scan_points=1000, validate_every=6, save_every=6, log_every=1, lr=1e-3),
        device="cpu",
    )


def test_a_mesh_regression_is_trained_resumed_predicted_and_scored(run):
    folder = train_run(run)
    half = replace(run, name="half")
    train_run(replace(half, train=replace(run.train, steps=6)))
    whole = load_avatar(folder)
    assert whole.method.name == "mesh_regression" and whole.steps == 12
    assert load_avatar(train_run(half), "best").steps in (6, 12)
    (clouds,) = predict(PredictConfig(run=folder, points=1000))
    meshes = folder / "meshes" / "test" / run.outfit[0]
    faces = {read_mesh(path).faces.tobytes() for path in meshes.glob("*.ply")}
    assert len(list(clouds.glob("*.ply"))) == len(list(meshes.glob("*.ply"))) == 3 and len(faces) == 1
    names = tuple(sorted(path.stem for path in clouds.glob("*.ply")))
    first, again = (
        [(report.done, report.skipped) for report in mesh(MeshConfig(run=folder)).values()] for _ in range(2)
    )
    assert (first, again) == ([(names, ())], [((), names)])  # written in the other formats, once
    for path in (*meshes.glob("*.obj"), *meshes.glob("*.glb")):
        assert len(read_mesh(path).faces) == len(read_mesh(path.with_suffix(".ply")).faces)
    assert len(list(meshes.glob("*.obj"))) == len(list(meshes.glob("*.glb"))) == 3
    rows = evaluate(EvaluateConfig(runs=(folder,), score=ScoreConfig(metrics=("cd_point",), scan_points=2000))).rows
    assert {row.method for row in rows} >= {"mesh_regression", "body", "sampling"}
    first, *_, last = (float(row["distance"]) for row in read_log(folder / "metrics.csv") if row["split"] == "train")
    assert last < 0.9 * first
    assert np.isfinite(read_points(next(clouds.glob("*.ply"))).points).all()


def test_the_command_line_composes_it_without_a_file_in_conf(run, monkeypatch):
    monkeypatch.setattr("avatar.config.method_settings", lambda: {"mesh_regression": f"{__name__}:RegressionConfig"})
    settings = compose_settings("train", "method=mesh_regression", "size=full", "method.settings.scale=0.2")
    assert (settings.method.name, settings.method.variant) == ("mesh_regression", "mesh_regression")
    assert settings.method.settings == {"scale": 0.2} and settings.train.points == 50_000


def test_a_mesh_regression_resumes_to_the_bit(run):
    constant = replace(run.train, schedule=type(run.train.schedule)("constant"))
    whole = load_avatar(train_run(replace(run, name="whole", train=constant))).model.state_dict()
    train_run(replace(run, name="part", train=replace(constant, steps=6)))
    part = load_avatar(train_run(replace(run, name="part", train=constant))).model.state_dict()
    assert all(torch.equal(value, part[name]) for name, value in whole.items())
