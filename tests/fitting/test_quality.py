"""Quality of fits: figures of a known offset, reasons with figures, tables that name failed frames, pictures."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.body.open import open_body
from avatar.fitting.quality import FitQuality, measure_fit, picture_fit, write_quality
from avatar.fitting.settings import QualityConfig
from avatar.geometry.surface import vertex_normals
from avatar.records import Mesh, PointCloud

GOOD = FitQuality(0.005, 0.02, 0.0, 0.001, 0.97, 80.0)


@pytest.fixture(scope="module")
def body():
    """Vertices, normals and faces of the open body, and which vertices are the head's."""
    template = open_body().template
    normals = vertex_normals(template.vertices, template.faces).numpy()
    return (
        template.vertices.numpy().astype(float),
        normals,
        template.faces.numpy(),
        template.weights[:, 15].numpy() > 0.5,
    )


def test_a_scan_at_a_known_distance_has_that_distance(body):
    vertices, normals, faces, head = body
    over = measure_fit(PointCloud(vertices + 0.008 * normals, normals), vertices, normals, faces, head, 1.0)
    assert over.outside_median == pytest.approx(0.008, abs=5e-4) and over.inside_share < 0.01
    assert over.bare_median == pytest.approx(0.008, abs=1e-3) and over.covered_share > 0.96
    inside = measure_fit(PointCloud(vertices - 0.015 * normals, normals), vertices, normals, faces, head, 1.0)
    assert inside.inside_share > 0.5
    upper = vertices[:, 1] > np.median(vertices[:, 1])
    half = measure_fit(PointCloud(vertices[upper], normals[upper]), vertices, normals, faces, head, 1.0)
    assert 0.4 < half.covered_share < 0.75


def test_every_limit_gives_a_reason_with_its_figure():
    limits = QualityConfig()
    assert GOOD.failures(limits) == ()
    for change, reason in (
        ({"inside_share": 0.5}, "50.0% of the scan inside the body"),
        ({"bare_median": 0.1}, "head, hands and feet 100 mm from the scan"),
        ({"bare_median": float("nan")}, "no scan at head, hands and feet"),
        ({"covered_share": 0.3}, "the scan covers 30% of the body"),
        ({"objective": 5000.0}, "objective 5000"),
    ):
        assert replace(GOOD, **change).failures(limits) == (reason,)


def test_tables_name_the_frames_that_failed(tmp_path):
    write_quality(tmp_path / "quality.csv", ["a.1", "b.2"], [GOOD, replace(GOOD, objective=900)], ["", "objective 900"])
    rows = (tmp_path / "quality.csv").read_text().splitlines()
    assert rows[0].startswith("frame,outside_median,") and rows[2].endswith(",900,objective 900")
    text = (tmp_path / "quality.md").read_text()
    assert text.startswith("2 frames fitted, 1 failed: b.2.") and "| a.1 | 5.0 | 20.0 | 0.0% | 1.0 | 97% | 80 |" in text


def test_a_picture_shows_scan_and_body_alone_and_together(body):
    vertices, normals, faces, _ = body
    shown = torch.arange(0, len(vertices), 5).numpy()
    picture = picture_fit(PointCloud(vertices[shown], normals[shown]), Mesh(vertices, faces), 0.3, (80, 120))
    assert picture.dtype == np.uint8 and picture.shape[0] > 240 and picture.shape[1] > 240
    assert picture.std() > 10
