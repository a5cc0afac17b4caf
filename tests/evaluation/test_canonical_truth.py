"""Canonicalizations against the truth: closed forms on a bent bar, the tiny outfit, tables."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from avatar.body.skinning import chain_transforms, skin_transforms
from avatar.checks import AvatarError
from avatar.data.layouts import OpenOutfit
from avatar.data.scanner import ScanConfig
from avatar.evaluation.canonical import (
    CANONICAL_METRICS,
    OVERVIEW,
    TRUE,
    CanonicalComparison,
    Canonicalized,
    canonical_surfaces,
    canonical_table,
    contact_points,
    frame_truth,
    repose,
    score_canonicalization,
    unpose_truly,
    unpose_with,
    weights_under,
)
from avatar.evaluation.scores import read_scores, write_scores
from avatar.evaluation.scoring import Label
from avatar.evaluation.tables import to_markdown
from avatar.geometry.transforms import transform_points
from avatar.records import BodyFit, Frame, Mesh, Scan, Template

JOINTS = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])


def bar(bind_turn=0.0):
    """A bar of two bones along x, from 0 to 2, its second half bound with a bend."""
    x = torch.linspace(0, 2, 41)
    vertices = torch.stack([x, torch.zeros(41), torch.zeros(41)], dim=1)
    second = ((x - 0.9) / 0.2).clamp(0, 1)
    bend = torch.tensor([[[0.0, 0, 0], [0, 0, bind_turn]]])
    return Template(
        vertices=vertices,
        faces=torch.tensor([[0, 1, 2]]),
        weights=torch.stack([1 - second, second], dim=1),
        joints=JOINTS,
        parents=(-1, 0),
        joint_names=("one", "two"),
        canonical_from_bind=chain_transforms(bend, JOINTS, (-1, 0))[0] if bind_turn else None,
    )


def bent_frame(template, points, weights, labels=None, angle=1.0, extra=0.0):
    """A scan of canonical points carried by weights to a pose in which the second bone is bent."""
    joints = chain_transforms(torch.tensor([[[0.2, 0.1, 0.3], [0, 0, angle]]]), JOINTS, template.parents)
    forth = skin_transforms(torch.as_tensor(weights), joints, template.canonical_from_bind)[0]
    posed = transform_points(forth, torch.as_tensor(points)).numpy() + np.float32(extra)
    fit = BodyFit(
        vertices=posed,
        vertex_transforms=np.zeros((1, 4, 4)),
        joint_transforms=joints[0].numpy(),
        pose_vertices=posed,
        translation=np.zeros(3),
    )
    up = np.tile(np.float32([0, 1, 0]), (len(points), 1))
    turned = torch.einsum("nij,nj->ni", torch.linalg.inv(forth[:, :3, :3]).transpose(1, 2), torch.from_numpy(up))
    normals = torch.nn.functional.normalize(turned, dim=-1).numpy()
    labels = np.ones(len(points), np.uint8) if labels is None else labels
    return Frame("a.0", "bar", "train", fit, Scan(posed, normals, labels=labels, canonical=points))


def bar_points():
    points = bar().vertices.numpy() + np.float32([0, 0.05, 0])
    return points[::2].copy()


@pytest.mark.parametrize("bind_turn", [0.0, 0.7])
def test_true_weights_find_the_true_places_of_what_only_the_bones_move(bind_turn):
    template, points = bar(bind_turn), bar_points()
    frame = bent_frame(template, points, weights_under(points, template))
    truth = frame_truth(frame.scan, template)
    result = unpose_truly(frame, truth, template)
    np.testing.assert_allclose(result.scan.points, points, atol=1e-5)
    np.testing.assert_allclose(result.scan.normals, np.tile([0, 1, 0], (len(points), 1)), atol=1e-4)
    back = repose(result.scan.points, result.forward_weights, frame.body, template)
    np.testing.assert_allclose(back, frame.scan.points, atol=1e-5)
    seen = CanonicalComparison(frame, truth, result, template)
    for errors in (seen.off_truth, seen.off_cycle, seen.off_weights):
        assert errors.shape == (len(points),)
        assert errors.max() < 1e-5
    assert seen.lost == 0
    assert np.isnan(seen.cut)


def test_errors_are_those_of_the_weights():
    """All weight on the first bone: the second half stays bent, a chord off its place; and the cycle does not close."""
    template, points = bar(), bar_points()
    frame = bent_frame(template, points, weights_under(points, template), angle=1.0)
    truth = frame_truth(frame.scan, template)
    wrong = np.tile(np.float32([1, 0]), (len(points), 1))
    result = Canonicalized(unpose_with(wrong, frame, template), truth.weights)
    seen = CanonicalComparison(frame, truth, result, template)
    far = points[:, 0] > 1.1
    arm = np.linalg.norm(points[far] - [1, 0, 0], axis=1)
    np.testing.assert_allclose(seen.off_truth[far], 2 * np.sin(0.5) * arm, rtol=1e-4)
    np.testing.assert_allclose(seen.off_truth[points[:, 0] < 0.9], 0, atol=1e-5)
    np.testing.assert_allclose(seen.off_weights[far], 1)
    np.testing.assert_allclose(seen.off_cycle[far], 2 * np.sin(0.5) * arm, rtol=1e-4)
    values = {name: metric.measure(seen) for name, metric in CANONICAL_METRICS.items()}
    assert values["truth_cm"] == pytest.approx(100 * seen.off_truth.mean())
    assert values["truth_median_cm"] == pytest.approx(100 * np.median(seen.off_truth))
    assert values["truth_p95_cm"] == pytest.approx(100 * np.quantile(seen.off_truth, 0.95))
    assert values["cycle_cm"] == pytest.approx(100 * seen.off_cycle.mean())
    assert values["weights"] == pytest.approx(seen.off_weights.mean())
    assert np.isnan(values["truth_contact_cm"])  # nothing touches
    assert np.isnan(values["surface_cm"])  # no surface is known


def test_parts_losses_and_cuts_are_of_the_points_kept():
    template, points = bar(), bar_points()
    labels = (points[:, 0] > 1).astype(np.uint8)
    frame = bent_frame(template, points, weights_under(points, template), labels)
    faces = np.stack([np.arange(19), np.arange(1, 20), np.arange(2, 21)], axis=1)
    frame = replace(frame, scan=replace(frame.scan, faces=faces))
    truth = frame_truth(frame.scan, template)
    whole = unpose_truly(frame, truth, template)
    kept = np.arange(5, 21)
    moved = whole.scan.points[kept] + np.float32([0, 0.03, 0]) * (labels[kept] == 0)[:, None]
    scan = replace(
        whole.scan,
        points=moved,
        normals=whole.scan.normals[kept],
        weights=whole.scan.weights[kept],
        source=kept,
        faces=faces[5:] - 5,
    )
    seen = CanonicalComparison(frame, truth, Canonicalized(scan, scan.weights), template)
    values = {name: metric.measure(seen) for name, metric in CANONICAL_METRICS.items()}
    assert values["points_lost"] == pytest.approx(5 / 21)
    assert values["triangles_cut"] == pytest.approx(5 / 19)
    assert values["truth_garment_cm"] == pytest.approx(0, abs=1e-3)
    assert values["truth_cm"] == pytest.approx(3 * (labels[kept] == 0).mean(), abs=1e-3)


def test_distance_to_the_surface_needs_no_correspondence():
    """Points that slid along their own surface are on it; points on another label's surface are not."""
    template, points = bar(), bar_points()
    frame = bent_frame(template, points, weights_under(points, template))
    truth = frame_truth(frame.scan, template)
    result = unpose_truly(frame, truth, template)
    slid = replace(result.scan, points=result.scan.points + np.float32([0.1, 0.02, 0]))
    corners = np.array([[-1.0, 0.05, -1], [4, 0.05, -1], [4, 0.05, 1], [-1, 0.05, 1]])
    plane = Mesh(corners, np.array([[0, 2, 1], [0, 3, 2]]))
    seen = CanonicalComparison(frame, truth, Canonicalized(slid, slid.weights), template, {1: plane})
    np.testing.assert_allclose(seen.off_surface, 0.02, atol=1e-6)
    other = CanonicalComparison(frame, truth, Canonicalized(slid, slid.weights), template, {0: plane})
    assert np.isnan(other.off_surface).all()


def test_contact_is_near_now_and_far_at_rest():
    rest = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.05, 0, 0], [1, 0, 0], [2, 0, 0]])
    posed = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.0, 0.005, 0], [1, 0, 0], [1.03, 0, 0]])
    np.testing.assert_array_equal(contact_points(posed, rest), [True, True, True, False, False])
    rng = np.random.default_rng(0)
    posed, rest = rng.random((300, 3)) * 0.15, rng.random((300, 3)) * 0.15
    near = np.linalg.norm(posed[:, None] - posed, axis=-1) <= 0.02
    far = np.linalg.norm(rest[:, None] - rest, axis=-1) > 0.10
    np.testing.assert_array_equal(contact_points(posed, rest), (near & far).any(axis=1))


def test_scans_of_another_frame_and_data_without_truth_are_refused():
    template, points = bar(), bar_points()
    frame = bent_frame(template, points, weights_under(points, template))
    truth = frame_truth(frame.scan, template)
    result = unpose_truly(frame, truth, template)
    other = replace(result.scan, source=result.scan.source + 1)
    with pytest.raises(AvatarError, match=r"indices below the scan.s 21 points, got 21 up to 21\..*same scanner"):
        CanonicalComparison(frame, truth, Canonicalized(other, other.weights), template)
    with pytest.raises(AvatarError, match="only simulated data has the truth"):
        frame_truth(replace(frame.scan, canonical=None), template)


@pytest.fixture(scope="module")
def scored(tiny_folder):
    outfit = OpenOutfit(tiny_folder, "open", ScanConfig(points=1200))
    names = outfit.frames("train")[::2]

    def lifted(frame):
        result = unpose_truly(frame, frame_truth(frame.scan, outfit.template), outfit.template)
        return replace(result, scan=replace(result.scan, points=result.scan.points + np.float32([0, 0.1, 0])))

    label = Label("lifted", table="t1", variant="x", seed=3, steps=7, commit="abc")
    return score_canonicalization(outfit, "train", names, {label: lifted, Label("other", table="t1"): lifted}), names


def test_an_outfit_is_scored_with_the_references_beside(scored):
    scores, names = scored
    means = {(row.method, row.metric): row for row in scores.rows}
    row = means["lifted", "truth_cm"]
    assert (row.table, row.outfit, row.variant, row.seed, row.steps, row.commit) == ("t1", "tiny", "x", 3, 7, "abc")
    assert (row.frames, row.points, row.unit) == (3, 1200, "cm")
    singles = [f.value for f in scores.frames if (f.method, f.metric) == ("lifted", "truth_cm")]
    assert [f.frame for f in scores.frames if (f.method, f.metric) == ("lifted", "truth_cm")] == list(names)
    assert row.value == pytest.approx(np.mean(singles))
    assert 0.4 < means[TRUE, "truth_garment_cm"].value < 3  # the bulge of up to 5 cm, over all of the tunic
    assert row.value == pytest.approx(10, abs=1.5)
    assert means[TRUE, "weights"].value == 0
    assert means["lifted", "surface_cm"].value > means[TRUE, "surface_cm"].value + 1
    assert (TRUE, "triangles_cut") not in means  # scans of points


def test_true_weights_stand_beside_methods_of_one_variant(tiny_folder):
    outfit = OpenOutfit(tiny_folder, "open", ScanConfig(points=300))

    def truly(frame):
        return unpose_truly(frame, frame_truth(frame.scan, outfit.template), outfit.template)

    rows = []
    for split in ("train", "test"):
        rows += score_canonicalization(outfit, split, outfit.frames(split)[:1], {Label("m", variant=split): truly}).rows
    places = {(row.method, row.variant, row.metric) for row in rows}
    assert len(places) == len(rows) and {variant for _, variant, _ in places} == {"train", "test"}


def test_several_outfits_stand_in_one_overview(scored):
    scores, _ = scored
    other = [replace(row, outfit="robe") for row in scores.rows]
    table = canonical_table(scores.rows + other, ["tiny", "robe"], OVERVIEW)
    labels = [row.label for row in table.rows]
    assert labels[0] == "tiny, cycle_cm (cm)" and len([x for x in labels if x.startswith("robe, ")]) == len(labels) / 2
    single = canonical_table(scores.rows, ["tiny"])
    assert {r.label: r.values for r in single.rows}["cycle_cm (cm)"] == table.rows[0].values


def test_scores_are_kept_and_tabled(scored, tmp_path):
    scores, _ = scored
    write_scores(tmp_path / "scores.csv", scores)
    assert read_scores(tmp_path / "scores.csv") == scores
    table = canonical_table(scores.rows, ["tiny"], ["truth_cm", "weights"])
    assert table.columns == (TRUE, "lifted (x)", "other")
    text = to_markdown(table)
    assert "| truth_cm (cm) |" in text
    assert "Mean distance of canonical points to their true places" in text
    row = next(r for r in scores.rows if (r.method, r.metric) == ("lifted", "weights"))
    assert table.rows[1].values[1] == pytest.approx(100 * row.value)
    with pytest.raises(AvatarError, match="unknown speed"):
        canonical_table(scores.rows, ["tiny"], ["speed"])


def test_every_label_has_its_own_surface_at_rest(tiny_outfit):
    surfaces = canonical_surfaces(tiny_outfit, "train", "rise.00002")
    whole = tiny_outfit.load_surface("train", "rise.00004")
    assert set(surfaces) == {0, 1, 2}
    assert sum(len(mesh.faces) for mesh in surfaces.values()) == len(whole.faces)
    skin = surfaces[0]
    np.testing.assert_array_equal(skin.faces, tiny_outfit.template.faces)
    rest = skin.vertices[: len(tiny_outfit.template.vertices)]
    np.testing.assert_allclose(rest, tiny_outfit.template.vertices.numpy(), atol=1e-6)
    labels = whole.labels.numpy()
    assert (labels[surfaces[2].faces[:, 0]] == 2).all()
    assert canonical_surfaces(SimpleNamespace(), "train", "a.0") == {}


def test_errors_name_the_frame(tiny_outfit):
    def wrong(frame):
        result = unpose_truly(frame, frame_truth(frame.scan, tiny_outfit.template), tiny_outfit.template)
        return replace(result, scan=replace(result.scan, source=result.scan.source + 9999))

    with pytest.raises(AvatarError, match=r"outfit tiny, wrong, frame rise\.00001: source"):
        score_canonicalization(tiny_outfit, "train", ["rise.00001"], {Label("wrong"): wrong})
