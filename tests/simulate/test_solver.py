"""The cloth solver on a small square: equilibrium in closed form, rest on a sphere, same bytes twice."""

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError
from avatar.simulate.outfits import FabricConfig
from avatar.simulate.solver import ClothSolver, SolverConfig

pytest.importorskip("newton")
pytestmark = pytest.mark.slow

SIDE = 9


def square(height: float):
    """A flat cloth of 0.24 m: ``(81, 3)`` vertices and its faces, wound upwards."""
    axis = np.linspace(-0.12, 0.12, SIDE)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    vertices = np.stack([x, np.full_like(x, height), z], -1).reshape(-1, 3)
    grid = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    return vertices, np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def ball():
    mesh = trimesh.creation.icosphere(3, 0.1)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def drape(steps: int) -> ClothSolver:
    vertices, faces = square(0.108)
    points, ball_faces = ball()
    solver = ClothSolver(vertices, faces, FabricConfig(), points, ball_faces, np.zeros(len(vertices)))
    solver.reset(vertices, points)
    for step in range(steps):
        solver.step(points, vertices, float(np.clip(2 - 2 * step / steps, 0.1, 1)))
    return solver


def test_anchors_carry_the_weight_as_springs_do():
    vertices, faces = square(1.0)
    points, ball_faces = ball()
    stiffness = np.full(len(vertices), 0.05)
    solver = ClothSolver(vertices, faces, FabricConfig(), points, ball_faces, stiffness)
    solver.reset(vertices, points)
    for _ in range(120):
        solver.step(points, vertices)
    sag = (vertices - solver.positions)[:, 1].mean()
    assert sag == pytest.approx(0.2 * 0.24**2 * 9.81 / stiffness.sum(), rel=0.02)


def test_cloth_rests_outside_a_ball_and_repeats_to_the_bit():
    first = drape(80)
    radii = np.linalg.norm(first.positions, axis=1)
    assert radii.min() > 0.1 and first.positions[:, 1].min() < 0.06
    assert np.percentile(first.moved, 99) < 2e-4
    assert first.positions.tobytes() == drape(80).positions.tobytes()


def test_cloth_follows_a_moving_ball():
    solver = drape(40)
    points, _ = ball()
    for step in range(1, 31):
        solver.step(points + [0, 0.004 * step, 0], np.zeros_like(solver.positions))
    lifted = solver.positions - [0, 0.12, 0]
    assert np.linalg.norm(lifted, axis=1).min() > 0.099


def test_bad_settings_are_refused():
    with pytest.raises(AvatarError, match="momentum"):
        SolverConfig(momentum=-0.1)
    vertices, faces = square(1.0)
    with pytest.raises(AvatarError, match="stiffness"):
        ClothSolver(vertices, faces, FabricConfig(), *ball(), np.zeros(3))
