"""Implicit runs on the tiny outfit: learning beats the static shape, runs resume bit for bit, errors are clear."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from avatar.canonical.fields import BodyField
from avatar.canonical.scans import canonicalize_scan
from avatar.checks import AvatarError, DataError
from avatar.data.batches import CanonicalFrames, canonical_frame
from avatar.data.splits import SplitConfig
from avatar.implicit.extraction import ExtractionConfig
from avatar.implicit.losses import QueryConfig
from avatar.io.checkpoints import load_checkpoint
from avatar.io.frames import read_canonical_scan, write_canonical_scan
from avatar.io.meshes import read_mesh
from avatar.io.points import read_points
from avatar.methods.canonicalizer import CanonicalizeConfig, WeightSource
from avatar.methods.scanimate import ImplicitTask, ImplicitTrainConfig
from avatar.methods.settings import MethodChoice, Precision, RunConfig, Schedule, TrainConfig
from avatar.records import Scan
from avatar.runs.canonicalizing import train_canonicalizer
from avatar.runs.prediction import predict_frames
from avatar.runs.training import load_avatar
from avatar.runs.training import train as train_run
from avatar.settings import settings_to_dict
from avatar.simulate.angles import authored_motion
from avatar.training.logs import read_log
from avatar.training.trainer import Trainer

SETTINGS = {
    "avatar": {
        "sdf": {"widths": [48, 48, 48], "skip": 1, "orders": 4},
        "texture": {"widths": [24, 24], "skip": 1, "orders": 4},
        "gate_spacing": 0.06,
    },
    "train": {
        "queries": {"near_points": 300, "box_points": 100, "boundary_points": 60, "near_distance": 0.05},
        "loss": {"surface": 10.0},
        "decay_at": [],
    },
}
COARSE = ExtractionConfig(64)


def with_avatar(**options) -> dict:
    return SETTINGS | {"avatar": SETTINGS["avatar"] | options}


@pytest.fixture(scope="module")
def settings(tiny_folder, tiny_outfit, tmp_path_factory) -> RunConfig:
    """A run's settings, with the canonical scans it needs: the tiny outfit's, carried by the nearest body weights.

    They are coloured by height, the upper half red.
    """
    runs = tmp_path_factory.mktemp("runs")
    where = {"dataset": tiny_folder.parent.name, "data_root": tiny_folder.parents[1], "runs_root": runs}
    folder = train_canonicalizer(CanonicalizeConfig(outfit=tiny_folder.name, weights=WeightSource.knn, **where))
    source = BodyField(tiny_outfit.template, 6)
    for name in tiny_outfit.frames("train"):
        frame = tiny_outfit.load("train", name)
        weights = source.weights_of(frame.scan.points, frame)
        scan = canonicalize_scan(frame.scan, frame.body, weights, tiny_outfit.template)
        upper = (scan.points[:, 1:2] > 0.3).astype(np.float32)
        colors = np.concatenate([upper, 1 - upper, np.zeros_like(upper)], axis=1)
        write_canonical_scan(folder / "scans" / "train" / f"{name}.npz", replace(scan, colors=colors))
    train = TrainConfig(
        steps=120, batch=2, scan_points=400, lr=8e-3, schedule=Schedule.cosine, validate_every=60, save_every=60
    )
    return RunConfig(
        method=MethodChoice("scanimate", "scanimate", with_avatar(colored=True)),
        outfit=(tiny_folder.name,),
        split=SplitConfig(validation_share=0.2),
        train=train,
        **where,
    )


@pytest.fixture(scope="module")
def trained(settings):
    return train_run(settings)


def test_training_learns_and_logs_every_term(settings, trained):
    rows = read_log(trained / "metrics.csv")
    train, held = ([row for row in rows if row["split"] == split] for split in ("train", "validation"))
    assert int(train[-1]["step"]) == 120 and len(held) == 2
    for name in ("surface", "normal", "color"):
        assert float(train[-1][name]) < 0.6 * float(train[0][name])
    assert float(held[-1]["surface"]) < 0.02
    assert float(train[-1]["lr"]) < 0.05 * settings.train.lr
    lowest = min(float(row["surface"]) for row in held)
    assert load_checkpoint(trained / "checkpoints", "best")["score"] == pytest.approx(lowest, rel=1e-4)


def test_predictions_lie_on_the_posed_scans(trained, tiny_outfit, tmp_path):
    avatar = load_avatar(trained)
    assert (avatar.steps, avatar.config.method.name) == (120, "scanimate") and not avatar.model.training
    names = tiny_outfit.frames("test")
    clouds = predict_frames(avatar, tiny_outfit, "test", tmp_path / "p", tmp_path / "m", 4000, COARSE)
    assert [path.stem for path in clouds] == list(names)
    for path in clouds:
        cloud, scan = read_points(path), tiny_outfit.load("test", path.stem).scan
        assert cloud.points.shape == (4000, 3)
        distances, ids = cKDTree(cloud.points).query(scan.points)
        assert distances.mean() < 0.03  # whole person, translation and all; a wrong pose is decimetres off
        assert np.einsum("mc,mc->m", cloud.normals[ids], scan.normals).mean() > 0.8
        mesh = read_mesh(tmp_path / "m" / path.name)
        red = mesh.colors[:, 0] > 0.5
        assert mesh.vertices[red, 1].mean() > mesh.vertices[~red, 1].mean() + 0.3
    again = predict_frames(load_avatar(trained), tiny_outfit, "test", tmp_path / "q", tmp_path / "n", 4000, COARSE)
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in clouds]


def test_a_motion_is_predicted_frame_by_frame(trained, tiny_outfit, tmp_path):
    motion = authored_motion("walk", fps=4, seconds=0.5)
    posed = predict_frames(
        load_avatar(trained), tiny_outfit, motion, tmp_path / "p", tmp_path / "m", 1000, ExtractionConfig(32)
    )
    assert len(posed) == len(motion.poses) and posed[0].name == "walk.00000.ply"
    assert np.ptp(read_points(posed[0]).points[:, 1]) > 1.2


def test_a_stopped_run_goes_on_to_the_same_bits(settings, tmp_path):
    short = replace(settings, train=replace(settings.train, steps=4, save_every=2, validate_every=3, schedule="x"))
    short = replace(short, train=replace(short.train, schedule=Schedule.constant, mirror=True))
    through = load_avatar(train_run(replace(short, name="through")))
    train_run(replace(short, name="halves", train=replace(short.train, steps=2)))
    halves = load_avatar(train_run(replace(short, name="halves")))
    for name, value in through.model.state_dict().items():
        assert torch.equal(value, halves.model.state_dict()[name]), name
    assert halves.steps == 4
    assert load_avatar(replace(short, name="through").folder, "best").steps in (3, 4)


def test_every_kind_of_pose_input_trains_and_comes_back(settings):
    budget = replace(settings.train, steps=2, validate_every=2)
    for kind in ("global", "none"):
        choice = MethodChoice("scanimate", f"scanimate_{kind}", with_avatar(pose=kind))
        avatar = load_avatar(train_run(replace(settings, method=choice, train=budget)))
        assert avatar.model.config.pose.value == kind


@pytest.fixture
def make_trainer(trained, tiny_outfit, tmp_path, frames):
    """Trainers of copies of the trained avatar, with options of training and settings of the implicit loop."""

    def make(settings: ImplicitTrainConfig | None = None, **options) -> Trainer:
        avatar = load_avatar(trained)
        train = replace(avatar.config.train, schedule=Schedule.constant, **options)
        queries = QueryConfig(near_points=60, box_points=20, boundary_points=20)
        settings = replace(settings or ImplicitTrainConfig(), queries=queries)
        data = CanonicalFrames(frames, 50, seed=3)
        task = ImplicitTask(avatar.model, tiny_outfit.template.vertices, train, settings, data)
        return Trainer(task, train, tmp_path)

    return make


def test_rates_warm_up_and_decay(make_trainer):
    trainer, factors = make_trainer(ImplicitTrainConfig(), steps=8, warmup=2), []
    for trainer.step in range(8):
        factors.append(trainer.task.stages[0].factor(trainer.step, trainer.position().progress))
    assert factors == pytest.approx([0.5, 1, 1, 1, 0.1, 0.1, 0.01, 0.01])  # at half and three quarters, as the paper's
    task = make_trainer(ImplicitTrainConfig(decay_at=()), steps=8).task
    task.config.schedule = Schedule.cosine
    assert task.rate_factor(4, 0.5) == pytest.approx(0.505)


def test_clipping_shortens_the_gradient_before_the_step(make_trainer):
    norms, moved = [], []
    for clip in (None, 1e-9):
        trainer = make_trainer(clip=clip, lr=1e-3, steps=8)
        (learned,) = trainer.task.groups
        before = [value.detach().clone() for value in learned]
        norms.append(float(trainer.train_step(trainer.task.inputs_at(0))[2]))
        moved.append(max(float((a.detach() - b).abs().max()) for a, b in zip(learned, before)))
    assert norms[0] == norms[1] > 1e-3  # logged unclipped
    assert moved[0] == pytest.approx(1e-3, rel=1e-2) and moved[1] < 1e-4  # Adam's first step is as long as the rate
    gradients = torch.cat([value.grad.flatten() for value in learned if value.grad is not None])
    assert float(gradients.norm()) == pytest.approx(1e-9, rel=1e-2)


def test_validation_is_a_mean_over_frames_at_the_same_points_in_any_mode(make_trainer, frames):
    trainer = make_trainer(steps=8)

    def validate(chosen) -> dict[str, float]:
        trainer.task.checks = CanonicalFrames(chosen, 50, seed=3)
        return trainer.validate()

    single = [validate(frames[row : row + 1]) for row in range(3)]
    values = validate(frames[:3])
    for name, value in values.items():
        assert value == pytest.approx(np.mean([frame[name] for frame in single]), rel=1e-5), name
    trainer.step = 5
    trainer.model.train()
    assert trainer.validate() == values
    task, position = trainer.task, trainer.position()
    batch = task.data.batch_at(0, 2)
    losses = [float(task.loss((batch, task.space_at(batch, key)), position).total.detach()) for key in (0, 0, 1)]
    assert losses[0] == losses[1] != losses[2]  # points in space follow from the step


@pytest.fixture
def frames(settings, tiny_outfit):
    folder = settings.runs_root / "canonical" / settings.dataset / settings.outfit[0] / "default" / "scans" / "train"
    made = []
    for name in tiny_outfit.frames("train"):
        stored = read_canonical_scan(folder / f"{name}.npz")
        frame = tiny_outfit.load("train", name)
        made.append(canonical_frame(replace(frame, scan=Scan(stored.points, stored.normals, colors=stored.colors))))
    return made


def test_batches_depend_on_nothing_but_the_step(frames):
    one, two = (CanonicalFrames(frames, 100, seed=3) for _ in range(2))
    two.batch_at(0, 4)
    assert torch.equal(one.batch_at(7, 2).points, two.batch_at(7, 2).points)
    seen = [name for step in range(3) for name in one.batch_at(step, 2).names]
    assert sorted(seen) == sorted(frame.name for frame in frames)  # an epoch is every frame once
    assert not torch.equal(one.item(0, "1").points, one.item(0, "2").points)
    epochs = {tuple(one.batch_at(step, len(frames)).names) for step in range(4)}
    assert len(epochs) > 1 and {tuple(sorted(epoch)) for epoch in epochs} == {tuple(sorted(seen))}
    batch, named = one.batch_at(7, 2), {frame.name: frame for frame in frames}
    for row, frame in enumerate(named[name] for name in batch.names):
        places = cKDTree(frame.points).query(batch.points[row])[1]
        torch.testing.assert_close(batch.normals[row], frame.normals[places])
        torch.testing.assert_close(batch.colors[row], frame.colors[places])
        assert torch.equal(batch.joint_transforms[row], frame.joint_transforms)
    assert torch.equal(one.ordered()[0].points, one.ordered()[0].points)


def test_mirrored_frames_are_the_mirror_image_of_scan_and_pose(frames, tiny_outfit):
    from avatar.data.batches import ACROSS, mirror_coins, mirror_map

    symmetry = mirror_map(tiny_outfit.template)
    plain, mirrored = CanonicalFrames(frames, 50, 0), CanonicalFrames(frames, 50, 0, symmetry)
    chosen = mirror_coins(0, 5, 4)
    assert chosen.any() and not chosen.all()
    before, after = plain.batch_at(5, 4), mirrored.batch_at(5, 4)
    left = tiny_outfit.template.joint_names.index("left_wrist")
    right = tiny_outfit.template.joint_names.index("right_wrist")
    for row, turned in enumerate(chosen):
        if not turned:
            assert torch.equal(before.points[row], after.points[row])
            continue
        torch.testing.assert_close(after.points[row], before.points[row] * torch.tensor([-1.0, 1, 1]))
        torch.testing.assert_close(after.normals[row], before.normals[row] * torch.tensor([-1.0, 1, 1]))
        expected = ACROSS @ before.joint_transforms[row, right] @ ACROSS
        torch.testing.assert_close(after.joint_transforms[row, left], expected)


def test_a_mesh_is_spread_into_points_by_area(frames, tiny_outfit):
    corners = np.array([[0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]], np.float32)
    scan = Scan(
        corners, np.tile([[0.0, 0, 1]], (6, 1)).astype(np.float32), np.array([[0, 1, 2], [3, 4, 5]]), colors=corners / 4
    )
    frame = canonical_frame(replace(tiny_outfit.load("train", tiny_outfit.frames("train")[0]), scan=scan))
    assert (frame.points[:, 2] < 0.5).float().mean() == pytest.approx(4 / 4.005, abs=1e-3)
    torch.testing.assert_close(frame.colors, frame.points / 4)


def test_half_precision_is_refused_for_a_field_that_trains_in_float32():
    with pytest.raises(AvatarError, match=r"train.precision: expected fp32 for scanimate, got bf16"):
        train_run(RunConfig(method=MethodChoice("scanimate"), train=TrainConfig(precision=Precision.bf16)))


def test_what_is_wrong_is_refused_with_what_to_do(settings, trained, tmp_path):
    with pytest.raises(DataError, match=r"tools/canonicalize\.py.*name=other"):
        train_run(replace(settings, name="x", canonical="other"))
    with pytest.raises(AvatarError, match="one outfit at a time"):
        train_run(replace(settings, outfit=("tiny", "tee")))
    with pytest.raises(AvatarError, match=r"method\.settings\.avatr: no such option"):
        train_run(replace(settings, method=MethodChoice("scanimate", "scanimate", {"avatr": {}})))
    with pytest.raises(AvatarError, match=r"train\.lr.*another name"):
        train_run(replace(settings, train=replace(settings.train, lr=1.0)))
    with pytest.raises(DataError, match="no such file"):
        load_avatar(tmp_path)
    plain = settings_to_dict(settings)
    assert plain["method"]["name"] == "scanimate"


def test_frames_without_colours_are_refused_where_colours_are_learned(settings, tmp_path):
    source = settings.runs_root / "canonical" / settings.dataset / settings.outfit[0]
    for path in (source / "default").rglob("*"):
        if path.is_file():
            target = source / "plain" / path.relative_to(source / "default")
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(path.read_bytes())
    scans = sorted((source / "plain" / "scans" / "train").glob("*.npz"))
    write_canonical_scan(scans[0], replace(read_canonical_scan(scans[0]), colors=None))
    with pytest.raises(DataError, match=r"no colours.*colored=false"):
        train_run(replace(settings, name="y", canonical="plain"))
    scans[0].unlink()
    with pytest.raises(DataError, match=r"no canonical scan.*tools/canonicalize\.py"):
        train_run(replace(settings, name="y", canonical="plain"))


def test_a_loss_that_stays_undefined_stops_training_and_saves_nothing_bad(settings):
    wild = replace(settings, name="wild", train=replace(settings.train, lr=1e30, steps=60, save_every=60))
    with pytest.raises(AvatarError, match=r"not finite for 11 steps.*frames rise"):
        train_run(wild)
    assert not list((wild.folder / "checkpoints").glob("*.pt"))
