"""Estimated normals: the share that points outward, on scans whose true normals are known."""

from pathlib import Path

import numpy as np
import pytest

from avatar.checks import AvatarError
from avatar.data.layouts import find_outfit
from avatar.data.scanner import ScanConfig
from avatar.records import Mesh
from avatar.sources.normals import oriented_normals


@pytest.fixture(scope="module", params=["tee", "dress"])
def scanned(request):
    """A scan of 20,000 points of the sample, and its body."""
    outfit = find_outfit(Path("data"), "sample", request.param, ScanConfig(points=20_000))
    frame = outfit.load("train", outfit.frames("train")[3])
    return frame.scan, Mesh(frame.body.vertices, outfit.template.faces.numpy())


@pytest.mark.parametrize("known", [True, False], ids=["body", "no-body"])
def test_scans_of_people(scanned, known, caplog):
    scan, body = scanned
    normals = oriented_normals(scan.points, body if known else None)
    cosines = (normals * scan.normals).sum(axis=1)
    assert normals.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert (cosines > 0).mean() > 0.985
    assert np.degrees(np.arccos(np.abs(cosines).clip(max=1))).mean() < 6
    assert not caplog.records


@pytest.mark.parametrize("flip", [False, True])
def test_two_spheres_without_a_body(flip):
    """Each piece votes for itself, whatever the signs of its axes."""
    directions = np.random.default_rng(0).standard_normal((4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions[::-1] if flip else directions
    centres = np.where(np.arange(4000) % 2, 1.0, -1.0)[:, None] * [1.5, 0, 0]
    normals = oriented_normals(directions + centres, None)
    assert (normals * directions).sum(axis=1).min() > 0.9


def test_a_body_turns_a_sheet_that_could_face_either_way():
    rng = np.random.default_rng(0)
    sheet = np.concatenate([rng.random((500, 2)), 0.1 + np.zeros((500, 1))], axis=1)
    floor = Mesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    assert (oriented_normals(sheet, floor)[:, 2] > 0.99).all()
    above = Mesh(floor.vertices + [0, 0, 0.2], floor.faces[:, ::-1])
    assert (oriented_normals(sheet, above)[:, 2] < -0.99).all()


def test_doubt_is_told_with_its_name(caplog):
    """A single sheet without a body is seen from both sides."""
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40)), axis=-1).reshape(-1, 2)
    oriented_normals(np.concatenate([grid, np.zeros((len(grid), 1))], axis=1), None, "walk.0001")
    assert "walk.0001: normals of 100% of the points may point inward" in caplog.text


def test_refused():
    with pytest.raises(AvatarError, match="points: expected at least 16"):
        oriented_normals(np.zeros((5, 3)), None)
    with pytest.raises(AvatarError, match="finite"):
        oriented_normals(np.full((50, 3), np.nan), None)
