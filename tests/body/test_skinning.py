"""Linear blend skinning in closed form and its inverse."""

import pytest
import torch
from bodies import random_bind, random_pose

from avatar.body.model import SMPL_PARENTS
from avatar.body.open import open_body
from avatar.body.skinning import (
    blend_transforms,
    chain_transforms,
    check_parents,
    skin_transforms,
    tree_distances,
)
from avatar.checks import AvatarError
from avatar.geometry.transforms import invert_affine, rotation_from_axis_angle, transform_points


def transforms(batch: int = 3) -> torch.Tensor:
    bind = random_bind()
    return chain_transforms(random_pose(batch, 5), bind.joints, bind.parents)


def test_one_bone_turns_about_its_joint():
    joint, pose = torch.tensor([[1.0, 2, 3]], dtype=torch.float64), random_pose(1, 1)
    motion = chain_transforms(pose, joint, (-1,))[0, 0]
    point = torch.tensor([4.0, -1, 2], dtype=torch.float64)
    expected = rotation_from_axis_angle(pose[0, 0]) @ (point - joint[0]) + joint[0]
    torch.testing.assert_close(transform_points(motion, point), expected)
    torch.testing.assert_close(transform_points(motion, joint[0]), joint[0])


def test_children_follow_their_parents_rigidly():
    """With a still child joint, child and parent move as one."""
    joints, pose = random_pose(3, seed=1), random_pose(1, 3)
    pose[:, 2] = 0
    moved = chain_transforms(pose, joints, (-1, 0, 1))
    torch.testing.assert_close(moved[:, 2], moved[:, 1])
    torch.testing.assert_close(transform_points(moved[0, 1], joints[1]), transform_points(moved[0, 0], joints[1]))


def test_blend_of_one_hot_weights_is_the_joint():
    motion = transforms()
    torch.testing.assert_close(blend_transforms(torch.eye(5, dtype=torch.float64), motion), motion)
    bottom = blend_transforms(random_bind().weights, motion)[..., 3, :]
    torch.testing.assert_close(bottom, torch.tensor([0.0, 0, 0, 1]).double().expand_as(bottom))


def test_gradients_of_blended_transforms_and_their_inverse():
    weights, motion = random_bind().weights[:3].clone().requires_grad_(), transforms(1).requires_grad_()
    assert torch.autograd.gradcheck(blend_transforms, (weights, motion))
    assert torch.autograd.gradcheck(lambda *given: invert_affine(blend_transforms(*given)), (weights, motion))


@pytest.mark.parametrize("parents", [(), (0,), (-1, 1), (-1, -1), (-1, 2, 0)])
def test_trees_out_of_order_are_refused(parents):
    with pytest.raises(AvatarError, match="parents: expected -1 first"):
        check_parents(parents)


def test_skinning_with_the_body_s_own_weights_is_the_body_s_own():
    """Also for a body bound in another pose than its canonical one; plain LBS is not."""
    body = open_body("female")
    pose = 0.3 * random_pose(2, 22).float()
    posed, template = body(pose), body.template
    found = skin_transforms(template.weights, posed.joint_transforms, template.canonical_from_bind)
    torch.testing.assert_close(transform_points(found, template.vertices), posed.vertices, atol=2e-6, rtol=0)
    plain = skin_transforms(template.weights, posed.joint_transforms)
    assert (transform_points(plain, template.vertices) - posed.vertices).norm(dim=-1).max() > 2e-3


def search(parents: tuple[int, ...], start: int) -> list[int]:
    """Edges from one joint to all others, by walking the tree."""
    neighbours = {j: [p] if p >= 0 else [] for j, p in enumerate(parents)}
    for joint, parent in enumerate(parents):
        if parent >= 0:
            neighbours[parent].append(joint)
    found, edge = {start: 0}, [start]
    while edge:
        edge = [
            n for joint in edge for n in neighbours[joint] if n not in found and not found.update({n: found[joint] + 1})
        ]
    return [found[joint] for joint in range(len(parents))]


@pytest.mark.parametrize("parents", [(-1, 0, 1, 2), (-1, 0, 1, 0, 3), SMPL_PARENTS, (-1,)])
def test_tree_distances_are_those_of_a_search(parents):
    expected = [search(parents, joint) for joint in range(len(parents))]
    assert tree_distances(parents).tolist() == expected
