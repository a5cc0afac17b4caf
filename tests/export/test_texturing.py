"""Textures: the atlas, the places of its texels, colours that come back sharper than vertices', and what is filled."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError
from avatar.export.texturing import (
    PADDING,
    Blend,
    Places,
    SeenColors,
    bake,
    bilateral_mean,
    drop_mixed_borders,
    encode_png,
    fill_unseen,
    fine_mesh,
    fit_distance,
    map_texels,
    paint_image,
    planar_barycentric,
    point_spacing,
    points_on_mesh,
    sample_image,
    unwrap,
    vertex_places,
)
from avatar.records import ClothedTemplate, Mesh, Scan

pytest.importorskip("xatlas")
RADIUS = 0.5
TEXEL = 0.01
RED, WHITE = np.array([0.8, 0.1, 0.1]), np.array([0.9, 0.9, 0.9])


def sphere() -> ClothedTemplate:
    """A sphere of 642 vertices, all garment but the lowest part, which is covered skin."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int64)
    skin = vertices[:, 1] < -0.4
    kept = skin[faces].all(axis=1) | ~skin[faces].any(axis=1)
    order = np.argsort(~skin, kind="stable")
    rank = np.argsort(order)
    used = np.unique(rank[faces[kept]])
    small = np.full(len(vertices), -1)
    small[used] = np.arange(len(used))
    skin = skin[order][used]
    return ClothedTemplate(
        vertices=vertices[order][used],
        faces=small[rank[faces[kept]]],
        weights=np.ones((len(used), 1), np.float32),
        body_vertex=np.where(skin, np.arange(len(used)), -1),
        covered=skin,
    )


CLOTHED = sphere()
UNWRAPPED = unwrap(CLOTHED, TEXEL)
TEXELS = map_texels(UNWRAPPED, CLOTHED.visible_faces)


def pattern(points: np.ndarray) -> np.ndarray:
    """Upright stripes, 8 cm wide before and behind: vertices are 7 cm apart."""
    odd = np.floor(points[:, 0] / 0.08) % 2 == 1
    return np.where(odd[:, None], RED, WHITE)


def scan(points: int = 20000, seed: int = 0, kept=lambda place: np.ones(len(place), bool)) -> Scan:
    """Coloured points of the sphere, those that ``kept`` says."""
    places = np.random.default_rng(seed).standard_normal((points, 3))
    normals = places / np.linalg.norm(places, axis=1, keepdims=True)
    normals = normals[kept(normals)].astype(np.float32)
    return Scan(RADIUS * normals, normals, colors=pattern(RADIUS * normals).astype(np.float32))


def test_the_atlas_has_every_visible_face_once_at_its_size():
    shown = CLOTHED.visible_faces
    assert 0 < (~shown).sum() < len(shown) and UNWRAPPED.uv.min() >= 0 and UNWRAPPED.uv.max() <= 1
    corners = UNWRAPPED.uv[UNWRAPPED.uv_faces].astype(np.float64) * UNWRAPPED.size
    areas = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 2
    true = trimesh.triangles.area(CLOTHED.vertices[CLOTHED.faces].astype(np.float64)) / TEXEL**2
    assert areas[shown].sum() == pytest.approx(true[shown].sum(), rel=0.1)  # texels of the asked size
    assert (areas[~shown] == 0).all()  # one colour each
    # no two faces share ground: points inside UV triangles lie in one triangle alone
    middles = corners[shown].mean(axis=1)
    inside = [
        (planar_barycentric(middles, np.broadcast_to(c, (len(middles), 3, 2))) > 1e-6).all(axis=1)
        for c in corners[shown]
    ]
    assert (np.sum(inside, axis=0) == 1).all()
    # neighbouring corners of a vertex agree with its own place
    vertex_of = np.full(len(UNWRAPPED.uv), -1)
    vertex_of[UNWRAPPED.uv_faces[shown]] = CLOTHED.faces[shown]
    assert (vertex_of[UNWRAPPED.uv_faces[shown]] == CLOTHED.faces[shown]).all()


def test_hidden_faces_take_the_colour_of_the_nearest_visible_vertex():
    hidden = np.flatnonzero(~CLOTHED.visible_faces)
    assert (UNWRAPPED.uv_faces[hidden] == UNWRAPPED.uv_faces[hidden][:, :1]).all()
    vertex_of = np.full(len(UNWRAPPED.uv), -1)
    vertex_of[UNWRAPPED.uv_faces[CLOTHED.visible_faces]] = CLOTHED.faces[CLOTHED.visible_faces]
    near = CLOTHED.vertices[vertex_of[UNWRAPPED.uv_faces[hidden, 0]]]
    away = np.linalg.norm(near - CLOTHED.vertices[CLOTHED.faces[hidden]].mean(axis=1), axis=1)
    visible = CLOTHED.vertices[np.unique(CLOTHED.faces[CLOTHED.visible_faces])]
    middles = CLOTHED.vertices[CLOTHED.faces[hidden]].mean(axis=1)
    np.testing.assert_allclose(away, np.linalg.norm(middles[:, None] - visible, axis=2).min(axis=1), atol=1e-6)


def test_texels_come_back_to_their_centres_and_no_face_is_without():
    height, width = TEXELS.shape
    assert len(np.unique(TEXELS.texels)) == len(TEXELS.texels) and (width, height) == UNWRAPPED.size
    places = TEXELS.places
    assert set(places.face_ids) == set(np.flatnonzero(CLOTHED.visible_faces))
    np.testing.assert_allclose(places.barycentric.sum(axis=1), 1, atol=1e-6)
    uv = places.on(UNWRAPPED.uv, UNWRAPPED.uv_faces)
    rows, columns = np.divmod(TEXELS.texels, width)
    centres = np.stack([(columns + 0.5) / width, 1 - (rows + 0.5) / height], axis=1)
    np.testing.assert_allclose(uv, centres, atol=1e-5)


def test_a_face_smaller_than_a_texel_has_one_and_a_flat_one_is_nowhere():
    small = replace(UNWRAPPED, uv=np.array([[0.31, 0.3], [0.32, 0.3], [0.31, 0.32]], np.float32), size=(10, 10))
    small = replace(small, uv_faces=np.array([[0, 1, 2], [0, 0, 1]]))
    found = map_texels(small, np.array([True, False]))
    assert found.texels.tolist() == [63] and found.places.face_ids.tolist() == [0]
    corners = np.array([[[0.0, 0], [1, 1], [2, 2]]])
    assert (planar_barycentric(np.array([[1.0, 1.0]]), corners) == -1).all()


def image_of(seen: SeenColors) -> np.ndarray:
    """The image of baked colours, those that were not seen filled."""
    places, kinds = TEXELS.places, CLOTHED.garment_faces
    return paint_image(TEXELS, fill_unseen(places, seen.colors, seen.seen, CLOTHED.vertices, CLOTHED.faces, kinds))


def errors(colors_at) -> float:
    """The mean difference of colours at points of a scan of its own."""
    other = scan(5000, seed=9, kept=lambda normals: normals[:, 1] > -0.6)
    places, kept = points_on_mesh(other, CLOTHED.vertices, CLOTHED.faces, 0.02)
    assert len(kept) > 0.99 * len(other.points)
    return float(np.abs(colors_at(places) - other.colors[kept]).mean())


def test_a_pattern_comes_back_sharper_than_from_vertices():
    seen = bake(TEXELS.places, CLOTHED.faces, [(CLOTHED.vertices, scan())], 0.03)
    assert seen.seen.mean() > 0.99
    image = image_of(seen)
    textured = errors(lambda at: sample_image(image, at.on(UNWRAPPED.uv, UNWRAPPED.uv_faces)))
    vertices = vertex_places(CLOTHED.faces, len(CLOTHED.vertices))
    baked = bake(vertices, CLOTHED.faces, [(CLOTHED.vertices, scan())], 0.03)
    assert baked.seen.mean() > 0.99
    per_vertex = errors(lambda at: at.on(baked.colors, CLOTHED.faces))
    assert textured < 0.04 and per_vertex > 3.5 * textured  # measured: 0.027 and 0.122, 4.5 times
    fine = fine_mesh(Mesh(CLOTHED.vertices, CLOTHED.faces), UNWRAPPED, image, CLOTHED.visible_faces)
    assert len(fine.faces) == 36 * CLOTHED.visible_faces.sum()
    area = trimesh.triangles.area(fine.vertices[fine.faces].astype(np.float64)).sum()
    true = trimesh.triangles.area(CLOTHED.vertices[CLOTHED.faces[CLOTHED.visible_faces]].astype(np.float64)).sum()
    assert area == pytest.approx(true, rel=1e-4)
    assert np.abs(fine.colors - pattern(fine.vertices)).mean() < 0.08


def test_the_first_frame_keeps_figures_that_a_mean_over_sliding_frames_loses():
    def turned(angle: float) -> Scan:
        """The sphere turned below the mesh, as cloth slides."""
        base, (cosine, sine) = scan(seed=round(100 * angle)), (np.cos(angle), np.sin(angle))
        turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]], np.float32)
        return replace(base, points=base.points @ turn.T, normals=base.normals @ turn.T)

    frames = [(CLOTHED.vertices, turned(angle)) for angle in (0.0, 0.1, 0.2, 0.3)]
    found = {}
    for blend in Blend:
        seen = bake(TEXELS.places, CLOTHED.faces, frames, 0.03, blend)
        image = image_of(seen)
        found[blend] = errors(lambda at, image=image: sample_image(image, at.on(UNWRAPPED.uv, UNWRAPPED.uv_faces)))
    assert found[Blend.first] < 0.04 and found[Blend.mean] > 3 * found[Blend.first]


def test_later_frames_fill_what_the_first_did_not_see():
    half = scan(kept=lambda normals: normals[:, 0] > 0)
    other = replace(scan(seed=1), colors=np.full((20000, 3), 0.25, np.float32))
    frames = [(CLOTHED.vertices, half), (CLOTHED.vertices, other)]
    seen = bake(TEXELS.places, CLOTHED.faces, iter(frames), 0.03)
    x = TEXELS.places.on(CLOTHED.vertices, CLOTHED.faces)[:, 0]
    assert (seen.frames[x > 0.03] == 0).mean() > 0.99 and (seen.frames[x < -0.03] == 1).mean() > 0.99
    assert np.allclose(seen.colors[seen.frames == 1], 0.25, atol=1e-6)
    away = Scan(half.points, -half.normals, colors=half.colors)  # the inside of something
    assert not bake(TEXELS.places, CLOTHED.faces, [(CLOTHED.vertices, away)], 0.03).seen.any()


def test_what_no_scan_saw_is_filled_smoothly_from_around_it():
    height = TEXELS.places.on(CLOTHED.vertices, CLOTHED.faces)[:, 1]
    colors = np.stack([0.5 + height / 2, np.full(len(height), 0.3), 0.5 - height / 2], axis=1).astype(np.float32)
    seen = np.abs(height) > 0.12
    filled = fill_unseen(
        TEXELS.places, colors * seen[:, None], seen, CLOTHED.vertices, CLOTHED.faces, CLOTHED.garment_faces
    )
    assert np.array_equal(filled[seen], colors[seen])
    assert np.abs(filled - colors)[~seen].max() < 0.06  # a band of 24 cm in which the colour is nearly linear
    garment = CLOTHED.garment_faces
    nothing = fill_unseen(TEXELS.places, colors, np.ones(len(seen), bool), CLOTHED.vertices, CLOTHED.faces, garment)
    assert nothing is colors
    with pytest.raises(AvatarError, match=r"none does\. Hint: a larger reach"):
        fill_unseen(TEXELS.places, colors, np.zeros(len(seen), bool), CLOTHED.vertices, CLOTHED.faces, garment)


def meeting_parts() -> ClothedTemplate:
    """A plane of 40 x 20 cm in quads of 1 cm: the left half skin, the right half garment, side by side."""
    across, down = np.meshgrid(np.arange(21), np.arange(21), indexing="ij")
    half = np.stack([across, down, np.zeros_like(down)], axis=2).reshape(-1, 3) / 100
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).reshape(-1, 1)
    faces = np.concatenate([corner + [0, 21, 1], corner + [1, 21, 22]])
    count = len(half)
    return ClothedTemplate(
        vertices=np.concatenate([half - [0.2, 0, 0], half]).astype(np.float32),
        faces=np.concatenate([faces, faces + count]),
        weights=np.ones((2 * count, 1), np.float32),
        body_vertex=np.concatenate([np.arange(count), np.full(count, -1)]),
        covered=np.zeros(2 * count, bool),
    )


def test_skin_and_garment_give_back_what_they_took_from_each_other():
    clothed = meeting_parts()
    places = map_texels(unwrap(clothed, 0.004), clothed.visible_faces).places
    x, y, _ = places.on(clothed.vertices, clothed.faces).T
    true = np.where((x < 0)[:, None], [0.8, 0.6, 0.5], WHITE)
    true[(x > 0.005) & (x < 0.02) & (y > 0.15)] = [0.2, 0.2, 0.6]  # a trimming on the garment's border
    for slipped in (0.015, -0.015):  # the scan's border is elsewhere: on the garment, or on skin
        colors = true.copy()
        wrong = (x > 0) & (x < slipped) & (y < 0.15) if slipped > 0 else (x < 0) & (x > slipped)
        colors[wrong] = [0.8, 0.6, 0.5] if slipped > 0 else WHITE
        seen = SeenColors(colors.astype(np.float32), np.zeros(len(x), np.int64))
        kept = drop_mixed_borders(places, seen, clothed)
        assert wrong.sum() > 100 and np.array_equal(kept.seen, ~wrong)
        assert not kept.colors[wrong].any() and np.array_equal(kept.colors[~wrong], seen.colors[~wrong])
        filled = fill_unseen(places, kept.colors, kept.seen, clothed.vertices, clothed.faces, clothed.garment_faces)
        assert np.abs(filled - true).mean() < 0.005
    alike = SeenColors(np.full((len(x), 3), 0.6, np.float32), np.zeros(len(x), np.int64))  # clothes the colour of skin
    assert drop_mixed_borders(places, alike, clothed).seen.all()
    alone = SeenColors(seen.colors[x > 0], seen.frames[x > 0])
    assert drop_mixed_borders(places.some(np.flatnonzero(x > 0)), alone, clothed) is alone


def test_a_part_that_nobody_saw_has_the_mean_colour_of_its_kind():
    faces = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8]])
    vertices = np.random.default_rng(0).random((9, 3)).astype(np.float32)
    places = Places(np.array([0, 1, 2]), np.full((3, 3), 1 / 3, np.float32))
    colors = np.array([[0.1, 0.2, 0.3], [0.8, 0.8, 0.8], [0, 0, 0]], np.float32)
    kinds = np.array([True, False, True])
    filled = fill_unseen(places, colors, np.array([True, True, False]), vertices, faces, kinds)
    np.testing.assert_allclose(filled, [colors[0], colors[1], colors[0]], atol=1e-5)


def test_charts_are_continued_by_a_few_texels():
    image = paint_image(TEXELS, np.full((len(TEXELS.texels), 3), 0.2))
    assert (image == 51).all()  # the rest has the mean colour
    colors = np.zeros((len(TEXELS.texels), 3))
    colors[::2] = 1
    filled = np.zeros(TEXELS.shape, bool)
    filled.flat[TEXELS.texels] = True
    image = paint_image(TEXELS, colors)
    step = np.roll(filled, 1, axis=1) & ~filled
    assert set(np.unique(image[step])) <= {0, 255} and step.any() and PADDING >= 2
    assert {127, 128} & set(np.unique(image))


def test_an_image_is_sampled_between_its_texels_as_png_viewers_do():
    image = np.zeros((2, 4, 3), np.uint8)
    image[0, 3], image[1, 0] = 255, 51
    uv = np.array([[0.875, 0.75], [0.125, 0.25], [0.0, 0.0], [0.125, 0.5], [1.0, 1.0]])
    np.testing.assert_allclose(sample_image(image, uv)[:, 0], [1, 0.2, 0.2, 0.1, 1])
    assert encode_png(image) == encode_png(image.copy()) and encode_png(image).startswith(b"\x89PNG")


def test_a_bilateral_mean_keeps_borders_and_averages_noise():
    colors = np.array([[[0.9] * 3, [0.92] * 3, [0.1] * 3]])
    np.testing.assert_allclose(bilateral_mean(colors, np.ones((1, 3))), [[0.91] * 3], atol=1e-3)
    np.testing.assert_allclose(bilateral_mean(colors, np.array([[0, 0, 1.0]])), [[0.1] * 3])
    assert np.array_equal(bilateral_mean(colors, np.zeros((1, 3))), np.zeros((1, 3)))


def test_spacing_and_fit_are_lengths():
    cloud = scan(20000)
    assert point_spacing(cloud.points) == pytest.approx(np.sqrt(4 * np.pi * RADIUS**2 / 20000), rel=0.03)
    outside = CLOTHED.vertices * 1.1
    assert fit_distance(outside, cloud, 0.5) == pytest.approx(0.05, rel=0.02)
    assert fit_distance(outside, cloud, 0.01) == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: unwrap(CLOTHED, 0.0), "texel: expected a size above 0 metres, got 0.0"),
        (lambda: unwrap(replace(CLOTHED, covered=np.ones(len(CLOTHED.covered), bool)), 0.01), "with visible faces"),
        (lambda: vertex_places(CLOTHED.faces, len(CLOTHED.vertices) + 1), "expected a face at each of"),
        (lambda: point_spacing(np.zeros((1, 3))), "points: expected at least 2, got 1"),
        (
            lambda: bake(TEXELS.places, CLOTHED.faces, [(CLOTHED.vertices, replace(scan(), colors=None))], 0.03),
            "scan: expected one with colours",
        ),
    ],
)
def test_what_cannot_be_textured_is_refused(call, message):
    with pytest.raises(AvatarError, match=message):
        call()


def test_a_texel_too_small_for_the_largest_image_becomes_larger(monkeypatch):
    monkeypatch.setattr("avatar.export.texturing.LARGEST", 128)
    found = unwrap(CLOTHED, TEXEL / 4)
    assert max(found.size) <= 128 and found.texel > TEXEL / 2


def test_the_same_template_has_the_same_atlas():
    again = unwrap(CLOTHED, TEXEL)
    assert np.array_equal(again.uv, UNWRAPPED.uv) and np.array_equal(again.uv_faces, UNWRAPPED.uv_faces)
