"""Mirrored frames are what the mirrored pose gives."""

import pytest
import torch

from avatar.body.open import open_body
from avatar.checks import AvatarError
from avatar.data.batches import mirror_batch, mirror_coins, mirror_map, swap_side
from avatar.records import Batch

FLIP = torch.tensor([-1.0, 1.0, 1.0])


def mirrored_pose(pose: torch.Tensor, joint_names) -> torch.Tensor:
    """Axis-angle vectors are axial: under x -> -x their y and z turn round, and left and right change places."""
    names = list(joint_names)
    order = [names.index(swap_side(name)) for name in names]
    return pose[:, order] * torch.tensor([1.0, -1.0, -1.0])


def posed_batch(body, pose) -> Batch:
    posed = body(pose, torch.tensor([[0.1, 0.2, 0.3]]).expand(len(pose), 3) * 0)
    scan = posed.vertices[:, ::7]
    return Batch(
        pose_vertices=posed.vertices,
        vertices=posed.vertices,
        vertex_transforms=posed.vertex_transforms,
        joint_transforms=posed.joint_transforms,
        scan_points=scan,
        scan_normals=torch.nn.functional.normalize(scan, dim=-1),
        outfit_ids=torch.zeros(len(pose)).long(),
        names=("a.0",) * len(pose),
    )


def test_mirroring_a_body_is_posing_it_mirrored():
    body = open_body("female")
    symmetry = mirror_map(body.template)
    torch.manual_seed(0)
    pose = 0.3 * torch.randn(2, 22, 3)
    batch = posed_batch(body, pose)
    seen = mirror_batch(batch, torch.tensor([True, False]), symmetry)
    expected = posed_batch(body, mirrored_pose(pose, body.joint_names))
    for name, tolerance in (("vertices", 0.01), ("pose_vertices", 0.01), ("joint_transforms", 0.02)):
        gap = (getattr(seen, name) - getattr(expected, name))[0].abs()
        assert gap.quantile(0.99) < tolerance, name
    rotated = (seen.vertex_transforms - expected.vertex_transforms)[0].abs()
    assert rotated[..., :3, :3].flatten().quantile(0.9) < 0.01 and rotated[..., 3].quantile(0.9) < 0.01
    torch.testing.assert_close(seen.scan_points[0], batch.scan_points[0] * FLIP)
    torch.testing.assert_close(seen.scan_normals[0], batch.scan_normals[0] * FLIP)
    for name, value in vars(batch).items():  # the other frame is left as it was
        assert not isinstance(value, torch.Tensor) or torch.equal(getattr(seen, name)[1], value[1]), name


def test_mirroring_twice_gives_the_frame_back():
    body = open_body("mean")
    symmetry = mirror_map(body.template)
    batch = posed_batch(body, 0.2 * torch.randn(1, 22, 3, generator=torch.Generator().manual_seed(1)))
    both = torch.tensor([True])
    again = mirror_batch(mirror_batch(batch, both, symmetry), both, symmetry)
    returned = (symmetry.vertices[symmetry.vertices] == torch.arange(len(symmetry.vertices))).nonzero()[:, 0]
    torch.testing.assert_close(again.vertices[:, returned], batch.vertices[:, returned])
    torch.testing.assert_close(again.joint_transforms, batch.joint_transforms)


def test_an_asymmetric_template_is_refused():
    template = open_body("female").with_canonical_pose(0.5 * torch.ones(22, 3)).template
    with pytest.raises(AvatarError, match=r"symmetric template.*train\.mirror=false"):
        mirror_map(template)


def test_coins_follow_from_seed_and_step():
    coins = torch.stack([mirror_coins(3, step, 8) for step in range(200)])
    assert torch.equal(coins[5], mirror_coins(3, 5, 8))
    assert not torch.equal(coins, torch.stack([mirror_coins(4, step, 8) for step in range(200)]))
    assert not torch.equal(coins[0], coins[1])
    assert 0.45 < coins.float().mean() < 0.55
