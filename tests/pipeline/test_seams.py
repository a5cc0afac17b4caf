"""The seam test on a flat sheet whose atlas is cut down the middle, where the jump and its place are known."""

import csv
from collections import namedtuple

import numpy as np
import pytest
import torch

from avatar.checks import AvatarError
from avatar.evaluation.scoring import Label
from avatar.geometry.surface import interpolate
from avatar.geometry.uv import sample_uv, seam_edges
from avatar.pipeline.seams import (
    BODY,
    KEYS,
    OTHERS,
    SEAMS,
    SeamKey,
    SeamTest,
    angles_between,
    edge_sides,
    mean_of,
    measure_seams,
    point_errors,
    seam_differences,
    seam_distance,
    seam_places,
    seam_table,
    seams_csv,
)
from avatar.records import PointCloud, Scan, Template

Measured = namedtuple("Measured", "mean points")
CELLS, SIDE = 20, 0.4  # a sheet of 20 x 20 squares, 40 cm wide, cut at x = 0
JUMP, BUMP, WIDTH = 0.004, 0.003, 0.01  # metres: the sheet's halves are that far apart; off by the bump near the cut


def sheet(uv: bool = True) -> Template:
    """A square sheet at z = 0 around the origin, whose atlas has its two halves apart."""
    line = torch.linspace(-SIDE / 2, SIDE / 2, CELLS + 1)
    vertices = torch.stack([*torch.meshgrid(line, line, indexing="xy"), torch.zeros(CELLS + 1, CELLS + 1)], dim=-1)
    ids = torch.arange((CELLS + 1) ** 2).reshape(CELLS + 1, CELLS + 1)
    a, b, c, d = (part.flatten() for part in (ids[:-1, :-1], ids[:-1, 1:], ids[1:, :-1], ids[1:, 1:]))
    faces = torch.cat([torch.stack([a, b, d], dim=1), torch.stack([a, d, c], dim=1)])
    vertices = vertices.reshape(-1, 3)
    places = vertices[:, :2] + 0.5
    right = (vertices[faces].mean(dim=1)[:, 0] > 0)[:, None]
    atlas = {"uv": torch.cat([places, places + 0.2]), "uv_faces": faces + len(vertices) * right} if uv else {}
    count = len(vertices)
    return Template(vertices, faces, torch.ones(count, 1), torch.zeros(1, 3), (-1,), ("root",), **atlas)


def predicted(samples, template, jump=JUMP, bump=BUMP) -> PointCloud:
    """The sheet with its right half lifted by the jump and whatever is near the cut by the bump, normals upwards."""
    points = interpolate(template.vertices, samples).numpy().copy()
    centres = template.vertices[template.faces[samples.face_ids]].mean(dim=1).numpy()
    points[:, 2] += jump * (centres[:, 0] > 0) + bump * (np.abs(points[:, 0]) < WIDTH)
    return PointCloud(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))


def flat_scan(template, labels=None) -> Scan:
    """The sheet at rest as a dense scan."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.2, 0.2, 81)] * 2), axis=-1).reshape(-1, 2)
    points = np.pad(grid, ((0, 0), (0, 1)))
    return Scan(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), labels=None if labels is None else labels(points))


def measured(*given):
    """What is measured, by key: its mean and how many points that is over."""
    return {key: Measured(mean_of(sums), int(sums[1])) for key, sums in zip(KEYS, measure_seams(*given))}


def test_seams_are_the_cut_and_distances_those_to_it():
    template = sheet()
    edges = seam_edges(template.faces, template.uv_faces)
    assert len(edges) == CELLS and template.vertices[edges][..., 0].abs().max() < 1e-6
    points = np.array([[0.03, 0.001, 0.0], [-0.1, 0.05, 0.0], [0.0, 0.25, 0.0]])
    found = seam_distance(points, template.vertices.numpy(), edges.numpy())
    np.testing.assert_allclose(found, [0.03, 0.1, 0.05], atol=6e-4)


def test_both_sides_of_an_edge_are_one_place_of_two_triangles():
    template = sheet()
    edges = seam_edges(template.faces, template.uv_faces)
    sides = edge_sides(template.faces, edges)
    left, right = (interpolate(template.vertices, side) for side in (sides.left, sides.right))
    torch.testing.assert_close(left, right)
    torch.testing.assert_close(left.sort(dim=0).values, template.vertices[edges].mean(dim=1).sort(dim=0).values)
    assert (sides.left.face_ids != sides.right.face_ids).all()
    border = torch.tensor([[0, 1]])
    assert len(edge_sides(template.faces, border).left.face_ids) == 0


def test_other_edges_are_all_but_the_seams():
    template = sheet()
    places = seam_places(template, 10, seed=0)

    def apart(sides):
        left, right = (sample_uv(template.uv, template.uv_faces, side) for side in (sides.left, sides.right))
        return (left - right).norm(dim=1)

    assert apart(places.seams).min() > 0.1 and len(places.seams.left.face_ids) == CELLS
    every = [seam_places(template, 10, seed=seed).others for seed in range(40)]  # 800 draws of 1,240 edges
    assert max(float(apart(others).max()) for others in every) < 1e-6


def test_the_known_jump_is_found_at_seams_and_none_at_other_edges():
    template = sheet()
    places = seam_places(template, 4000, seed=0)
    found = measured(predicted(places.samples, template), flat_scan(template), places)
    assert found[SeamKey("jump", SEAMS)].mean == pytest.approx(JUMP, rel=1e-5)
    assert found[SeamKey("jump", SEAMS)].points == CELLS
    assert found[SeamKey("jump", OTHERS)].mean == pytest.approx(0, abs=1e-9)
    assert found[SeamKey("normal_jump", SEAMS)].mean == pytest.approx(0, abs=1e-9)


def test_errors_near_the_seam_are_those_that_are_there():
    template = sheet()
    places = seam_places(template, 4000, seed=0)
    cloud = predicted(places.samples, template, jump=0.0)
    found = measured(cloud, flat_scan(template), places)
    bands = {key.low: mean for key, mean in found.items() if (key.metric, key.where) == ("distance", BODY)}
    assert bands[0.0].mean == pytest.approx(BUMP, rel=0.02)
    assert bands[0.01].mean < 0.1 * BUMP and bands[0.05].mean == pytest.approx(0, abs=1e-9)
    assert sum(mean.points for mean in bands.values()) == 4000
    assert bands[0.0].points == pytest.approx(4000 * 0.02 / SIDE, rel=0.2)


def test_only_what_ends_on_cloth_counts_where_the_scan_knows():
    template = sheet()
    places = seam_places(template, 2000, seed=0)
    scan = flat_scan(template, labels=lambda points: (points[:, 1] > 0).astype(np.uint8))
    found = measured(predicted(places.samples, template), scan, places)
    assert found[SeamKey("jump", SEAMS)].points == CELLS / 2
    bands = [mean.points for key, mean in found.items() if (key.metric, key.where) == ("distance", BODY)]
    assert sum(bands) == pytest.approx(1000, rel=0.1)


def test_point_errors_do_not_count_sliding_and_angles_are_exact():
    scan = Scan(np.array([[0.0, 0, 0]]), np.array([[0.0, 0, 1]]))
    turned = np.array([[0.0, np.sin(1e-3), np.cos(1e-3)]])
    errors = point_errors(PointCloud(np.array([[0.3, -0.2, 0.01]]), turned), scan)
    assert errors.distance == pytest.approx([0.01]) and errors.angle == pytest.approx([np.degrees(1e-3)], rel=1e-6)
    assert angles_between(turned, -turned) == pytest.approx([180])


def test_bodies_without_an_atlas_or_without_seams_are_refused():
    with pytest.raises(AvatarError, match="UV coordinates"):
        seam_places(sheet(uv=False), 100, seed=0)
    with pytest.raises(AvatarError, match="atlas with seams"):
        seam_distance(np.zeros((1, 3)), np.zeros((3, 3)), np.zeros((0, 2), int))


def probe(method, jump, bumps, variant=""):
    template = sheet()
    places = seam_places(template, 2000, seed=0)
    clouds = [predicted(places.samples, template, jump, bump) for bump in bumps]
    frames = [measure_seams(cloud, flat_scan(template), places) for cloud in clouds]
    return SeamTest(Label(method, table="seams", variant=variant, steps=7), "open", "sheet", np.array(frames))


def test_tables_and_differences_are_at_the_same_places():
    pop, csf = probe("pop", 0.0, (0.003, 0.005)), probe("csf", 0.0, (0.001, 0.001))
    table = {
        row.label: dict(zip(table.columns, row.values)) for table in [seam_table([pop, csf])] for row in table.rows
    }
    assert table["distance, 0 to 1 cm (mm)"] == pytest.approx({"pop": 4, "csf": 1}, rel=0.02)
    assert table["jump at seams (mm)"] == pytest.approx({"pop": 0, "csf": 0}, abs=1e-6)
    rows = {row.label: row for row in seam_differences([csf, pop], "csf").rows}
    near = rows["distance, nearer than 1 cm (mm)"]
    assert near.values == pytest.approx((3,), rel=0.02)
    assert near.cells[0].startswith("+") and "[+2" in near.cells[0] and "+4" in near.cells[0]
    assert abs(rows["distance, farther than 1 cm (mm)"].values[0]) < 0.1
    several = seam_differences([csf, pop, probe("pop", 0.0, (0.002, 0.002))], "csf")
    assert several.columns == ("pop", "pop")
    assert several.rows[0].values == pytest.approx((3, 1), rel=0.02)


def test_rows_are_tidy():
    (pop,) = [probe("pop", JUMP, (0.003,), "12.5%")]
    rows = list(csv.DictReader(seams_csv([pop]).splitlines()))
    jump = next(row for row in rows if (row["metric"], row["where"]) == ("jump", "seams"))
    assert float(jump["value"]) == pytest.approx(JUMP, rel=1e-5) and jump["unit"] == "m"
    assert (jump["method"], jump["variant"], jump["steps"], jump["frames"]) == ("pop", "12.5%", "7", "1")
    assert len(rows) == len(KEYS) and not any(value is None for row in rows for value in row.values())
