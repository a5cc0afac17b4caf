"""BodyModel: smplx.lbs and loops as oracles, closed forms, canonical poses, inverses, gradients, bad input."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from bodies import random_bind, random_body, random_model, random_pose
from reference import skin_loop
from smplx.lbs import lbs

from avatar.body.model import BodyModel
from avatar.body.skinning import blend_transforms
from avatar.body.smpl import joint_tree
from avatar.checks import AvatarError
from avatar.geometry.transforms import rotation_from_axis_angle, transform_points
from avatar.records import Template

VARIANTS = [(canonical, correctives) for canonical in (False, True) for correctives in (False, True)]


def stick() -> Template:
    """Two bones along y with a hinge at y = 1; one vertex at each end and one shared at the hinge."""
    return Template(
        vertices=torch.tensor([[0.0, 0, 0], [0, 1, 0], [0, 2, 0]], dtype=torch.float64),
        faces=torch.tensor([[0, 1, 2]]),
        weights=torch.tensor([[1.0, 0], [0.5, 0.5], [0, 1]], dtype=torch.float64),
        joints=torch.tensor([[0.0, 0, 0], [0, 1, 0]], dtype=torch.float64),
        parents=(-1, 0),
        joint_names=("root", "hinge"),
    )


def test_one_hinge_in_closed_form():
    """A quarter turn about z at the hinge lays the upper bone along -x; one at the root lays all along -x."""
    quarter = torch.pi / 2
    pose = torch.zeros(2, 2, 3, dtype=torch.float64)
    pose[0, 1, 2] = quarter
    pose[1, 0, 2] = quarter
    shift = torch.tensor([[0.0, 0, 0], [0, 0, 5]], dtype=torch.float64)
    posed = BodyModel(stick())(pose, shift)
    hinge = [[0.0, 0, 0], [0, 1, 0], [-1, 1, 0]]
    root = [[0.0, 0, 5], [-1, 0, 5], [-2, 0, 5]]
    torch.testing.assert_close(posed.vertices, torch.tensor([hinge, root], dtype=torch.float64))
    still = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(posed.joint_transforms[0, 0], still)
    turned = torch.tensor([[0.0, -1, 0, 1], [1, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(posed.joint_transforms[0, 1], turned)


def test_agrees_with_loop_on_a_random_tree():
    bind, pose = random_bind(), random_pose(2, 5)
    posed = BodyModel(bind)(pose)
    for b in range(2):
        arrays = (t.numpy() for t in (bind.vertices, bind.weights, bind.joints))
        expected = skin_loop(*arrays, bind.parents, pose[b].numpy())
        np.testing.assert_allclose(posed.vertices[b].numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("correctives", [False, True])
@pytest.mark.parametrize("canonical", [False, True])
def test_agrees_with_smplx_on_random_parameters(canonical, correctives):
    model = random_model()
    names, parents = joint_tree("smpl")
    tensors = {name: torch.tensor(value) for name, value in vars(model).items() if value.dtype == np.float64}
    betas, pose = (
        torch.randn(1, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(0)),
        random_pose(3, 24),
    )
    posedirs = tensors["posedirs"] * correctives
    expected, expected_joints = lbs(
        betas.expand(3, -1),
        pose.flatten(1),
        tensors["v_template"][None],
        tensors["shapedirs"],
        posedirs.flatten(0, 1).T,
        tensors["J_regressor"],
        torch.tensor(parents),
        tensors["weights"],
    )
    shaped = tensors["v_template"] + tensors["shapedirs"] @ betas[0]
    joints = tensors["J_regressor"] @ shaped
    bind = Template(shaped, torch.tensor(model.f).long(), tensors["weights"], joints, parents, names)
    body = BodyModel(
        bind, None, random_pose(24, seed=7) if canonical else None, tensors["posedirs"] if correctives else None
    )
    posed = body(pose)
    torch.testing.assert_close(posed.vertices, expected)
    torch.testing.assert_close(transform_points(posed.joint_transforms, body.template.joints), expected_joints)
    torch.testing.assert_close(transform_points(posed.vertex_transforms, body.template.vertices), expected)


@pytest.mark.parametrize(("canonical", "correctives"), VARIANTS)
def test_vertex_transforms_carry_the_template_to_the_posed_body_and_back(canonical, correctives):
    body = random_body(canonical, correctives)
    posed = body(random_pose(4, 5), random_pose(4))
    torch.testing.assert_close(transform_points(posed.vertex_transforms, body.template.vertices), posed.vertices)
    back = transform_points(torch.linalg.inv(posed.vertex_transforms), posed.vertices)
    torch.testing.assert_close(back, body.template.vertices.expand_as(back), atol=1e-8, rtol=0)


@pytest.mark.parametrize(("canonical", "correctives"), VARIANTS)
def test_template_posed_at_the_canonical_pose_is_the_template(canonical, correctives):
    body = random_body(canonical, correctives)
    posed = body(body.canonical_pose[None])
    torch.testing.assert_close(posed.vertices[0], body.template.vertices)
    still = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(posed.joint_transforms[0], still.expand(5, 4, 4))
    torch.testing.assert_close(posed.vertex_transforms[0], still.expand(40, 4, 4))


@pytest.mark.parametrize("correctives", [False, True])
def test_posed_body_does_not_depend_on_the_canonical_pose(correctives):
    first, second = random_body(False, correctives), random_body(True, correctives)
    again = second.with_canonical_pose(torch.zeros(5, 3))
    pose, shift = random_pose(2, 5, seed=8), random_pose(2)
    torch.testing.assert_close(second(pose, shift).vertices, first(pose, shift).vertices)
    torch.testing.assert_close(again(pose, shift).vertex_transforms, first(pose, shift).vertex_transforms)
    assert not torch.allclose(first.template.vertices, second.template.vertices, atol=1e-2)


def test_bind_pose_is_reached_through_its_joint_motions():
    """A body bound away from zero: its zero pose is the bind template skinned by zero_from_bind."""
    body = random_body()
    zero = body(torch.zeros(1, 5, 3, dtype=torch.float64))
    expected = torch.einsum("vj,jab,vb->va", body.weights, body.zero_from_bind[:, :3, :3], body.bind_vertices)
    expected = expected + body.weights @ body.zero_from_bind[:, :3, 3]
    torch.testing.assert_close(zero.vertices[0], expected)
    torch.testing.assert_close(zero.vertices[0], body.template.vertices)
    assert not torch.allclose(zero.vertices[0], body.bind_vertices, atol=1e-2)


def test_root_rotation_and_translation_move_the_body_rigidly():
    body, pose, shift = random_body(correctives=True), random_pose(1, 5), random_pose(1, seed=5)
    flat = pose.clone()
    flat[:, 0] = 0
    rotation, pivot = rotation_from_axis_angle(pose[0, 0]), body.zero_joints[0]
    expected = (body(flat).vertices - pivot) @ rotation.T + pivot + shift
    torch.testing.assert_close(body(pose, shift).vertices, expected)


def test_batch_of_one_is_batch_of_many():
    body, pose, shift = random_body(True, True), random_pose(4, 5), random_pose(4)
    many = body(pose, shift)
    for b in range(4):
        one = body(pose[b : b + 1], shift[b : b + 1])
        for name in ("vertices", "joint_transforms", "vertex_transforms"):
            torch.testing.assert_close(getattr(one, name)[0], getattr(many, name)[b])


@pytest.mark.parametrize("pose", [random_pose(1, 5), torch.zeros(1, 5, 3, dtype=torch.float64)])
def test_gradients_with_respect_to_pose_and_translation(pose):
    body = random_body(True, True)

    def outputs(pose, shift):
        posed = body(pose, shift)
        return posed.vertices[:, :3], posed.joint_transforms, posed.vertex_transforms[:, :2]

    inputs = (pose.clone().requires_grad_(), random_pose(1).requires_grad_())
    assert torch.autograd.gradcheck(outputs, inputs)


def test_float32_and_float64_agree_and_buffers_follow():
    body, pose = random_body(True, True), random_pose(2, 5)
    wide = body(pose).vertices
    narrow = body.float()(pose.float()).vertices
    assert narrow.dtype == torch.float32 and body.template.vertices.dtype == torch.float32
    torch.testing.assert_close(narrow.double(), wide, atol=1e-5, rtol=0)


def test_plain_skinning_where_bind_is_canonical():
    """Then, and only then, blending the joint transforms gives the vertex transforms."""
    body, pose = BodyModel(random_bind()), random_pose(2, 5)
    posed = body(pose)
    torch.testing.assert_close(blend_transforms(body.weights, posed.joint_transforms), posed.vertex_transforms)
    away = random_body(True)
    posed = away(pose)
    assert not torch.allclose(blend_transforms(away.weights, posed.joint_transforms), posed.vertex_transforms, atol=0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": torch.full((40, 5), 0.3, dtype=torch.float64)}, "rows summing to 1"),
        ({"weights": torch.tensor([[2.0, -1, 0, 0, 0]]).double().expand(40, 5)}, "no negative value"),
        ({"weights": torch.zeros(39, 5, dtype=torch.float64)}, "weights: expected shape"),
        ({"vertices": torch.full((40, 3), float("nan"), dtype=torch.float64)}, "vertices: expected finite"),
        ({"joints": torch.zeros(4, 3, dtype=torch.float64)}, "joints: expected shape"),
        ({"parents": (-1, 0, 3, 1, 0)}, "every parent before its child"),
        ({"parents": (-1, -1, 0, 0, 0)}, "every parent before its child"),
        ({"parents": (-1, 0, 0, 0)}, "parents: expected 5 entries"),
        ({"joint_names": ("a",)}, "joint_names: expected 5 entries"),
        ({"faces": torch.tensor([[0, 1, 40]])}, r"faces: expected vertex indices in \[0, 40\), got 0 to 40"),
        ({"faces": torch.tensor([[0, 1, -1]])}, "got -1 to 1"),
        ({"faces": torch.zeros(0, 3).long()}, "faces: expected triangles of whole numbers, got 0"),
    ],
)
def test_templates_that_cannot_be_posed_are_refused(change, message):
    with pytest.raises(AvatarError, match=message):
        BodyModel(replace(random_bind(), **change))


def test_other_arguments_are_checked():
    bind = random_bind()
    with pytest.raises(AvatarError, match="zero_from_bind"):
        BodyModel(bind, torch.eye(4).expand(4, 4, 4))
    with pytest.raises(AvatarError, match="canonical_pose"):
        BodyModel(bind, None, torch.zeros(4, 3))
    with pytest.raises(AvatarError, match="pose_directions"):
        BodyModel(bind, None, None, torch.zeros(40, 3, 45))
    body = BodyModel(bind)
    with pytest.raises(AvatarError, match="pose: expected shape"):
        body(torch.zeros(1, 6, 3))
    with pytest.raises(AvatarError, match="translation: expected shape"):
        body(torch.zeros(2, 5, 3, dtype=torch.float64), torch.zeros(1, 3))
