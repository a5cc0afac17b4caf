"""The open body: its joints, its shape, its zero pose, and the weights it keeps."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from bodies import random_pose

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS
from avatar.body.open import ASSET, MEAN_SHAPE, open_body, open_body_shapes, write_open_bodies
from avatar.checks import AvatarError, DataError
from avatar.geometry.neighbours import nearest
from avatar.geometry.transforms import transform_points
from avatar.geometry.uv import rasterise_uv
from avatar.records import Template

# SMPL's joint order as its papers and files have it, written out apart from the code
SMPL_ORDER = """pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot
right_foot neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist
right_wrist"""


@pytest.fixture(params=["female", "male", MEAN_SHAPE])
def body(request):
    return open_body(request.param)


def joint(body, name: str) -> torch.Tensor:
    return body.template.joints[body.joint_names.index(name)]


def test_joints_are_the_22_of_smpl(body):
    assert list(body.joint_names) == SMPL_ORDER.split() == SMPL_JOINTS
    assert body.parents == SMPL_PARENTS
    for name, parent in zip(body.joint_names, body.parents):
        if parent >= 0 and not name.endswith(("hip", "collar")):
            side = name.split("_")[0] if "_" in name else ""
            assert body.joint_names[parent].startswith(side if "shoulder" not in name else name[:4])


def test_mesh_is_one_watertight_outward_surface(body):
    mesh = trimesh.Trimesh(body.template.vertices.numpy(), body.template.faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert 0.04 < mesh.volume < 0.12  # cubic metres of a person, and positive: faces look outwards
    assert (len(mesh.vertices), len(mesh.faces)) == (12272, 24540)


def test_size_and_directions(body):
    vertices = body.template.vertices
    height = float(vertices[:, 1].max() - vertices[:, 1].min())
    assert 1.5 < height < 2.0
    assert joint(body, "head")[1] > joint(body, "pelvis")[1] > joint(body, "left_foot")[1]
    for name in SMPL_JOINTS:
        if name.startswith("left"):
            assert joint(body, name)[0] > 0 > joint(body, name.replace("left", "right"))[0]
    assert joint(body, "left_foot")[2] > joint(body, "left_ankle")[2]  # toes, like the face, look along +z
    assert vertices.mean(dim=0)[0].abs() < 0.01


def test_arms_are_horizontal_in_the_zero_pose(body):
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for start, end in (("shoulder", "elbow"), ("elbow", "wrist")):
            arm = joint(body, f"{side}_{end}") - joint(body, f"{side}_{start}")
            assert math.degrees(math.acos(float(sign * arm[0] / arm.norm()))) < 1


def test_weights_are_weights(body):
    weights = body.template.weights
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(len(weights)))
    assert weights.min() >= 0 and (weights.amax(dim=0) > 0.3).all()
    hand = weights[:, SMPL_JOINTS.index("left_wrist")] > 0.9
    assert hand.sum() > 500  # the fingers, merged
    assert body.template.vertices[hand, 0].min() > joint(body, "left_elbow")[0]


def test_bending_an_elbow_moves_the_forearm_only(body):
    pose = torch.zeros(1, 22, 3)
    pose[0, SMPL_JOINTS.index("left_elbow"), 1] = -math.pi / 2  # left arm along +x, forearm turned to the front
    moved = (body(pose).vertices[0] - body.template.vertices).norm(dim=-1)
    elbow = joint(body, "left_elbow")[0]
    assert moved[body.template.vertices[:, 0] < elbow - 0.2].max() < 1e-3
    posed = body(pose).vertices[0][body.template.vertices[:, 0] > elbow + 0.2]
    assert posed[:, 2].max() > joint(body, "left_elbow")[2] + 0.3


def test_posed_body_is_its_template_moved_by_its_transforms(body):
    posed = body(random_pose(2, 22).float(), torch.ones(2, 3))
    carried = transform_points(posed.vertex_transforms, body.template.vertices)
    torch.testing.assert_close(carried, posed.vertices, atol=1e-5, rtol=0)


def test_asset_is_small():
    assert ASSET.stat().st_size < 460_000
    assert set(open_body_shapes()) >= {"female", "male"}


def test_stored_weights_pose_like_the_full_ones(tmp_path, monkeypatch):
    """What the asset keeps of a body's weights poses it within a tenth of a millimetre."""
    full = open_body("female")
    generator = torch.Generator().manual_seed(0)
    weights = full.weights + 0.02 * torch.rand(full.weights.shape, generator=generator) * (full.weights > 0)
    weights = weights / weights.sum(dim=1, keepdim=True)
    bind = Template(full.bind_vertices, full.faces, weights, full.bind_joints, SMPL_PARENTS, tuple(SMPL_JOINTS))
    path = tmp_path / "bodies.npz"
    write_open_bodies(path, {"only": (bind, full.zero_from_bind)})
    monkeypatch.setattr("avatar.body.open.ASSET", path)
    stored = open_body("only")
    assert float((stored.weights - weights).abs().max()) < 2e-5
    torch.testing.assert_close(stored.bind_vertices, bind.vertices, atol=0, rtol=0)
    torch.testing.assert_close(stored.zero_from_bind, full.zero_from_bind, atol=0, rtol=0)
    assert torch.equal(stored.faces, full.faces)


def test_atlas_is_whole_and_without_folds(body):
    """Every triangle has its own place in the square, none is turned over, and together they fill 63% of it."""
    template = body.template
    assert template.uv.shape == (13343, 2) and template.uv.min() >= 0 and template.uv.max() <= 1
    first, second, third = template.uv[template.uv_faces].double().unbind(dim=1)
    doubled = torch.linalg.det(torch.stack([second - first, third - first], dim=-1))
    assert doubled.min() > 0
    assert float(doubled.sum() / 2) == pytest.approx(0.6277, abs=1e-4)
    covered = len(rasterise_uv(template.uv, template.uv_faces, template.faces, 256).pixels) / 256**2
    assert covered == pytest.approx(0.6277, abs=2e-3)  # less than the areas' sum if triangles overlapped
    owner = torch.full((13343,), -1)
    owner[template.uv_faces.ravel()] = template.faces.ravel()
    assert torch.equal(owner[template.uv_faces], template.faces)  # a UV coordinate belongs to one vertex


def test_chest_is_laid_out_left_right_symmetric(body):
    """Mirrored points of the chest lie at places mirrored about u = 0.38: the coordinates sit on the right vertices."""
    template = body.template
    uv = template.uv[: len(template.vertices)]  # a vertex's first place has its own number
    partner = nearest((template.vertices * torch.tensor([-1.0, 1, 1]))[None], template.vertices[None])[0]
    chest = ((uv - torch.tensor([0.38, 0.65])).abs() < 0.12).all(dim=1)
    assert chest.sum() > 500
    assert (uv[partner] - (uv * torch.tensor([-1.0, 1]) + torch.tensor([0.76, 0])))[chest].abs().max() < 0.005


def test_atlas_survives_another_canonical_pose_and_the_asset(tmp_path, monkeypatch):
    full = open_body("female")
    turned = full.with_canonical_pose(random_pose(22)).template
    assert torch.equal(turned.uv, full.template.uv) and torch.equal(turned.uv_faces, full.template.uv_faces)
    bind = replace(full.template, canonical_from_bind=None)
    path = tmp_path / "bodies.npz"
    write_open_bodies(path, {"only": (bind, full.zero_from_bind)})
    monkeypatch.setattr("avatar.body.open.ASSET", path)
    stored = open_body("only").template
    assert torch.equal(stored.uv, bind.uv) and torch.equal(stored.uv_faces, bind.uv_faces)
    write_open_bodies(path, {"only": (replace(bind, uv=None, uv_faces=None), full.zero_from_bind)})
    assert open_body("only").template.uv is None


def test_unknown_shape_and_missing_asset(monkeypatch, tmp_path):
    with pytest.raises(AvatarError, match="expected one of female, male"):
        open_body("giant")
    monkeypatch.setattr("avatar.body.open.ASSET", tmp_path / "none.npz")
    with pytest.raises(DataError, match="export_body"):
        open_body()


def test_damaged_asset_is_refused(monkeypatch, tmp_path):
    damaged = tmp_path / "open_body.npz"
    damaged.write_bytes(ASSET.read_bytes()[: np.random.default_rng(0).integers(1000, 100_000)])
    monkeypatch.setattr("avatar.body.open.ASSET", damaged)
    with pytest.raises(DataError, match=r"open_body\.npz"):
        open_body()
