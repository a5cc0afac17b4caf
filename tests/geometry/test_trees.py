"""KD-trees against brute force, with denormal numbers taken for zero as in every command."""

import subprocess
import sys

import numpy as np
import pytest

from avatar.checks import AvatarError
from avatar.geometry.trees import build_tree

CLOUDS = """
import sys
import numpy as np
from avatar.environment import prepared_process
from avatar.evaluation.shapes import closest_on_mesh
from avatar.geometry.trees import build_tree

prepared = prepared_process()
prepared.__enter__()
rng = np.random.default_rng(0)
clouds = {"issue": np.stack([np.r_[np.zeros(60), np.linspace(0.1, 1, 40)], np.zeros(100), np.zeros(100)], axis=1)}
clouds["one place"] = np.zeros((500, 3))
clouds["flat"] = rng.uniform(-1, 1, (500, 3)) * [1, 0, 1]
for name, scale in {"metres": 1.0, "least normal": 2.3e-308, "just above": 6e-308, "denormal": 1e-310}.items():
    for share in (0.3, 0.6, 0.9):
        cloud = rng.uniform(-1, 1, (500, 3)) * scale
        clouds[f"{name}, {share} zeros"] = np.where(rng.random((500, 3)) < share, 0, cloud)
        clouds[f"{name}, {share} repeated"] = clouds[f"{name}, {share} zeros"][rng.integers(0, 20, 500)]
        clouds[f"{name}, {share} beside others"] = np.concatenate([cloud[:300], rng.uniform(-1, 1, (200, 3))])
for name, cloud in clouds.items():
    print(name, flush=True)
    queries = np.concatenate([cloud[:50], rng.uniform(-1, 1, (50, 3))])
    brute = np.sort(np.linalg.norm(queries[:, None] - cloud, axis=2), axis=1)[:, :4]
    np.testing.assert_allclose(build_tree(cloud).query(queries, k=4)[0], brute, rtol=1e-12, atol=1e-150)

x, z = np.meshgrid(np.linspace(0, 1, 31), np.linspace(0, 1, 31), indexing="ij")
vertices = np.stack([x, np.where(x > 0.8, x, 0), z], axis=-1).reshape(-1, 3)
corner = (np.arange(30)[:, None] * 31 + np.arange(30)).ravel()
faces = (corner[:, None, None] + np.array([[0, 1, 31], [1, 32, 31]])).reshape(-1, 3)
hits = closest_on_mesh(np.array([[0.33, -0.2, 0.41], [0.5, 0.3, 0.5]]), vertices, faces)
np.testing.assert_allclose(hits.points, [[0.33, 0, 0.41], [0.5, 0, 0.5]], atol=1e-12)
print("done")
"""


def test_every_tree_ends_and_answers_exactly_where_denormals_are_zero():
    """In a process of its own, which a tree that never ends would kill."""
    done = subprocess.run([sys.executable, "-c", CLOUDS], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, f"after {done.stdout.splitlines()[-1:]}: {done.stderr[-2000:]}"
    assert done.stdout.endswith("done\n")


def test_no_points_and_coordinates_that_are_not_finite():
    assert np.isinf(build_tree(np.zeros((0, 3))).query(np.zeros((2, 3)))[0]).all()
    with pytest.raises(AvatarError, match="points: expected finite"):
        build_tree(np.array([[0.0, np.nan, 0.0]]))
