"""Canonicalizers as runs: they learn, resume to the bit, come back from disk, canonicalize seen and unseen frames."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from limbs import arm_frame, arm_template, legs_template, skirt_frame

import avatar.methods.canonicalizer as cycles
from avatar.body.packed import read_template
from avatar.body.skinning import skin_transforms
from avatar.canonical.canonicalizer import TERMS, Canonicalizer, CanonicalizerConfig, Latent, cycle_loss
from avatar.canonical.fields import SkinningFieldConfig
from avatar.canonical.scans import DrawConfig, prepare_scan, to_root_frame
from avatar.checks import AvatarError, DataError
from avatar.data.batches import FrameDataset
from avatar.data.scanner import ScanConfig
from avatar.evaluation.canonical import CANONICAL_METRICS
from avatar.evaluation.scores import read_scores
from avatar.geometry import neighbours
from avatar.geometry.transforms import transform_points
from avatar.io.frames import read_canonical_scan
from avatar.io.meshes import read_mesh
from avatar.io.points import read_points
from avatar.methods.canonicalizer import (
    CanonicalizeConfig,
    CanonicalizerTask,
    CycleConfig,
    WeightSource,
    fit_latent,
    load_canonicalizer,
)
from avatar.pipeline.canonicalization import canonicalize, canonicalizer_with, score_canonical_scans, weight_colors
from avatar.runs.canonicalizing import canonicalize_frames, skinning_source, train_canonicalizer
from avatar.training.logs import read_log
from avatar.training.trainer import Trainer

TEMPLATE = arm_template()
NETS = CanonicalizerConfig(SkinningFieldConfig(width=32, orders=4), SkinningFieldConfig(width=32, orders=4, latent=4))
BENDS = (0.0, 0.5, 1.0, 1.5)
SCANS = [prepare_scan(arm_frame(bend), TEMPLATE, 2000) for bend in BENDS]
DRAW = DrawConfig(scan=64, body=64, edges=16, pool=2000)


def make_trainer(folder, scans=SCANS, nets=NETS, **options) -> Trainer:
    torch.manual_seed(3)
    defaults = {"first_steps": 6, "second_steps": 6, "batch": 2, "draw": DRAW, "log_every": 1, "save_every": 2}
    model = Canonicalizer(TEMPLATE, len(scans), nets)
    names = [f"bend.{i:05d}" for i in range(len(scans))]
    config = CycleConfig(**(defaults | options))
    return Trainer(CanonicalizerTask(model, TEMPLATE, scans, names, config), config, folder)


@pytest.mark.parametrize("stop", [3, 6, 7, 10], ids=["first stage", "between", "second stage", "late"])
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(tmp_path, monkeypatch, stop):
    whole = make_trainer(tmp_path / "whole")
    whole.fit()

    parts = make_trainer(tmp_path / "parts")
    draw = parts.task.inputs_at
    monkeypatch.setattr(parts.task, "inputs_at", lambda step: draw(step) if step < stop else 1 / 0)
    with pytest.raises(ZeroDivisionError):
        parts.fit()
    again = make_trainer(tmp_path / "parts")
    torch.rand(5)  # the random state on entry must not matter
    again.fit()
    assert again.step == 12
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, again.model.state_dict()[name]), name


def test_the_tree_over_the_body_at_rest_is_built_once(tmp_path, monkeypatch):
    built = []
    build = neighbours.build_tree
    monkeypatch.setattr(neighbours, "build_tree", lambda cloud: built.append(len(cloud)) or build(cloud))
    trainer = make_trainer(tmp_path)
    trainer.fit()
    assert built == [len(TEMPLATE.vertices)]
    fit_latent(trainer.model, TEMPLATE, SCANS[0], trainer.model.codes[0], replace(trainer.task.config, code_steps=5))
    assert len(built) == 2


def test_log_names_every_term_and_the_cycle_only_where_it_is_learned(tmp_path):
    make_trainer(tmp_path).fit()
    rows = read_log(tmp_path / "metrics.csv")
    assert [int(row["step"]) for row in rows] == list(range(1, 13))
    for row in rows:
        present = {term for term in TERMS if row[term]}
        assert present == (set(TERMS) if int(row["step"]) > 6 else {"body", "nearest", "sparsity", "latent"})
        assert all(math.isfinite(float(row[term])) for term in (*present, "loss", "grad_norm"))
    rates = [float(row["lr"]) for row in rows]
    assert rates == pytest.approx([4e-3] * 3 + [4e-4] * 2 + [4e-5] + [1e-3] * 3 + [1e-4] * 2 + [1e-5])


def test_a_clock_ends_training_and_stages_keep_their_shares(tmp_path):
    trainer = make_trainer(tmp_path, first_steps=300_000, second_steps=100_000, minutes=0.01, save_every=10**6)
    trainer.fit()
    assert 1 <= trainer.step < 400_000 and trainer.seconds >= 0.6 and trainer.stage == 1
    trainer.step, trainer.seconds = 1, 0.3
    assert trainer.position().stage == 0 and trainer.position().progress == pytest.approx(2 / 3)


def test_each_stage_has_an_optimiser_of_its_own(tmp_path):
    trainer = make_trainer(tmp_path)
    counts = []
    for trainer.step in range(8):
        trainer.train_step(trainer.task.inputs_at(trainer.step))
        counts.append(int(trainer.optimiser.state[trainer.model.codes]["step"]))
    assert counts == [1, 2, 3, 4, 5, 6, 1, 2]


def test_every_scan_is_seen_once_an_epoch_in_an_order_that_changes(tmp_path):
    trainer = make_trainer(tmp_path)
    epochs = [[trainer.task.frame_at(4 * epoch + place) for place in range(4)] for epoch in range(6)]
    assert all(sorted(epoch) == [0, 1, 2, 3] for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1
    assert torch.equal(trainer.task.inputs_at(5)[0].points, make_trainer(tmp_path).task.inputs_at(5)[0].points)
    assert trainer.task.inputs_at(3)[0].frames.tolist() == [trainer.task.frame_at(6), trainer.task.frame_at(7)]


def test_rates_fall_at_half_and_three_quarters():
    assert [CycleConfig(decay=0.1).rate_factor(0, share) for share in (0, 0.49, 0.5, 0.74, 0.75, 1)] == pytest.approx(
        [1, 1, 0.1, 0.1, 0.01, 0.01]
    )


def test_each_stage_follows_its_own_schedule(tmp_path, monkeypatch):
    trainer, seen = make_trainer(tmp_path, first_steps=4, second_steps=8, first_lr=0.01, second_lr=0.002), []

    def watch(cycle, batch, template, config, progress):
        seen.append((trainer.optimiser.param_groups[0]["lr"], cycle.reposed is not None, progress))
        return cycle_loss(cycle, batch, template, config, progress)

    monkeypatch.setattr(cycles, "cycle_loss", watch)
    drawn = []
    for trainer.step in range(12):
        drawn.append(trainer.task.inputs_at(trainer.step)[0].points[:, 0])
        trainer.train_step(trainer.task.inputs_at(trainer.step))
    rates, together, progress = zip(*seen)
    assert rates == pytest.approx([0.01] * 2 + [1e-3, 1e-4] + [0.002] * 4 + [2e-4] * 2 + [2e-5] * 2)
    assert together == (False,) * 4 + (True,) * 8
    assert progress == pytest.approx([0] * 4 + [step / 8 for step in range(8)])
    assert len({tuple(points.flatten().tolist()) for points in drawn}) == 12  # points are drawn anew every step


def test_clipping_shortens_the_gradient_before_the_step(tmp_path):
    free, clipped = make_trainer(tmp_path), make_trainer(tmp_path, clip=1e-9)
    norms, moved = [], []
    for trainer in (free, clipped):
        before = [value.detach().clone() for value in trainer.model.parameters()]
        norms.append(float(trainer.train_step(trainer.task.inputs_at(trainer.step))[2]))
        moved.append(max(float((a.detach() - b).abs().max()) for a, b in zip(trainer.model.parameters(), before)))
    assert norms[0] == norms[1] > 1e-3  # logged unclipped
    assert moved[0] == pytest.approx(4e-3, rel=1e-2) and moved[1] < 4e-4  # Adam's first step is as long as the rate
    gradients = torch.cat([value.grad.flatten() for value in clipped.model.parameters() if value.grad is not None])
    assert float(gradients.norm()) == pytest.approx(1e-9, rel=1e-2)


def test_a_code_is_found_at_its_own_falling_rate_from_new_points_every_step(monkeypatch):
    torch.manual_seed(0)
    model, seen = Canonicalizer(TEMPLATE, 4, NETS).requires_grad_(False), []

    def steady(cycle, batch, template, config, progress):
        seen.append((batch.points[0, 0], progress))
        return SimpleNamespace(total=cycle.codes.sum())

    monkeypatch.setattr(cycles, "cycle_loss", steady)
    config = CycleConfig(code_steps=4, code_lr=0.01, draw=DRAW)
    found = fit_latent(model, TEMPLATE, SCANS[2], model.codes[0], config)
    expected = model.codes[0] - 0.01 * (1 + 1 + 0.1 + 0.01)  # Adam under a constant gradient moves by the rate
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
    assert [progress for _, progress in seen] == [0, 0.25, 0.5, 0.75]
    assert len({tuple(point.tolist()) for point, _ in seen}) == 4


def test_fields_answer_the_same_in_training_and_evaluation():
    """No validation, code or scan depends on a mode that somebody may forget to set."""
    torch.manual_seed(0)
    model = Canonicalizer(TEMPLATE, 2, NETS)
    points, code, box = SCANS[0].points[None, :50], model.codes[:1], SCANS[0].box[None]
    answers = [(fields.inverse(points, code, box), fields.separate(points)) for fields in (model.train(), model.eval())]
    assert all(torch.equal(a, b) for a, b in zip(*answers))


def test_rates_of_the_paper_are_the_defaults():
    config = CycleConfig()
    assert (config.first_lr, config.second_lr, config.decay, config.clip) == (0.004, 0.001, 0.1, None)


def test_non_finite_losses_leave_the_weights_alone_and_end_training(tmp_path):
    scans = [replace(scan, points=torch.full_like(scan.points, 1e30)) for scan in SCANS]
    trainer = make_trainer(tmp_path, scans, first_steps=30)
    before = {name: value.clone() for name, value in trainer.model.named_parameters()}
    trainer.step = 30  # the second stage: points come back to nowhere
    with pytest.raises(AvatarError, match=r"not finite for 11 steps.*bend\.0000"):
        for _ in range(20):
            trainer.train_step(trainer.task.inputs_at(trainer.step))
    assert all(torch.equal(value, before[name]) for name, value in trainer.model.named_parameters())


def errors(frame, scan, posed_weights, canonical_weights) -> np.ndarray:
    """Mean distances, metres, of a frame's points from where they come back to, and at rest from where they belong."""
    points, transforms = to_root_frame(frame.scan.points, frame.body), scan.joint_transforms[None]
    there = torch.linalg.inv(skin_transforms(posed_weights(points), transforms)[0])
    canonical = transform_points(there, points)
    back = transform_points(skin_transforms(canonical_weights(canonical), transforms)[0], canonical)
    home = torch.from_numpy(frame.scan.canonical)
    return np.array([float((ends[0] - ends[1]).norm(dim=1).mean()) for ends in ((back, points), (canonical, home))])


@pytest.mark.slow
def test_a_skirt_is_learned_better_than_the_nearest_leg_says_and_an_unseen_one_finds_its_code(tmp_path):
    template = legs_template()
    steps = [((0, 0.0), (0, 0.0)), ((0, 0.4), (0, -0.4)), ((-0.8, 0.1), (0.3, 0)), ((0.3, 0), (-0.8, -0.1))]
    frames = [skirt_frame(*step) for step in (*steps, ((-0.5, 0.5), (0.2, -0.2)))]
    scans = [prepare_scan(frame, template, 2000) for frame in frames]
    torch.manual_seed(0)
    model = Canonicalizer(template, 5, NETS)
    config = CycleConfig(first_steps=150, second_steps=450, batch=5, draw=replace(DRAW, scan=128), code_steps=60)
    Trainer(CanonicalizerTask(model, template, scans, "abcde", config), config, tmp_path).fit()
    model.requires_grad_(False)

    def learned(frame, scan, code):
        field = model.forward_field

        def inverse(points):
            return model.inverse(points[None], code[None], scan.box[None])[0]

        return errors(frame, scan, inverse, lambda points: field(points[None])[0])

    def nearest(frame, scan):
        trees = (scan.body, template.vertices)
        baselines = (lambda p, body=body: template.weights[torch.cdist(p, body).argmin(1)] for body in trees)
        return errors(frame, scan, *baselines)

    ours = np.mean([learned(frame, scan, code) for frame, scan, code in zip(frames, scans, model.codes)], axis=0)
    theirs = np.mean([nearest(frame, scan) for frame, scan in zip(frames, scans)], axis=0)
    assert ours[0] < 0.35 * theirs[0] and ours[1] < 0.7 * theirs[1], (ours, theirs)

    frame = skirt_frame((-0.6, 0.2), (0.1, -0.3))
    scan = prepare_scan(frame, template, 2000)
    found = fit_latent(model, template, scan, model.codes[4], config)
    before, after = learned(frame, scan, model.codes[4]), learned(frame, scan, found)
    assert after[0] < 0.7 * before[0] and after[1] < before[1], (before, after)
    assert torch.equal(found, fit_latent(model, template, scan, model.codes[4], config))


def test_a_pose_needs_no_code_to_be_found():
    torch.manual_seed(0)
    model = Canonicalizer(TEMPLATE, 4, replace(NETS, latent=Latent.pose))
    assert torch.equal(fit_latent(model, TEMPLATE, SCANS[2], model.codes[0], CycleConfig()), SCANS[2].pose)


@pytest.fixture(scope="module")
def settings(tiny_folder, tmp_path_factory) -> CanonicalizeConfig:
    nets = CanonicalizerConfig(SkinningFieldConfig(width=16), SkinningFieldConfig(width=16, orders=8, latent=4))
    draw = DrawConfig(scan=100, body=50, edges=20, pool=1000)
    return CanonicalizeConfig(
        dataset=tiny_folder.parent.name,
        outfit=tiny_folder.name,
        data_root=tiny_folder.parents[1],
        runs_root=tmp_path_factory.mktemp("runs"),
        scan=ScanConfig(points=3000, noise=0.0015),
        canonicalizer=nets,
        train=CycleConfig(first_steps=20, second_steps=20, batch=2, draw=draw, code_steps=5),
        pictures=1,
    )


@pytest.fixture(scope="module")
def folder(settings):
    return canonicalize(settings)


def test_a_run_has_its_scans_and_all_that_belongs_to_it(settings, folder, tiny_outfit):
    assert folder == settings.runs_root / "canonical" / "open" / "tiny" / "default"
    names = {"config.yaml", "metrics.csv", "checkpoints", "canonicalizer.safetensors", "canonicalizer.json"}
    assert names | {"template.npz", "scans", "pictures"} <= {path.name for path in folder.iterdir()}
    assert {path.name for path in (folder / "pictures").iterdir()} == {"train.png", "test.png"}
    for split in ("train", "test"):
        files = {path.name for path in (folder / "scans" / split).iterdir()}
        expected = {f"{name}.npz" for name in tiny_outfit.frames(split)}
        assert files == expected | ({name.replace(".npz", ".ply") for name in expected} if split == "train" else set())
    scan = read_canonical_scan(folder / "scans" / "train" / f"{tiny_outfit.frames('train')[0]}.npz")
    assert scan.weights.shape == (len(scan.points), 22) and scan.faces is None
    cloud = read_points(folder / "scans" / "train" / f"{tiny_outfit.frames('train')[0]}.ply")
    np.testing.assert_allclose(cloud.points, scan.points, atol=1e-6)


def test_the_trained_field_comes_back_differentiable_and_frozen(settings, folder):
    trained = load_canonicalizer(folder)
    assert trained.config == settings and trained.steps == 40
    points = trained.template.vertices[None, ::100].clone().requires_grad_()
    weights = trained.forward_field(points)
    weights[..., 3].sum().backward()
    assert float(points.grad.abs().sum()) > 0
    assert not any(parameter.requires_grad for parameter in trained.forward_field.parameters())


def test_finished_scans_are_left_alone_and_damaged_or_outdated_ones_made_again(
    settings, folder, monkeypatch, change_source
):
    files = sorted((folder / "scans").rglob("*.npz"))
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}
    monkeypatch.setattr(Trainer, "fit", lambda self: pytest.fail("trained again"))
    train_canonicalizer(settings)
    canonicalize_frames(settings)
    assert all(path.stat().st_mtime_ns == before[path][0] for path in files)
    damaged = files[0]
    damaged.write_bytes(before[damaged][1][:-30])
    assert len(canonicalize_frames(settings)) == len(files)
    assert damaged.read_bytes() == before[damaged][1]  # the same bits again
    before = {path: path.stat().st_mtime_ns for path in files}
    change_source("avatar.training.trainer")  # has no part in scans of weights that are trained
    canonicalize_frames(settings)
    assert all(path.stat().st_mtime_ns == before[path] for path in files)
    for module in ("avatar.canonical.scans", "avatar.runs.canonicalizing"):
        change_source(module)
        canonicalize_frames(settings)
        assert all(path.stat().st_mtime_ns > before[path] for path in files)
        before = {path: path.stat().st_mtime_ns for path in files}


def test_going_on_with_other_settings_is_refused(settings, folder):
    with pytest.raises(AvatarError, match=r"train\.first_lr.*another name"):
        train_canonicalizer(replace(settings, train=replace(settings.train, first_lr=1.0)))


def test_frames_without_a_pose_and_meshes_are_canonicalized_the_same(settings, folder, tiny_outfit):
    trained, frame = load_canonicalizer(folder), tiny_outfit.load("test", tiny_outfit.frames("test")[1])
    poseless = replace(frame, body=replace(frame.body, pose=None, vertex_transforms=None, pose_vertices=None))
    points = frame.scan.points[::50]
    assert np.array_equal(trained.weights_of(points, poseless), trained.weights_of(points, frame))
    meshes = replace(settings, scan=ScanConfig(mesh=True, edge=0.05), weights=WeightSource.nearest, name="mesh")
    path = canonicalize_frames(replace(meshes, pictures=0))[0]
    scan = read_canonical_scan(path)
    assert scan.faces is not None and len(read_mesh(path.with_suffix(".ply")).faces) == len(scan.faces)


@pytest.mark.parametrize("kind", [WeightSource.nearest, WeightSource.knn])
def test_rivals_have_nothing_to_learn_and_no_field(settings, kind):
    config = replace(settings, weights=kind, name=kind.value, pictures=0)
    run = canonicalize(config)
    assert not (run / "checkpoints").exists()
    assert len(list((run / "scans").rglob("*.npz"))) == 9
    with pytest.raises(DataError, match=r"no trained canonicalizer.*weights=learned"):
        load_canonicalizer(run)


def test_one_frame_is_refused_with_the_reason(settings):
    frames = settings.frames()
    lone = FrameDataset(frames.outfits, frames.names[:1], points=1)
    with pytest.raises(DataError, match=r"canonicalizer needs at least 2 frames.*add scans"):
        train_canonicalizer(replace(settings, name="lone"), lone)


def test_a_run_is_scored_against_the_truth_beside_its_rivals(settings, folder):
    canonicalize(replace(settings, scored=2, pictures=0))
    scores = read_scores(folder / "scores.csv")
    values = {(row.method, row.variant, row.metric): row.value for row in scores.rows}
    assert {(method, split) for method, split, _ in values} >= {
        (kind.value, split) for kind in WeightSource for split in ("train", "test")
    }
    assert all(len({f.frame for f in scores.frames if f.variant == split}) == 2 for split in ("train", "test"))
    assert values["nearest", "train", "cycle_cm"] != values["learned", "train", "cycle_cm"]
    frame = settings.frames().frame(0)
    back = canonicalizer_with(settings, skinning_source(settings, read_template(folder / "template.npz")))(frame)
    assert np.allclose(back.forward_weights.sum(axis=1), 1, atol=1e-5)
    assert "| truth_cm (cm) |" in (folder / "scores.md").read_text()


def test_canonical_scores_are_measured_again_when_their_code_or_the_scans_change_and_not_else(
    settings, monkeypatch, change_source
):
    """As `experiment` asks for them, again and again; a fixed metric must not keep its old numbers."""
    config, measured, found = replace(settings, weights=WeightSource.knn, name="scored", pictures=0, scored=1), [], []
    frames, real = config.frames(), CANONICAL_METRICS["truth_cm"].measure

    def count(factor: float) -> int:
        """The measurements that a call makes, with a metric that gives ``factor`` times the true one's number."""
        fixed = replace(CANONICAL_METRICS["truth_cm"], measure=lambda c: measured.append(1) or factor * real(c))
        monkeypatch.setitem(CANONICAL_METRICS, "truth_cm", fixed)
        measured.clear()
        rows = [row for row in score_canonical_scans(config, frames).rows if row.metric == "truth_cm"]
        found.append({(row.method, row.variant): row.value for row in rows})
        return len(measured)

    assert [count(1), count(1)] == [6, 0]  # two splits of a frame, two baselines and the true weights
    change_source("avatar.evaluation.canonical")
    assert [count(2), count(2)] == [6, 0]
    assert found[0] == found[1] != found[2] == {method: 2 * value for method, value in found[0].items()}
    written = read_scores(config.folder / "scores.csv").rows
    assert {row.value for row in written if row.metric == "truth_cm"} == set(found[2].values())
    config = replace(config, stretch=2.0)
    assert count(2) == 4  # not of the true weights, which cut nothing


def test_bad_settings_are_refused_by_name(settings):
    for option in ({"name": "../x"}, {"stretch": 1.0}, {"pictures": -1}, {"scored": -1}):
        with pytest.raises(AvatarError, match=next(iter(option))):
            replace(settings, **option)
    for option in ({"first_steps": 0}, {"second_steps": -1}, {"clip": 0.0}, {"code_lr": 0.0}, {"batch": 0}):
        with pytest.raises(AvatarError, match=next(iter(option))):
            CycleConfig(**option)
    with pytest.raises(AvatarError, match="pool"):
        DrawConfig(pool=0)


def test_each_joint_has_a_colour_of_its_own():
    colors = weight_colors(np.eye(22))
    assert colors.min() >= 0 and colors.max() <= 1
    apart = np.linalg.norm(colors[:, None] - colors, axis=-1) + np.eye(22)
    assert apart.min() > 0.05
    np.testing.assert_allclose(weight_colors(np.eye(22)[:2].mean(0)[None])[0], colors[:2].mean(0))
