"""Metrics against closed forms and slow loops, and what they must not depend on."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from avatar.checks import AvatarError
from avatar.evaluation.metrics import (
    DISC_NEIGHBOURS,
    METRIC_NAMES,
    METRICS,
    PENETRATION_POINTS,
    SKIN_TOLERANCE,
    SPREAD_NEIGHBOURS,
    Comparison,
    f_score,
    find_metrics,
    mean_acceleration,
    neighbour_spread,
    scan_to_discs,
)
from avatar.records import Mesh, PointCloud, Scan

FRAME_METRICS = [name for name, metric in METRICS.items() if not metric.sequential]
SCAN_METRICS = [name for name in FRAME_METRICS if not (METRICS[name].needs_body or METRICS[name].needs_mesh)]
RENDERED = {"normal_map", "silhouette"}  # of views that stand still


def plane(height=0.0, shift=0.0, spacing=0.1, size=12, normal=(0.0, 1.0, 0.0)):
    x, z = np.meshgrid(np.arange(size) * spacing + shift, np.arange(size) * spacing)
    points = np.stack([x, np.full_like(x, height), z], axis=-1).reshape(-1, 3)
    return points, np.broadcast_to(np.array(normal), points.shape)


def random_cloud(count, seed):
    random = np.random.default_rng(seed)
    normals = random.normal(size=(count, 3))
    return random.normal(size=(count, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def compare(prediction, scan, **extra):
    return Comparison(PointCloud(*prediction), Scan(*scan), **extra)


def measure(name, comparison):
    return float(METRICS[name].measure(comparison))


def test_identical_clouds_score_perfectly():
    comparison = compare(plane(), plane())
    for name in SCAN_METRICS:
        best = {"uniformity": measure("uniformity", comparison)}.get(name, float(METRICS[name].higher_is_better))
        assert measure(name, comparison) == pytest.approx(best, abs=1e-12), name


def test_parallel_planes():
    d = 0.007
    comparison = compare(plane(height=d), plane())
    expected = {"cd_point": 2 * d**2, "cd_pop": 2 * d**2, "s2m_cm": 100 * d, "normal_l1": 0, "normal_consistency": 0}
    expected |= {"f_score_5mm": 0, "f_score_1cm": 1}
    for name, value in expected.items():
        assert measure(name, comparison) == pytest.approx(value, abs=1e-12), name


def test_sliding_in_the_plane_costs_the_plane_variant_one_direction_only():
    s = 0.03  # less than half the spacing: nearest points are the shifted ones
    comparison = compare(plane(shift=s), plane())
    assert measure("cd_point", comparison) == pytest.approx(2 * s**2)
    assert measure("cd_pop", comparison) == pytest.approx(s**2)
    assert measure("s2m_cm", comparison) == pytest.approx(0, abs=1e-12)


def test_rotated_normals():
    angle = 0.4
    comparison = compare(plane(normal=(math.sin(angle), math.cos(angle), 0)), plane())
    l1 = math.sin(angle) + 1 - math.cos(angle)
    assert measure("normal_l1", comparison) == pytest.approx(l1)
    assert measure("normal_l1_mean", comparison) == pytest.approx(l1 / 3)
    assert measure("normal_consistency", comparison) == pytest.approx(2 * math.sin(angle / 2))


def test_metrics_are_shown_in_the_unit_that_their_scale_gives():
    scales = {"1e-4 m²": 1e4, "1e-1": 10, "cm": 1, "%": 100, "mm": 1e3, "mm/frame²": 1e3, "1": 1, "°": 1}
    assert {name: metric.scale for name, metric in METRICS.items()} == {
        name: scales[metric.shown_in] for name, metric in METRICS.items()
    }
    higher = {name for name, metric in METRICS.items() if metric.higher_is_better}
    assert higher == {"f_score_5mm", "f_score_1cm", "silhouette"}


def test_normals_are_scaled_to_length_one():
    points, normals = plane()
    assert measure("normal_l1", compare((points, 3 * normals), plane())) == 0


def slow_scores(prediction, scan):
    """Every neighbour metric by loops over all pairs."""
    (points, normals), (scan, scan_normals) = prediction, scan
    gaps = [[math.dist(p, s) for s in scan] for p in points]
    to_scan = [min(range(len(scan)), key=row.__getitem__) for row in gaps]
    to_points = [min(range(len(points)), key=lambda i, j=j: gaps[i][j]) for j in range(len(scan))]
    forth = [gaps[i][j] for i, j in enumerate(to_scan)]
    back = [gaps[i][j] for j, i in enumerate(to_points)]
    planes = [float(np.dot(points[i] - scan[j], scan_normals[j])) ** 2 for i, j in enumerate(to_scan)]
    scores = {
        "cd_point": np.mean(np.square(forth)) + np.mean(np.square(back)),
        "cd_pop": np.mean(np.square(back)) + np.mean(planes),
        "normal_l1": np.mean([np.abs(normals[i] - scan_normals[j]).sum() for i, j in enumerate(to_scan)]),
        "normal_consistency": np.mean([math.dist(normals[i], scan_normals[j]) for j, i in enumerate(to_points)]),
    }
    spread = [np.mean(sorted(math.dist(p, q) for q in points)[1:6]) for p in points]
    radius = np.median([np.mean(sorted(math.dist(p, q) for q in points)[1:9]) for p in points])
    scores["uniformity"] = np.std(spread) / np.mean(spread)
    discs = []
    for j, i in enumerate(to_points):
        height = abs(float(np.dot(scan[j] - points[i], normals[i])))
        aside = math.sqrt(max(back[j] ** 2 - height**2, 0))
        discs.append(math.hypot(height, max(0, aside - radius)))
    areas = np.square(spread)
    scores["cd_even"] = np.dot(areas, np.square(forth)) / areas.sum() + np.mean(np.square(back))
    spacing = np.median([np.mean(sorted(math.dist(s, t) for t in scan)[1:9]) for s in scan])
    radius = spacing * math.sqrt(len(scan) / len(points))
    holes = []
    for j, i in enumerate(to_points):
        height = abs(float(np.dot(scan[j] - points[i], normals[i])))
        aside = math.sqrt(max(back[j] ** 2 - height**2, 0))
        holes.append(math.hypot(height, max(0, aside - radius)) > 0.01)
    return scores | {"s2m_cm": 100 * np.mean(discs), "holes": np.mean(holes)}


def test_agrees_with_slow_loops():
    prediction, scan = random_cloud(90, 0), random_cloud(70, 1)
    comparison = compare(prediction, scan)
    for name, value in slow_scores(prediction, scan).items():
        assert measure(name, comparison) == pytest.approx(value, rel=1e-9), name


def test_order_of_points_does_not_matter():
    prediction, scan = random_cloud(80, 2), random_cloud(60, 3)
    orders = np.random.default_rng(5).permutation(80), np.random.default_rng(6).permutation(60)
    mixed = [(points[ids], normals[ids]) for (points, normals), ids in zip((prediction, scan), orders)]
    for name in SCAN_METRICS:
        assert measure(name, compare(*mixed)) == pytest.approx(measure(name, compare(prediction, scan))), name


def test_rigid_motion_does_not_matter_except_to_l1_norms():
    prediction, scan = random_cloud(80, 2), random_cloud(60, 3)
    rotation, shift = Rotation.from_rotvec([0.3, 1.1, -0.4]).as_matrix(), np.array([3.0, -1, 2])
    moved = [(points @ rotation.T + shift, normals @ rotation.T) for points, normals in (prediction, scan)]
    for name in set(SCAN_METRICS) - {"normal_l1", "normal_l1_mean"} - RENDERED:
        assert measure(name, compare(*moved)) == pytest.approx(measure(name, compare(prediction, scan))), name


def test_f_score_counts():
    to_scan = torch.tensor([0.001, 0.004, 0.006, 0.02])  # 2 of 4 within 5 mm
    to_points = torch.tensor([0.005, 0.03, 0.04, 0.05, 0.06])  # 1 of 5
    assert float(f_score(to_scan, to_points, 5e-3)) == pytest.approx(2 * 0.5 * 0.2 / 0.7)
    assert float(f_score(to_scan + 1, to_points, 5e-3)) == 0
    for name, threshold in (("f_score_5mm", 0.005), ("f_score_1cm", 0.01)):
        for height, score in ((0.99 * threshold, 1), (1.01 * threshold, 0)):
            assert measure(name, compare(plane(height), plane())) == score


def test_disc_distance_sees_a_hole_that_planes_would_hide():
    normals = torch.tensor([[0.0, 1.0, 0.0]])
    scan = torch.tensor([[0.10, 0.0, 0.0], [0.01, 0.03, 0.0]])
    nearest = torch.zeros(2, dtype=torch.long)
    distance = scan_to_discs(scan, torch.zeros(1, 3), normals, nearest, radius=0.02)
    assert distance.tolist() == pytest.approx([0.08, 0.03])


def sphere_body(radius):
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return Mesh(np.array(mesh.vertices), np.array(mesh.faces))


def test_penetration_into_a_sphere(sphere_cloud):
    points, normals = sphere_cloud(2000, 1.0, 0)
    points[:500] *= 0.99
    points[500:700] *= 0.97
    points[700:900] *= 0.9995  # within the skin's tolerance
    comparison = compare((points, normals), (points, normals), body=sphere_body(1.0))
    assert measure("penetration_share", comparison) == pytest.approx(0.35)
    assert measure("penetration_depth", comparison) == pytest.approx((500 * 0.01 + 200 * 0.03) / 700, abs=3e-4)


def test_penetration_is_measured_all_over_a_large_prediction(sphere_cloud):
    """Of more points than are tested a frame an even share is, not the first ones: they come patch by patch."""
    points, normals = sphere_cloud(2 * PENETRATION_POINTS + 500, 1.05, 0)
    points[-3000:] *= 0.95 / 1.05
    comparison = compare((points, normals), (points[:9], normals[:9]), body=sphere_body(1.0))
    assert PENETRATION_POINTS / 2 < len(comparison.depths) <= PENETRATION_POINTS
    assert measure("penetration_share", comparison) == pytest.approx(3000 / len(points), abs=1e-3)
    assert measure("penetration_depth", comparison) == pytest.approx(0.05, abs=1e-3)


def test_no_penetration_outside_and_none_of_the_body_itself(sphere_cloud):
    points, normals = sphere_cloud(500, 1.2, 0)
    comparison = compare((points, normals), (points, normals), body=sphere_body(1.0))
    assert measure("penetration_share", comparison) == measure("penetration_depth", comparison) == 0


def test_penetration_without_a_body_says_so():
    with pytest.raises(AvatarError, match="posed bare body"):
        measure("penetration_share", compare(plane(), plane()))


@pytest.mark.parametrize("radius", [1.02, 0.98])
def test_mesh_prediction_is_measured_by_its_surface(sphere_cloud, radius):
    scan = sphere_cloud(400, radius, 0)
    mesh = sphere_body(1.0)
    comparison = compare(sphere_cloud(50, 3.0, 1), scan, mesh=mesh)
    assert measure("s2m_cm", comparison) == pytest.approx(2.0, abs=0.05)
    assert measure("normal_consistency", comparison) < 0.03


def test_uniformity_of_a_ring_is_zero_and_of_random_points_is_not(sphere_cloud):
    turn = torch.arange(40).double() * (2 * math.pi / 40)
    ring = torch.stack([turn.cos(), turn.sin(), 0 * turn], dim=1)
    assert float(neighbour_spread(ring)) == pytest.approx(0, abs=1e-9)
    assert float(neighbour_spread(torch.from_numpy(sphere_cloud(800, 1.0, 0)[0]))) > 0.2


def test_uniformity_of_two_spacings():
    """Half the points with neighbours at 1, half at 3: deviation 1 over mean 2."""
    pairs = torch.tensor([[0.0, 0, 0], [1, 0, 0], [100, 0, 0], [103, 0, 0]])
    assert float(neighbour_spread(pairs, k=1)) == pytest.approx(0.5)


def test_uniformity_counts_a_point_as_no_neighbour_of_itself_even_among_duplicates():
    assert float(neighbour_spread(torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0]]), k=1)) == pytest.approx(2**0.5)


def test_jitter_is_zero_for_even_motion_and_the_acceleration_for_a_fall():
    start = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)).double()
    times = torch.arange(5.0).double()[:, None, None]
    velocity, gravity = torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0.0, -0.02, 0.0])
    assert float(mean_acceleration(start + velocity * times)) == pytest.approx(0, abs=1e-12)
    assert float(mean_acceleration(start + velocity * times + gravity * times**2 / 2)) == pytest.approx(0.02)
    with pytest.raises(AvatarError, match="3 frames"):
        mean_acceleration(start[None])


def test_unknown_metrics_are_named_with_all_there_are():
    with pytest.raises(AvatarError, match=r"chamferr.*cd_point.*jitter"):
        find_metrics(["cd_point", "chamferr"])


def test_every_metric_is_defined():
    assert tuple(METRICS) == METRIC_NAMES
    for name, metric in METRICS.items():
        assert metric.name == name
        assert len(metric.definition) > 40 and metric.definition.endswith(".")
    defined = {
        "s2m_cm": f"distance to {DISC_NEIGHBOURS} neighbours",
        "uniformity": f"distance to {SPREAD_NEIGHBOURS} nearest neighbours",
        "penetration_share": f"more than {1e3 * SKIN_TOLERANCE:g} mm under",
    }
    assert all(part in METRICS[name].definition for name, part in defined.items())
    assert f"at most {PENETRATION_POINTS:,} points" in METRICS["penetration_share"].definition


@pytest.mark.parametrize(
    ("points", "normals", "message"),
    [
        (np.array([[0, np.nan, 0]]), np.array([[0.0, 1, 0]]), "prediction points.*NaN"),
        (np.zeros((1, 3)), np.array([[0.0, np.inf, 0]]), "prediction normals.*NaN or infinite"),
        (np.zeros((0, 3)), np.zeros((0, 3)), "empty"),
        (np.zeros((2, 3)), np.ones((3, 3)), "prediction normals.*N=2"),
        (np.zeros((2, 3)), np.zeros((2, 3)), "2 of 2 without length"),
    ],
)
def test_invalid_predictions_are_refused(points, normals, message):
    with pytest.raises(AvatarError, match=message):
        compare((points, normals), plane())


def test_a_cloud_too_small_for_its_spread_says_so():
    with pytest.raises(AvatarError, match="more than 5 points"):
        measure("uniformity", compare((np.zeros((4, 3)), np.ones((4, 3))), plane()))
