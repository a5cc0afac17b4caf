"""Local pose conditioning: gates from the kinematic tree, rotations from transforms, and nothing that leaks."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_PARENTS
from avatar.body.open import open_body
from avatar.body.registry import canonical_pose
from avatar.checks import AvatarError
from avatar.geometry.surface import interpolate, sample_surface
from avatar.geometry.transforms import fourier_features
from avatar.nn.locality import (
    LocalPoseConfig,
    LocalPoseEncoder,
    pose_gates,
    relative_rotations,
)
from avatar.records import SurfaceSamples

CONFIG = LocalPoseConfig(widths=(16, 12, 8), orders=2)


@pytest.fixture(scope="module")
def body():
    return open_body("female")


def random_pose(seed: int = 0, frames: int = 2) -> torch.Tensor:
    return 0.5 * torch.randn(frames, 22, 3, generator=torch.Generator().manual_seed(seed))


def steps_between(one: int, other: int) -> int:
    """Steps from joint to joint: up to their nearest common ancestor and down again."""
    lines = []
    for joint in (one, other):
        line = [joint]
        while line[-1]:
            line.append(SMPL_PARENTS[line[-1]])
        lines.append(line)
    return min(lines[0].index(joint) + lines[1].index(joint) for joint in lines[0] if joint in lines[1])


def test_gates_add_up_the_weights_of_joints_in_reach(body):
    gates, template = pose_gates(body.template, 4), body.template
    assert gates.shape == (len(template.vertices), 21)
    for vertex in range(0, len(template.vertices), 1001):
        for joint in range(1, 22):
            reach = sum(float(template.weights[vertex, k]) for k in range(22) if steps_between(joint, k) <= 4)
            assert float(gates[vertex, joint - 1]) == pytest.approx(reach, abs=1e-6)
    torch.testing.assert_close(pose_gates(template, 11), torch.ones_like(gates))


def test_rotations_are_the_pose_parameters_whatever_place_and_heading(body):
    pose = random_pose()
    pose[1] = 3 * torch.nn.functional.normalize(
        pose[1], dim=-1
    )  # nearly half a turn, where signs of quaternions differ
    found = relative_rotations(body(pose).joint_transforms, body.parents)
    quaternions = Rotation.from_rotvec(pose[:, 1:].reshape(-1, 3).numpy()).as_quat(canonical=True)
    expected = torch.from_numpy(quaternions).float().view(2, 21, 4) - torch.tensor([0.0, 0, 0, 1])
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
    turned = pose.clone()
    turned[:, 0] += 1.0
    again = relative_rotations(body(turned, torch.ones(2, 3)).joint_transforms, body.parents)
    torch.testing.assert_close(again, found, atol=1e-5, rtol=0)


def test_the_canonical_pose_is_all_zeros(body):
    apart = body.with_canonical_pose(canonical_pose("apart", body.joint_names))
    at_rest = apart(apart.canonical_pose[None]).joint_transforms
    assert relative_rotations(at_rest, body.parents).abs().max() < 1e-6


def test_places_are_seen_in_waves_of_powers_of_two_times_pi():
    point = torch.tensor([0.1, -0.4, 0.9])
    waves = [wave(factor * torch.pi * point) for factor in (1, 2, 4) for wave in (torch.sin, torch.cos)]
    torch.testing.assert_close(fourier_features(point, 3, torch.pi), torch.cat([point, *waves]))


def test_first_layer_equals_one_on_gated_rotations_and_positions(body):
    template = body.template
    torch.manual_seed(0)
    encoder = LocalPoseEncoder(template, CONFIG).eval()
    samples = sample_surface(template.vertices, template.faces, 50, torch.Generator().manual_seed(0))
    transforms = body(random_pose()).joint_transforms
    theta = relative_rotations(transforms, template.parents)
    gates = interpolate(pose_gates(template, 4), samples)
    gated = (gates[None, :, :, None] * theta[:, None]).flatten(2)
    places = fourier_features(interpolate(template.vertices, samples), 2, torch.pi)
    lifted = encoder.pose_layer(gated) + encoder.position_layer(places)
    torch.testing.assert_close(encoder(transforms, samples), encoder.rest(encoder.first(lifted)), atol=1e-5, rtol=1e-5)


def test_a_joint_reaches_exactly_the_vertices_its_gates_are_open_for(body):
    template = body.template
    torch.manual_seed(0)
    encoder = LocalPoseEncoder(template, CONFIG).eval()
    ids = torch.arange(0, len(template.vertices), 29)
    corners = torch.tensor([1.0, 0, 0]).expand(len(ids), 3)
    samples = SurfaceSamples(ids[:, None].expand(-1, 3), corners, torch.zeros_like(ids))
    pose, gates = random_pose(frames=1), pose_gates(template, 4)[ids]
    before = encoder(body(pose).joint_transforms, samples)[0]
    for joint in range(1, 22):
        transforms = body(pose).joint_transforms.clone()
        family = [k for k in range(22) if joint in ancestors(k)]
        turn = torch.eye(4)
        turn[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.3, -0.5, 0.4]).as_matrix())
        transforms[:, family] = turn @ transforms[:, family]  # the joint turns with all that hangs on it
        moved = (encoder(transforms, samples)[0] - before).abs().amax(dim=1)
        closed = gates[:, joint - 1] == 0
        open_most = gates[:, joint - 1] > 0.5
        assert moved[closed].max() < 1e-5 < moved[open_most].max()  # 1e-5: what hangs on it is turned there and back
        assert closed.any() or joint in (3, 6, 9)  # only the spine is within four steps of everything


def ancestors(joint: int) -> list[int]:
    line = [joint]
    while line[-1]:
        line.append(SMPL_PARENTS[line[-1]])
    return line


def test_gradients_reach_every_parameter_and_the_pose(body):
    template = body.template
    encoder = LocalPoseEncoder(template, CONFIG)
    samples = sample_surface(template.vertices, template.faces, 50, torch.Generator().manual_seed(0))
    pose = torch.zeros(2, 22, 3).requires_grad_()  # where quaternions have their corner cases
    encoder(body(pose).joint_transforms, samples).square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in encoder.parameters())
    assert pose.grad.isfinite().all() and (pose.grad[:, 1:] != 0).any()


def test_wrong_settings_are_refused(body):
    with pytest.raises(AvatarError, match="rings: expected at least 0"):
        LocalPoseConfig(rings=-1)
    with pytest.raises(AvatarError, match="widths"):
        LocalPoseConfig(widths=())
    with pytest.raises(AvatarError, match="joint_transforms: expected shape"):
        relative_rotations(torch.eye(4).expand(1, 5, 4, 4), body.parents)
