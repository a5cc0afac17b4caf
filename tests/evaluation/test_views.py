"""Rendered normals, silhouettes, holes and even Chamfer of clouds whose answer is known."""

import math

import numpy as np
import pytest
import torch

from avatar.evaluation.metrics import METRICS, Comparison
from avatar.evaluation.shapes import PIXELS, render_normals, view_axes, view_frame
from avatar.records import PointCloud, Scan


def sphere(count, seed=0, center=(0.0, 0.0, 0.0), radius=1.0):
    """Evenly spread points (Fibonacci), turned at random."""
    steps = np.arange(count) + 0.5
    height, turn = 1 - 2 * steps / count, math.pi * (1 + math.sqrt(5)) * steps
    aside = np.sqrt(1 - height**2)
    normals = np.stack([aside * np.cos(turn), height, aside * np.sin(turn)], axis=1)
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    normals = normals @ rotation.T
    return normals * radius + np.array(center), normals


def measure(name, prediction, scan):
    return float(METRICS[name].measure(Comparison(PointCloud(*prediction), Scan(*scan))))


def test_a_sphere_is_drawn_as_discs_of_its_size_with_its_normals():
    points, normals = map(torch.from_numpy, sphere(20_000))
    center, extent = view_frame(points)
    maps = render_normals(points, normals, 0.03, center, extent)
    seen = maps.any(dim=-1)
    assert seen.sum(dim=(1, 2)) * (extent / PIXELS) ** 2 == pytest.approx(math.pi * np.ones(6), rel=0.01)
    middle = maps[:, PIXELS // 2, PIXELS // 2]
    assert (middle * view_axes()[:, 2]).sum(dim=-1).min() > math.cos(0.05)  # what faces the viewer


def test_what_is_nearer_hides_what_is_behind():
    far, near = sphere(4_000, center=(0, 0, -2)), sphere(4_000, center=(0, 0, 2), radius=0.9)
    points, normals = (torch.from_numpy(np.concatenate(parts)) for parts in zip(far, near))
    normals[:4_000] = torch.tensor([1.0, 0, 0])
    axes = view_axes()[0]
    center = torch.zeros(3, dtype=torch.float64)
    front = render_normals(points, normals, 0.08, center, 8.0)[0]
    up = 2 * float(axes[1, 2])  # the near sphere's middle in the first view, metres
    row = int(up / 8.0 * PIXELS + PIXELS / 2)
    assert front[row, PIXELS // 2] @ axes[2] > 0.99


def test_turned_normals_show_by_their_angle_and_places_do_not():
    points, normals = sphere(20_000)
    angle = 0.3
    turned = normals @ np.array(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    )
    mean = math.degrees(np.arccos((turned * normals).sum(axis=1)).mean())
    assert measure("normal_map", (points, turned), (points, normals)) == pytest.approx(mean, rel=0.1)
    assert measure("silhouette", (points, turned), (points, normals)) == pytest.approx(1, abs=0.02)
    assert measure("normal_map", sphere(20_000, seed=1), (points, normals)) < 3


def test_silhouettes_shrink_with_what_they_show():
    small = sphere(20_000, radius=0.8)
    assert measure("silhouette", small, sphere(20_000)) == pytest.approx(0.64, abs=0.01)


def test_a_cap_that_is_missing_is_a_hole_of_its_area_and_clumps_do_not_fill_it():
    scan, (points, normals) = sphere(20_000), sphere(20_000, seed=1)
    there = points[:, 1] < 0.6  # a cap of a fifth of the area is away
    kept = points[there], normals[there]
    assert measure("holes", kept, scan) == pytest.approx(0.2, abs=0.03)
    clump = points[there][:1].repeat(4_000, axis=0) + np.random.default_rng(0).normal(size=(4_000, 3)) * 1e-4
    filled = np.concatenate([kept[0], clump]), np.concatenate([kept[1], kept[1][:1].repeat(4_000, axis=0)])
    assert measure("holes", filled, scan) == pytest.approx(0.2, abs=0.03)
    assert measure("holes", sphere(5_000, seed=2), scan) == 0  # fewer points are not holes


def test_clumps_do_not_outvote_the_surface_in_even_chamfer():
    scan, (points, normals) = sphere(4_000), sphere(4_000, seed=1, radius=1.1)
    close = scan[0][:1].repeat(8_000, axis=0) + np.random.default_rng(0).normal(size=(8_000, 3)) * 1e-4
    mixed = np.concatenate([points, close]), np.concatenate([normals, scan[1][:1].repeat(8_000, axis=0)])
    honest = measure("cd_even", (points, normals), scan)
    assert measure("cd_even", mixed, scan) == pytest.approx(honest, rel=0.02)
    assert measure("cd_point", mixed, scan) < 0.75 * honest
