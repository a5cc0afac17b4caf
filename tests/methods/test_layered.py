"""The layered method: the body's own skin, a garment mesh that moves alone, its losses, and the verbs on it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from spheres import DECODER, ENCODER, TEMPLATE, random_batch
from tiny import SETTINGS, quick_training, trunk_garment

from avatar.body.packed import write_template
from avatar.checks import AvatarError, DataError
from avatar.data.splits import split_outfit
from avatar.geometry.closest import closest_on_mesh
from avatar.geometry.surface import interpolate, vertex_normals
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.clothed_templates import write_clothed_template
from avatar.io.meshes import read_mesh
from avatar.methods.base import Position
from avatar.methods.layered import (
    TERMS,
    ClothConfig,
    Head,
    LayeredAvatar,
    LayeredConfig,
    LayeredTask,
    clothed_template,
    consecutive_frames,
    handle_poses,
)
from avatar.methods.losses import LossConfig
from avatar.methods.points import body_batch
from avatar.methods.registry import find_method
from avatar.methods.settings import MethodChoice, RunConfig, Schedule, Space, TrainConfig
from avatar.nn.decoders import PoseFrame
from avatar.nn.handles import ClothHandles, HandleLayout
from avatar.records import ClothedTemplate
from avatar.runs.prediction import predict_frames
from avatar.runs.training import load_avatar
from avatar.runs.training import train as train_run
from avatar.settings import settings_from_dict


def dressed_sphere() -> ClothedTemplate:
    """The sphere's lower half as skin, with a covered seam, and its upper half, a little larger, as the garment."""
    vertices, faces = TEMPLATE.vertices.numpy(), TEMPLATE.faces.numpy()
    low, high = faces[(vertices[faces][..., 1] <= 0.1).all(axis=1)], faces[(vertices[faces][..., 1] >= 0).all(axis=1)]
    (skin, lower), (top, upper) = (np.unique(part, return_inverse=True) for part in (low, high))
    places = np.concatenate([vertices[skin], 1.1 * vertices[top]])
    return ClothedTemplate(
        vertices=places,
        faces=np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3) + len(skin)]),
        weights=np.ones((len(places), 1), np.float32),
        body_vertex=np.concatenate([skin, np.full(len(top), -1)]),
        covered=np.concatenate([vertices[skin][:, 1] > 0, np.zeros(len(top), bool)]),
    )


CLOTHED = dressed_sphere()
BATCH = replace(random_batch(), outfit_ids=torch.zeros(3, dtype=torch.int64))


def layered(**switches) -> LayeredAvatar:
    torch.manual_seed(0)
    config = LayeredConfig(ENCODER, ENCODER, DECODER, DECODER, code_channels=6, code_std=0.5, **switches)
    return LayeredAvatar(TEMPLATE, CLOTHED, config).eval()


def draw(model: LayeredAvatar, count: int = 300):
    return model.draw_samples(count, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("head", list(Head))
def test_skin_is_the_body_s_and_the_garment_moves(head):
    model = layered(head=head)
    samples = draw(model)
    prediction = model(BATCH, samples)
    skin = samples.vertex_ids[:, 0] < model.skin
    assert 50 < int(skin.sum()) < 250
    body = BATCH.vertices[:, torch.from_numpy(CLOTHED.body_vertex[: model.skin])]
    on_skin = replace(samples, vertex_ids=samples.vertex_ids.clamp(max=model.skin - 1))
    torch.testing.assert_close(prediction.points[:, skin], interpolate(body, on_skin)[:, skin])
    _, posed = model.dress(BATCH)
    moved = (prediction.points - interpolate(posed, samples)).norm(dim=-1)
    assert float(moved[:, skin].max()) < 1e-6 < 1e-4 < float(moved[:, ~skin].min())
    torch.testing.assert_close(prediction.normals.norm(dim=-1), torch.ones(3, 300))


def test_the_template_is_posed_by_its_own_weights():
    model = layered()
    encoded, posed = model.dress(BATCH)
    linear, shift = BATCH.joint_transforms[:, 0, :3, :3], BATCH.joint_transforms[:, 0, :3, 3]
    expected = torch.from_numpy(CLOTHED.vertices) @ linear.transpose(1, 2) + shift[:, None]
    torch.testing.assert_close(posed[:, model.skin :], expected[:, model.skin :])
    torch.testing.assert_close(encoded.vertices, posed[:, model.seen])
    assert len(model.seen) == model.garment_count + int((model.seen < model.skin).sum()) < len(CLOTHED.vertices) + 1


def test_points_and_normals_are_those_of_the_mesh():
    model = layered()
    samples = draw(model)
    prediction = model(BATCH, samples)
    torch.testing.assert_close(prediction.points, interpolate(prediction.mesh, samples))
    normals = interpolate(vertex_normals(prediction.mesh, model.clothed_faces), samples)
    torch.testing.assert_close(prediction.normals, torch.nn.functional.normalize(normals, dim=-1))
    assert prediction.offsets.shape == (3, len(CLOTHED.vertices) - model.skin, 3)
    assert prediction.wrinkle_normals is None and model.pose_decoder.normal_branch is None


def test_points_leave_covered_skin_out():
    samples = draw(layered(), 2000)
    assert not CLOTHED.covered[samples.vertex_ids.numpy()].any()
    assert torch.equal(torch.from_numpy(CLOTHED.faces)[samples.face_ids], samples.vertex_ids)


def test_offsets_are_posed_and_half_of_them_is_the_garment_s():
    model = layered()
    with torch.no_grad():
        model.codes[..., 6:] = torch.randn(model.codes[..., 6:].shape, generator=torch.Generator().manual_seed(0))
    prediction = model(BATCH, draw(model))
    torch.testing.assert_close(prediction.offsets, prediction.garment_offsets + prediction.wrinkle_offsets)
    linear = BATCH.joint_transforms[:, 0, :3, :3]
    posed = model.dress(BATCH)[1][:, model.skin :] + prediction.offsets @ linear.transpose(1, 2)
    torch.testing.assert_close(prediction.mesh[:, model.skin :], posed)
    still = model(BATCH, draw(model), wrinkles=False)
    torch.testing.assert_close(still.offsets, prediction.garment_offsets)


def with_handles(frame: PoseFrame = PoseFrame.heading) -> tuple[LayeredAvatar, torch.Tensor]:
    """A network whose handles lift the garment by 0, 0.1, ... m in its five training frames, and their transforms."""
    transforms = torch.eye(4).repeat(5, 1, 1, 1)
    angles = torch.linspace(-0.6, 0.6, 5)
    transforms[:, 0, 1, 1], transforms[:, 0, 2, 2] = angles.cos(), angles.cos()
    transforms[:, 0, 1, 2], transforms[:, 0, 2, 1] = -angles.sin(), angles.sin()
    layout = HandleLayout.on_mesh(*map(torch.from_numpy, CLOTHED.garment), 20)
    config = LayeredConfig(ENCODER, ENCODER, DECODER, DECODER, code_channels=6, pose_frame=frame)
    handles = ClothHandles(layout, handle_poses(transforms, config))
    with torch.no_grad():
        handles.values[..., 1] = 0.1 * torch.arange(5)[:, None]
    torch.manual_seed(0)
    return LayeredAvatar(TEMPLATE, CLOTHED, config, handles), transforms


def test_handles_give_training_frames_their_own_offsets_and_others_those_of_their_pose():
    model, transforms = with_handles()
    task = LayeredTask(model, TEMPLATE, TrainConfig(points=200), lambda step: BATCH, 5)
    samples = draw(model)
    batch = replace(BATCH, joint_transforms=transforms[[0, 3, 4]], frame_ids=torch.tensor([4, 0, 1]))
    bare, lifted = (model.train()(batch, samples, wrinkles).offsets for wrinkles in (False, True))
    wrinkles = model(batch, samples).wrinkle_offsets
    given = torch.tensor([0, 0.1, 0]) * torch.tensor([[[4]], [[0]], [[1]]])
    torch.testing.assert_close(lifted - bare - wrinkles, given.expand_as(lifted))
    task.settle()
    predicted = model.eval()(batch, samples)
    parts = predicted.offsets - predicted.garment_offsets - predicted.wrinkle_offsets
    expected = torch.tensor([0, 0.1, 0]) * torch.tensor([[[0]], [[3]], [[4]]])  # of the pose, not of the id
    torch.testing.assert_close(parts, expected.expand_as(parts), atol=0.02, rtol=0)
    still, _ = with_handles(PoseFrame.root)
    LayeredTask(still, TEMPLATE, TrainConfig(points=200), lambda step: BATCH, 5).settle()
    same = still.handles.predict(handle_poses(transforms, still.config))
    torch.testing.assert_close(same[0], same[4])  # in the root frame all of these poses are one


def test_handles_learn_from_the_frames_of_a_batch_alone():
    model, transforms = with_handles()
    task = LayeredTask(model.train(), TEMPLATE, TrainConfig(points=200), lambda step: BATCH, 5)
    batch = replace(BATCH, joint_transforms=transforms[[0, 3, 3]], frame_ids=torch.tensor([0, 3, 3]))
    task.loss((batch, draw(model)), Position(0, 1.0)).total.backward()
    learned = model.handles.values.grad.abs().sum(dim=(1, 2)) > 0
    assert learned.tolist() == [True, False, False, True, False]


def objective(switches, loss):
    model = layered(cloth=ClothConfig(**switches))
    task = LayeredTask(model, TEMPLATE, TrainConfig(points=200, loss=loss), lambda step: BATCH, 3)
    return task.loss((BATCH, draw(model)), Position(0, 1.0)), model


@pytest.mark.parametrize("term", [term for term in TERMS if term != "temporal"])
def test_each_term_of_the_mesh_has_its_switch_and_moves_the_network(term):
    nothing = dict.fromkeys(TERMS, 0.0)
    without, _ = objective(nothing, LossConfig())
    assert not set(TERMS) & set(without.raw)
    data = dict.fromkeys(("scan_to_points", "points_to_scan", "normal", "offset", "code"), 0.0)
    some = {"gap": 0.5} if "contact" in term else {}
    terms, model = objective(nothing | {term: 2.0} | some, LossConfig(**data))
    assert set(terms.weighted) == {term} and float(terms.total) == pytest.approx(2 * float(terms.raw[term]))
    terms.total.backward()
    moved = model.pose_decoder.offset_branch[-1].weight.grad
    assert float(terms.raw[term]) > 0 and moved is not None and float(moved.norm()) > 0


def test_frames_of_a_motion_follow_each_other_and_random_poses_do_not():
    angles = torch.tensor([0.0, 0.1, 0.2, 0.3, 2.0, 0.1, 1.9, 0.2, 0.0])
    names = [*(f"walk.{number:05}" for number in (4, 6, 8, 10, 12)), *(f"pose.{number:05}" for number in range(3)), "x"]
    poses = torch.zeros(9, 1, 9)
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 0, 4] = angles.cos(), angles.sin(), angles.cos()
    assert consecutive_frames(names, poses).tolist() == [[0, 1, 2], [1, 2, 3]]
    assert consecutive_frames(names[::-1], poses.flip(0)).tolist() == [[8, 7, 6], [7, 6, 5]]
    assert consecutive_frames(["a", "b"], poses[:2]).shape == (0, 3)


def test_the_temporal_term_holds_handles_to_an_even_motion():
    model, transforms = with_handles()
    model.config.cloth = ClothConfig(**dict.fromkeys(TERMS, 0.0) | {"temporal": 3.0})
    task = LayeredTask(model, TEMPLATE, TrainConfig(points=200), lambda step: BATCH, 5)
    batch = replace(BATCH, joint_transforms=transforms[:3], frame_ids=torch.tensor([0, 1, 2]))
    found = {}
    for triples in ([], [[0, 1, 2], [1, 2, 3]], [[0, 1, 4]]):
        model.handles.triples = torch.tensor(triples, dtype=torch.int64).reshape(-1, 3)
        terms = task.loss((batch, draw(model)), Position(0, 1.0))
        found[len(triples)] = float(terms.raw["temporal"].detach())
        assert float(terms.weighted["temporal"].detach()) == pytest.approx(3 * found[len(triples)])
    # handles rise by 0.1 m a frame: evenly in the first two triples, in the last by 0.1 and 0.3 m
    assert found[0] == 0 and found[2] < 1e-12 and found[1] == pytest.approx(0.2**2)
    with pytest.raises(AvatarError, match=r"cloth\.temporal"):
        LayeredConfig(handles=0, cloth=ClothConfig(temporal=1.0))


def test_the_garment_template_alone_is_neither_strained_nor_bent():
    model = layered(pose=False, cloth=ClothConfig(bent_rest=True))
    task = LayeredTask(model, TEMPLATE, TrainConfig(points=200), lambda step: BATCH, 3)
    rigid = replace(BATCH, joint_transforms=torch.eye(4).expand(3, 1, 4, 4))
    raw = task.loss((rigid, draw(model)), Position(0, 1.0)).raw
    assert float(raw["strain"]) < 1e-9 and float(raw["bending"]) < 1e-6 < float(raw["laplacian"]) * 1e9


def test_the_heading_frame_sees_the_tilt_that_the_root_frame_does_not():
    lean = torch.eye(4).repeat(3, 1, 1, 1)
    lean[:, 0, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # lying on the back
    upright = replace(BATCH, joint_transforms=torch.eye(4).expand(3, 1, 4, 4))
    lying = replace(BATCH, joint_transforms=lean)
    for frame, same in ((PoseFrame.root, True), (PoseFrame.heading, False)):
        model = layered(pose_frame=frame)
        one, other = (model.pose_input(model.dress(batch)[0])[:, : model.garment_count] for batch in (upright, lying))
        assert torch.allclose(one, other, atol=1e-5) == same
    torch.testing.assert_close(other @ lean[0, 0, :3, :3], one)


def test_runs_it_cannot_train_are_refused():
    method, run = find_method("layered"), RunConfig(method=MethodChoice("layered", "layered"))
    method.check(run, LayeredConfig())
    with pytest.raises(AvatarError, match=r"outfit: expected one, .*got 2"):
        method.check(replace(run, outfit=("tee", "dress")), LayeredConfig())
    with pytest.raises(AvatarError, match="space, skinning"):
        method.check(replace(run, space=Space.canonical), LayeredConfig())
    with pytest.raises(AvatarError, match="laplacian"):
        ClothConfig(laplacian=-1.0)


@pytest.fixture(scope="module")
def run(tiny_folder, tiny_outfit, tmp_path_factory) -> RunConfig:
    """A run on the tiny outfit, whose clothed template is made by hand: the trunk as garment over the body's skin."""
    runs = tmp_path_factory.mktemp("runs")
    template = tiny_outfit.template
    clothed = trunk_garment(template)
    train = quick_training(steps=100, points=2000, scan_points=2000, validate_every=50, save_every=50)
    train = replace(train, schedule=Schedule.constant, loss=replace(train.loss, normal_start=0.0))  # no end to see
    choice = MethodChoice("layered", "layered", SETTINGS)
    where = {"dataset": tiny_folder.parent.name, "outfit": (tiny_folder.name,), "data_root": tiny_folder.parents[1]}
    config = RunConfig(method=choice, runs_root=runs, train=train, **where)
    with pytest.raises(DataError, match="canonicalize"):
        train_run(config)
    folder = runs / "canonical" / tiny_outfit.dataset / tiny_outfit.name / "default"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(f"{{dataset: {tiny_outfit.dataset}, outfit: {tiny_outfit.name}}}")
    write_template(folder / "template.npz", template)
    with pytest.raises(DataError, match=r"template\.npz.*tools/template\.py"):
        train_run(config)
    bare = clothed.body_vertex >= 0
    parts = {name: getattr(clothed, name)[bare] for name in ("vertices", "weights", "body_vertex", "covered")}
    skin_alone = ClothedTemplate(faces=clothed.faces[~clothed.garment_faces], **parts)
    write_clothed_template(folder / "template" / "template.npz", skin_alone)
    with pytest.raises(DataError, match=r"template\.npz.*expected a garment, got skin alone"):
        train_run(config)
    write_clothed_template(folder / "template" / "template.npz", clothed)
    return config


def test_a_mirror_image_is_a_training_frame_of_its_own(run, tiny_outfit):
    method = find_method("layered")
    mirrored = replace(run, train=replace(run.train, mirror=True))
    settings = settings_from_dict(LayeredConfig, run.method.settings, "settings.")
    task = method.prepare(mirrored, settings, tiny_outfit.template)
    plain = method.prepare(run, settings, tiny_outfit.template)
    frames = split_outfit(tiny_outfit, run.split).train
    assert len(task.model.handles.values) == 2 * len(frames) == 2 * len(plain.model.handles.values)
    seen = set()
    for step in range(6):
        batch = task.batch_at(step)
        poses = handle_poses(batch.joint_transforms, settings)
        torch.testing.assert_close(task.model.handles.poses[batch.frame_ids], poses, atol=1e-5, rtol=0)
        assert tuple(frames[index % len(frames)] for index in batch.frame_ids.tolist()) == batch.names
        seen |= set((batch.frame_ids >= len(frames)).tolist())
    assert seen == {False, True}


def test_handles_have_a_switch(run, tiny_outfit):
    method, choice = find_method("layered"), replace(run.method, settings=run.method.settings | {"handles": 0})
    settings = settings_from_dict(LayeredConfig, choice.settings, "settings.")
    model = method.prepare(replace(run, method=choice), settings, tiny_outfit.template).model
    assert model.handles is None and not any(name.startswith("handles") for name in model.state_dict())
    assert method.static["handles"] == 0
    with pytest.raises(AvatarError, match="handles"):
        LayeredConfig(handles=3)


def test_a_run_is_trained_and_comes_back_with_points_and_a_mesh_of_constant_topology(run, tiny_outfit, tmp_path):
    folder = train_run(run)
    avatar = load_avatar(folder)
    assert float(avatar.model.handles.duals.abs().max()) > 0
    paths = predict_frames(avatar, tiny_outfit, "test", tmp_path / "points", tmp_path / "meshes", 1500)
    meshes = [read_mesh(tmp_path / "meshes" / f"{path.stem}.ply") for path in paths]
    assert len(meshes) == 3 and all(np.array_equal(mesh.faces, meshes[0].faces) for mesh in meshes)
    name = paths[0].stem
    body = tiny_outfit.load("test", name).body
    found = avatar.method.predictor(avatar, tiny_outfit.name, 1500, ExtractionConfig())(body)
    skin = avatar.model.clothed_body_vertex[: avatar.model.skin].numpy()
    np.testing.assert_allclose(found.mesh.vertices[: len(skin)], body.vertices[skin], atol=1e-6)
    np.testing.assert_allclose(found.mesh.vertices, meshes[0].vertices, atol=1e-6)
    assert found.constant and len(found.cloud.points) == 1500
    for pose in (None, body):
        cloud = avatar.method.garment(avatar, tiny_outfit.name, 1200, pose)
        assert len(cloud.points) == 1200 and np.isfinite(cloud.normals).all()
    with pytest.raises(AvatarError, match="template of its own"):
        avatar.method.fit_code(avatar, None, None)


def test_it_comes_nearer_than_its_template_and_resumes_to_the_bit(run, tiny_outfit):
    whole = train_run(run)
    avatar = load_avatar(whole)
    samples = draw(avatar.model)

    def error(model) -> float:
        errors = []
        for name in tiny_outfit.frames("test"):
            frame = tiny_outfit.load("test", name)
            mesh = model(body_batch([frame.body], 0, (name,)), samples).mesh[0].detach().numpy()
            hits = closest_on_mesh(frame.scan.points, mesh, model.clothed_faces.numpy())
            errors.append(np.abs(hits.signed_distances).mean())
        return float(np.mean(errors))

    template = LayeredAvatar(avatar.template, clothed_template(avatar.model.state_dict()), avatar.settings).eval()
    for decoder in (template.garment_decoder, template.pose_decoder):
        torch.nn.init.zeros_(decoder.offset_branch[-1].weight)
        torch.nn.init.zeros_(decoder.offset_branch[-1].bias)
    assert error(avatar.model) < 0.6 * error(template)  # measured: 0.48 of it
    moved = replace(run, name="parts", train=replace(run.train, steps=50))
    train_run(moved)
    folder = train_run(replace(moved, train=run.train))
    assert (folder / "avatar.safetensors").read_bytes() == (whole / "avatar.safetensors").read_bytes()
