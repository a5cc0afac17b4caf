"""The avatar as a whole: locality of the pose, posing by the field, colours, sampling."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from tiny import tiny_pose

from avatar.body.model import SMPL_JOINTS
from avatar.body.open import open_body
from avatar.canonical.fields import BodyField
from avatar.checks import AvatarError
from avatar.implicit.avatar import ImplicitAvatar, ImplicitConfig, PoseInput, sample_mesh
from avatar.implicit.extraction import ExtractionConfig
from avatar.implicit.losses import QueryPoints, query_field
from avatar.implicit.networks import MlpConfig, SdfConfig
from avatar.records import Mesh

BODY = open_body("female")
TEMPLATE = BODY.template
BOX = torch.stack([TEMPLATE.vertices.amin(dim=0) - 0.1, TEMPLATE.vertices.amax(dim=0) + 0.1])
COARSE = ExtractionConfig(32)


def make_avatar(pose=PoseInput.local, **switches) -> ImplicitAvatar:
    """An avatar whose pose inputs do something: trained ones do, fresh ones start without."""
    torch.manual_seed(0)
    config = ImplicitConfig(
        sdf=SdfConfig(widths=(24, 24, 24), skip=1, orders=2),
        texture=MlpConfig(widths=(16, 16), skip=1, orders=2),
        pose=pose,
        **({"gate_spacing": 0.1} | switches),
    )
    avatar = ImplicitAvatar(TEMPLATE, BodyField(TEMPLATE), BOX, config).eval()
    with torch.no_grad():
        for layer in avatar.sdf.mlp.layers:
            direction = layer.parametrizations.weight.original1
            direction += 0.05 * torch.randn_like(direction)
    return avatar


def transforms_of(**joints) -> torch.Tensor:
    pose = torch.zeros(1, 22, 3)
    for name, turn in joints.items():
        pose[0, SMPL_JOINTS.index(name)] = torch.tensor(turn)
    return BODY(pose).joint_transforms


REST, WRIST = transforms_of(), transforms_of(left_wrist=(0.8, -0.3, 0.5))


def changed(avatar: ImplicitAvatar) -> np.ndarray:
    """Which body vertices' distances a turn of the left wrist changes at all."""
    points = TEMPLATE.vertices[None]
    with torch.no_grad():
        return (avatar(points, REST) != avatar(points, WRIST))[0].numpy()


def test_a_wrist_moves_nothing_at_the_feet_but_does_so_under_global_conditioning():
    ankles = TEMPLATE.vertices[:, 1] < TEMPLATE.joints[SMPL_JOINTS.index("left_ankle"), 1]
    arm = TEMPLATE.weights[:, SMPL_JOINTS.index("left_elbow")].numpy() > 0.9
    feet = ankles.numpy()
    for spacing in (0.0, 0.1):
        local = changed(make_avatar(gate_spacing=spacing))
        assert not local[feet].any() and local[arm].mean() > 0.9
    assert changed(make_avatar(PoseInput.global_))[feet].mean() > 0.9
    assert not changed(make_avatar(PoseInput.none)).any()


def test_fewer_rings_reach_fewer_places():
    four, one = (changed(make_avatar(rings=rings, gate_spacing=0.0)).sum() for rings in (4, 1))
    assert 0 < one < 0.7 * four


def test_the_gate_reads_the_lattice_as_it_would_the_field():
    points = TEMPLATE.vertices[None, ::50]
    exact, read = (make_avatar(gate_spacing=spacing) for spacing in (0.0, 0.02))
    with torch.no_grad():
        gates = [avatar.pose_features(points, WRIST) for avatar in (exact, read)]
    assert (gates[0] - gates[1]).abs().mean() < 0.01
    assert read.near_field is not None and exact.near_field is None


def test_gradients_see_what_the_gate_changes_from_place_to_place():
    avatar, pose, step = make_avatar(gate_spacing=0.3).double(), WRIST.double(), 1e-6
    arm = TEMPLATE.weights[:, SMPL_JOINTS.index("left_elbow")] > 0.9
    points = TEMPLATE.vertices[arm][::100][None].double() + 0.012
    found = query_field(avatar, points, QueryPoints(*[points[:, :1]] * 3), pose).surface_gradients
    shifts = step * torch.eye(3, dtype=torch.float64)
    slopes = [(avatar(points + shift, pose) - avatar(points - shift, pose)) / (2 * step) for shift in shifts]
    torch.testing.assert_close(found, torch.stack(slopes, dim=-1), atol=1e-6, rtol=1e-5)
    held, moving = avatar.pose_features(points, pose), points.clone().requires_grad_()
    (still,) = torch.autograd.grad(avatar.sdf(moving, held).sum(), moving)
    assert (found - still).abs().max() > 1e-3  # so the difference matters


def test_global_motion_changes_no_shape_and_carries_the_posed_surface_along():
    avatar = make_avatar()
    pose, shift = torch.from_numpy(tiny_pose(0.7))[None], torch.tensor([[0.4, -0.2, 1.0]])
    turned = pose.clone()
    turned[0, 0] = torch.tensor([0.3, 1.2, -0.4])
    here, there = BODY(pose).joint_transforms[0], BODY(turned, shift).joint_transforms[0]
    rest, same = (avatar.canonical_mesh(transforms, COARSE) for transforms in (here, there))
    np.testing.assert_allclose(rest.vertices, same.vertices, atol=1e-4)
    motion = (there[0] @ torch.linalg.inv(here[0])).numpy()
    posed, moved = avatar.pose_mesh(rest, here), avatar.pose_mesh(rest, there)
    expected = posed.vertices @ motion[:3, :3].T + motion[:3, 3]
    np.testing.assert_allclose(moved.vertices, expected, atol=1e-5)


def test_the_bodys_own_surface_is_posed_as_the_body_is():
    """On the skin the field has the body's weights: forward LBS gives the posed body, A-pose binding and all."""
    avatar, pose = make_avatar(), torch.from_numpy(tiny_pose(1.0))[None]
    posed = BODY(pose, torch.tensor([[0.1, 0.2, 0.3]]))
    skin = Mesh(TEMPLATE.vertices.numpy(), TEMPLATE.faces.numpy())
    found = avatar.pose_mesh(skin, posed.joint_transforms[0])
    np.testing.assert_allclose(found.vertices, posed.vertices[0].numpy(), atol=2e-3)
    assert np.abs(found.vertices - posed.vertices[0].numpy()).mean() < 1e-4


def test_samples_lie_on_the_posed_mesh_with_its_normals_outwards():
    avatar = make_avatar()
    mesh = avatar.pose_mesh(avatar.canonical_mesh(REST[0], COARSE), REST[0])
    cloud, again = sample_mesh(mesh, 3000, seed=1), sample_mesh(mesh, 3000, seed=1)
    np.testing.assert_array_equal(cloud.points, again.points)
    distance, _ = cKDTree(mesh.vertices).query(cloud.points)
    assert distance.max() < (BOX[1] - BOX[0]).max() / 32  # no triangle is larger than its cell
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    outwards = cloud.points - cloud.points.mean(axis=0)
    assert (np.einsum("nc,nc->n", outwards, cloud.normals) > 0).mean() > 0.9


def test_a_coloured_avatar_colours_its_meshes_and_keeps_the_colours_when_posed():
    avatar = make_avatar(colored=True)
    mesh = avatar.canonical_mesh(REST[0], COARSE)
    assert mesh.colors.shape == mesh.vertices.shape and (mesh.colors >= 0).all() and (mesh.colors <= 1).all()
    np.testing.assert_array_equal(avatar.pose_mesh(mesh, WRIST[0]).colors, mesh.colors)
    vertices = torch.from_numpy(mesh.vertices[:5])[None]
    np.testing.assert_allclose(mesh.colors[:5], avatar.colors(vertices, REST)[0].detach().numpy(), atol=1e-5)
    assert make_avatar().canonical_mesh(REST[0], COARSE).colors is None


def test_the_field_is_frozen_and_the_state_comes_back():
    avatar, other = make_avatar(), make_avatar()
    with torch.no_grad():
        other.sdf.mlp.head.bias += 1
    assert not any(parameter.requires_grad for parameter in avatar.field.parameters())
    other.load_state_dict(avatar.state_dict())
    points = torch.rand(1, 20, 3)
    torch.testing.assert_close(other(points, REST), avatar(points, REST))


def test_wrong_joints_and_options_are_refused():
    avatar = make_avatar()
    with pytest.raises(AvatarError, match="joint_transforms"):
        avatar.canonical_mesh(REST[0, :5], COARSE)
    with pytest.raises(AvatarError, match="rings"):
        ImplicitConfig(rings=-1)
    with pytest.raises(AvatarError, match="without texture"):
        avatar.colors(torch.rand(1, 3, 3), REST)
