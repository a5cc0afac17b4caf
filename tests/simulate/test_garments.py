"""Garments: clean topology, the right openings, outside the body on every shape."""

import numpy as np
import pytest
import scipy.sparse as sparse
import trimesh

from avatar.body.open import open_body
from avatar.checks import AvatarError
from avatar.simulate.garments import NECK_FOOT, Cutting, cut_garment
from avatar.simulate.level_sets import mesh_edges
from avatar.simulate.mesh_queries import body_distances
from avatar.simulate.outfits import GARMENTS, OUTFIT_NAMES, FabricConfig, GarmentConfig, outfit

pytest.importorskip("warp")

RIMS = {"trousers": 3, "tee": 4, "shirt": 4, "skirt": 2, "dress": 4, "jacket": 3, "coat": 3, "slacks": 3, "hoodie": 4}


def coarse(name: str, index: int) -> GarmentConfig:
    """A garment of the registry with longer edges, so that cutting it is quick."""
    config = GARMENTS[name]()[index]
    config.edge = max(config.edge, 0.025)
    return config


@pytest.mark.parametrize(
    ("name", "index", "shape"),
    [
        ("tee", 0, "female"),
        ("tee", 1, "male"),
        ("shirt", 1, "male"),
        ("skirt", 0, "female"),
        ("jacket", 2, "male"),
        ("coat", 2, "male"),
        ("slacks", 0, "female"),
        ("slacks", 0, "male"),
        ("hoodie", 1, "female"),
    ],
)
def test_cut_garments_are_clean_and_outside(name, index, shape):
    body = open_body(shape)
    config = coarse(name, index)
    garment = cut_garment(body, config)
    mesh = trimesh.Trimesh(garment.vertices, garment.faces, process=False)
    edges, counts = mesh_edges(garment.faces)
    assert mesh.body_count == 1 and mesh.is_winding_consistent and counts.max() == 2
    rim = edges[counts == 1]
    used, rim = np.unique(rim, return_inverse=True)
    graph = sparse.coo_matrix((np.ones(len(rim.reshape(-1, 2))), rim.reshape(-1, 2).T), shape=(len(used),) * 2)
    assert sparse.csgraph.connected_components(graph)[0] == RIMS[config.name]
    corners = garment.vertices[garment.faces]
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    shape_factor = 4 * np.sqrt(3) * mesh.area_faces / (sides**2).sum(1)
    assert shape_factor.min() > 0.35  # 1 for an equilateral triangle, 0 for a sliver
    if config.top is None and not config.hood:  # nothing is left on the face
        assert garment.vertices[:, 1].max() < Cutting(body).joints["neck"][1] + NECK_FOOT + 0.01
    away = body_distances(body.bind_vertices.numpy(), body.faces.numpy(), garment.vertices, 0.1)
    assert away.min() > config.fabric.thickness - 1e-4
    outward = (mesh.vertex_normals * (garment.vertices - [0, garment.vertices[:, 1].mean(), 0])).sum(1)
    assert (outward > 0).mean() > 0.5


def test_levels_run_from_ankle_to_neck():
    cutting = Cutting(open_body("female"))
    heights = [cutting.height(level) for level in (0, 1, 2, 3, 4, 5)]
    assert heights == sorted(heights) and heights[0] == pytest.approx(cutting.joints["left_ankle"][1])
    assert cutting.height(0.5) == pytest.approx((heights[0] + heights[1]) / 2)


def test_hems_lie_where_the_levels_say():
    body = open_body("female")
    config = coarse("skirt", 0)
    garment, cutting = cut_garment(body, config), Cutting(body)
    assert garment.vertices[:, 1].min() == pytest.approx(cutting.height(config.bottom), abs=0.015)
    assert garment.vertices[:, 1].max() == pytest.approx(cutting.height(config.top), abs=0.015)


def test_a_cut_that_leaves_nothing_says_so():
    with pytest.raises(AvatarError, match="cuts leave nothing"):
        cut_garment(open_body("female"), GarmentConfig("collar", bottom=4.9, sleeve=0.5, neck=1.0, edge=0.04))


@pytest.mark.parametrize(
    "bad", [{"edge": 0.5}, {"top": 1.0}, {"top": None, "sleeve": None}], ids=["edge", "upside down", "no sleeve"]
)
def test_bad_garments_are_refused(bad):
    with pytest.raises(AvatarError):
        GarmentConfig(**{"name": "tee", "bottom": 2.0, "top": 3.0} | bad)


def test_unknown_names_list_the_known():
    with pytest.raises(AvatarError, match="tee, shirt, skirt, dress, jacket, coat, slacks, hoodie"):
        outfit("tuxedo")
    with pytest.raises(AvatarError, match="density"):
        FabricConfig(density=-1.0)


def test_edges_are_an_option_and_cling_stays_the_same_to_an_area():
    coarse, fine = (outfit("dress", edge=edge).garments[0] for edge in (0.0225, 0.01))
    assert fine.edge == 0.01 and fine.cling / coarse.cling == pytest.approx((0.01 / 0.0225) ** 2)
    assert [garment.edge for garment in outfit("coat", edge=0.03).garments] == [0.03] * 3
    with pytest.raises(AvatarError, match="edge: expected"):
        outfit("dress", edge=0.001)


def test_a_hood_covers_the_head_and_leaves_the_face():
    body = open_body("female")
    garment, cutting = cut_garment(body, coarse("hoodie", 1)), Cutting(body)
    assert garment.vertices[:, 1].max() > cutting.vertices[:, 1].max()
    nose = cutting.vertices[np.where(cutting.head > 0.5, cutting.vertices[:, 2], -1).argmax()]
    assert np.linalg.norm(garment.vertices - nose, axis=1).min() > 0.05


def test_wide_legs_stay_apart():
    body = open_body("female")
    garment, cutting = cut_garment(body, coarse("slacks", 0)), Cutting(body)
    shins = garment.vertices[garment.vertices[:, 1] < cutting.height(1)]
    assert 0.003 < np.abs(shins[:, 0]).min() < 0.03 and np.ptp(shins[shins[:, 0] > 0, 0]) > 0.18


def test_every_outfit_names_its_garments_once():
    for name in OUTFIT_NAMES:
        names = [garment.name for garment in outfit(name).garments]
        assert len(set(names)) == len(names) >= 1
