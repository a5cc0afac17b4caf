"""Scans made ready: the root frame, poses from transforms, edges that leave out hollows, batches that repeat."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from limbs import RADIUS, SLEEVE, arm_frame, arm_template

from avatar.body.skinning import chain_transforms, skin_transforms
from avatar.canonical.fields import bounding_box
from avatar.canonical.scans import (
    CONCAVE,
    DrawConfig,
    draw_batch,
    local_pose,
    mean_curvature,
    prepare_scan,
    smooth_edges,
)
from avatar.geometry.transforms import assemble_transform, rotation_from_axis_angle, transform_points
from avatar.records import BodyFit, Scan

COUNTS = DrawConfig(scan=30, body=20, edges=10, pool=500)


def moved(frame, turn, shift):
    """The same frame after a rigid motion of everything in it."""
    motion = assemble_transform(rotation_from_axis_angle(torch.tensor(turn)), torch.tensor(shift))

    def carry(points):
        return transform_points(motion, torch.from_numpy(points)).numpy()

    body, scan = frame.body, frame.scan
    transforms = (motion @ torch.from_numpy(body.joint_transforms)).numpy()
    fit = BodyFit(carry(body.vertices), body.vertex_transforms, transforms, body.pose_vertices, body.translation)
    normals = (torch.from_numpy(scan.normals) @ motion[:3, :3].T).numpy()
    return replace(frame, body=fit, scan=replace(scan, points=carry(scan.points), normals=normals))


def test_global_motion_makes_no_difference():
    frame, template = arm_frame(0.8, 0.3), arm_template()
    here = prepare_scan(frame, template, 500)
    there = prepare_scan(moved(frame, [1.0, -2.0, 0.5], [30.0, -4.0, 7.0]), template, 500)
    for name in ("points", "edges", "body", "canonical_body", "joint_transforms", "pose", "box"):
        torch.testing.assert_close(getattr(there, name), getattr(here, name), atol=2e-5, rtol=1e-5)
    assert torch.equal(there.nearest, here.nearest)


def test_root_stays_where_it_is_at_rest_and_pose_comes_from_transforms_alone():
    scan = prepare_scan(arm_frame(0.8, -0.3), arm_template(), 500)
    torch.testing.assert_close(scan.joint_transforms[0], torch.eye(4), atol=1e-6, rtol=0)
    torch.testing.assert_close(scan.pose, torch.tensor([0.8, 0, 0, -0.3, 0, 0]), atol=1e-5, rtol=0)
    pose = 0.7 * torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(0))
    chained = chain_transforms(pose, torch.rand(4, 3), (-1, 0, 1, 1))
    torch.testing.assert_close(local_pose(chained[0], (-1, 0, 1, 1)), pose[0, 1:].flatten(), atol=1e-5, rtol=1e-4)


def test_canonical_body_is_the_template_plus_what_the_pose_added():
    frame, template = arm_frame(0.8), arm_template()
    torch.testing.assert_close(prepare_scan(frame, template, 500).canonical_body, template.vertices, atol=1e-5, rtol=0)
    added = torch.zeros_like(template.vertices)
    added[:, 2] = 0.01  # as a pose blendshape would, before skinning
    posed = skin_transforms(template.weights, torch.from_numpy(frame.body.joint_transforms)[None])[0]
    bulged = replace(frame.body, vertices=transform_points(posed, template.vertices + added).numpy())
    scan = prepare_scan(replace(frame, body=bulged), template, 500)
    torch.testing.assert_close(scan.canonical_body, template.vertices + added, atol=1e-5, rtol=0)


@pytest.mark.parametrize("mesh", [False, True])
def test_points_lie_on_the_scan_and_know_their_nearest_vertex(mesh):
    frame = arm_frame(0.0, mesh=mesh)
    if not mesh:  # as a scanner's stripes: whatever is drawn must not be the first ones
        order = np.argsort(frame.scan.canonical[:, 1])
        frame = replace(frame, scan=Scan(frame.scan.points[order], frame.scan.normals[order]))
    scan = prepare_scan(frame, arm_template(), 400)
    assert len(scan.points) == len(scan.edges) == 400
    assert float(scan.edges[..., 1].min()) < 0.05 and float(scan.edges[..., 1].max()) > 0.95
    around = scan.points[:, [0, 2]].norm(dim=1)
    assert float(around.max()) <= SLEEVE + 1e-5 and float(around.min()) > 0.98 * SLEEVE  # a tube of flat faces
    assert float(scan.points[:, 1].min()) < 0.05 and float(scan.points[:, 1].max()) > 0.95
    distances = torch.cdist(scan.points, scan.body)
    torch.testing.assert_close(distances.gather(1, scan.nearest[:, None])[:, 0], distances.min(dim=1).values)
    assert float(distances.min()) == pytest.approx(SLEEVE - RADIUS, abs=0.004)


def test_body_vertices_are_drawn_by_area_and_the_box_is_the_posed_body_s():
    frame, template = arm_frame(0.8), arm_template()
    half = replace(template, faces=template.faces[template.faces.amax(dim=1) < 480])
    scan = prepare_scan(frame, half, 500)
    assert 400 < scan.vertices.max() < 480  # the others have no triangle, and no area
    torch.testing.assert_close(scan.box, bounding_box(scan.body))


def sphere(count: int, radius: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals, normals


@pytest.mark.parametrize("count", [500, 25_000])
def test_mean_curvature_of_a_sphere_is_exact_and_turns_sign_with_it(count):
    points, normals = sphere(count, 0.25)
    np.testing.assert_allclose(mean_curvature(points, normals), 4.0, rtol=1e-6)
    np.testing.assert_allclose(mean_curvature(points, -normals), -4.0, rtol=1e-6)


def test_curvature_is_measured_all_over_a_large_scan():
    """The neighbours come from a thinned cloud, thinned evenly: a part that stands last in the file has its own."""
    (large, outward), (small, out) = sphere(12_000, 0.25), sphere(12_000, 0.1)
    found = mean_curvature(np.concatenate([large, small + 5]), np.concatenate([outward, out]))
    np.testing.assert_allclose(found, np.repeat([4.0, 10.0], 12_000), rtol=1e-6)


def test_mean_curvature_of_a_tube_is_half_of_one_over_its_radius_and_of_a_plane_nothing():
    scan = arm_frame(0.0).scan
    inner = np.abs(scan.canonical[:, 1] - 0.5) < 0.4
    assert np.median(mean_curvature(scan.points, scan.normals)[inner]) == pytest.approx(0.5 / SLEEVE, rel=0.15)
    flat = np.random.default_rng(0).random((300, 3)) * [1, 0, 1]
    np.testing.assert_allclose(mean_curvature(flat, np.tile([0.0, 1, 0], (300, 1))), 0, atol=1e-9)


def crease(mesh: bool) -> Scan:
    """Two planes that meet at a right angle at x = 0, their normals to the inside of it; 1 cm between points."""
    steps = np.arange(-20, 21) / 100
    along, across = np.meshgrid(steps, np.arange(20) / 100, indexing="ij")
    points = np.stack([along, np.abs(along), across], axis=-1).reshape(-1, 3) / [2**0.5, 2**0.5, 1]
    sides = np.sign(along).reshape(-1, 1)
    normals = np.concatenate([-sides, np.where(sides, 1, 2**0.5), 0 * sides], axis=1) / 2**0.5
    ids = np.arange(len(points)).reshape(along.shape)
    faces = np.stack([ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:]], axis=-1).reshape(-1, 3)
    return Scan(points, normals, faces if mesh else None)


@pytest.mark.parametrize("mesh", [False, True])
def test_edges_in_a_hollow_are_left_out_and_those_over_a_ridge_are_not(mesh):
    scan, rng = crease(mesh), np.random.default_rng(0)
    assert mean_curvature(scan.points, scan.normals).min() < -CONCAVE

    def at_crease(edges):
        return (np.abs(scan.points[edges][..., 0]) < 0.004).any(axis=1).sum()

    kept = smooth_edges(scan, 10**6, rng)
    assert len(kept) > 300 and at_crease(kept) == 0
    assert at_crease(smooth_edges(replace(scan, normals=-scan.normals), 10**6, rng)) > 50
    lengths = np.linalg.norm(np.diff(scan.points[kept], axis=1)[:, 0], axis=1)
    assert lengths.min() > 0 and lengths.max() < 0.025
    assert 80 < len(smooth_edges(scan, 100, rng)) <= 100


def test_batches_repeat_with_the_random_state_and_keep_what_belongs_together():
    template = arm_template()
    scans = [prepare_scan(arm_frame(bend), template, 500) for bend in (0.0, 0.5, 1.0)]

    def draw(seed):
        return draw_batch(scans, [2, 0], template.weights, COUNTS, torch.Generator().manual_seed(seed))

    batch = draw(1)
    assert batch.frames.tolist() == [2, 0]
    assert torch.equal(batch.points, draw(1).points) and not torch.equal(batch.points, draw(2).points)
    assert batch.edges.shape == (2, 10, 2, 3)
    posed = skin_transforms(batch.body_weights, batch.joint_transforms)
    torch.testing.assert_close(transform_points(posed, batch.canonical_body), batch.body, atol=1e-5, rtol=0)
    near = torch.cdist(batch.points[0], scans[2].body).argmin(dim=1)
    assert torch.equal(batch.nearest_weights[0], template.weights[near])
    assert torch.equal(batch.boxes[1], scans[0].box) and torch.equal(batch.poses[0], scans[2].pose)
