"""The clothed template on shapes whose answer is known: spheres, tubes with open ends, a body with a cuff."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from limbs import arm_template, true_weights, tube
from scipy.spatial.transform import Rotation

from avatar.body.open import open_body
from avatar.canonical import clothed
from avatar.canonical.clothed import (
    ClothedConfig,
    ScanInPose,
    WeightKind,
    assemble,
    drop_small_parts,
    fill_holes,
    find_faults,
    find_skin,
    fuse_garment,
    skin_faces,
    template_facts,
    weigh_garment,
)
from avatar.canonical.clothed_weights import diffuse_weights, inpaint_weights, tidy_weights
from avatar.canonical.refinement import PosedPoints, RefineConfig, chamfer, refine
from avatar.canonical.skin import body_offsets, estimate_noise, vote_skin, without_islands
from avatar.canonical.winding import area_vectors, disc_areas, grid_around
from avatar.checks import AvatarError, DataError
from avatar.geometry.laplacians import boundary_edges, cotangent_laplacian, mesh_parts, smooth_votes, vertex_areas
from avatar.geometry.surface import vertex_normals
from avatar.io.clothed_templates import read_clothed_template, write_clothed_template
from avatar.records import CanonicalScan, ClothedTemplate, Mesh

pytest.importorskip("pyacvd")
QUICK = ClothedConfig(spacing=0.016, edge=0.04, smooth=0.03, held_back=0.0, refine=RefineConfig(steps=0))
TUNIC = 0.02  # metres between trunk and tunic


def scan_of(points: np.ndarray, normals: np.ndarray, faces=None, weights=None) -> CanonicalScan:
    weights = np.ones((len(points), 1), np.float32) if weights is None else weights
    return CanonicalScan(
        points.astype(np.float32), normals.astype(np.float32), weights.astype(np.float32), np.arange(len(points)), faces
    )


def ball(radius: float, count: int = 6000) -> CanonicalScan:
    """Even points on a sphere (golden spiral)."""
    places = np.arange(count) + 0.5
    height, turn = 1 - 2 * places / count, np.pi * (1 + 5**0.5) * places
    flat = np.sqrt(1 - height**2)
    normals = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    return scan_of(radius * normals, normals)


def fused(scans, second=None, spacing=0.016, blur=0.016):
    grid = grid_around(np.full(3, -0.4), np.full(3, 0.4), spacing)
    for scan in scans:
        grid.add(scan.points, area_vectors(scan), np.ones(len(scan.points), bool) if second is None else second)
    return grid.solve(blur)


def test_areas_of_points_alone_sum_to_the_sphere():
    scan = ball(0.3)
    assert disc_areas(scan.points).sum() == pytest.approx(4 * np.pi * 0.09, rel=0.03)


def test_winding_number_is_one_inside_and_zero_outside():
    winding = fused([ball(0.3)])
    assert winding.at(np.array([[0.0, 0, 0], [0.1, 0.1, 0], [0, 0.2, 0]])) == pytest.approx(1, abs=0.05)
    assert winding.at(np.array([[0.42, 0, 0], [0, 0.45, 0]])) == pytest.approx(0, abs=0.05)


def test_the_surface_of_nested_spheres_is_their_majority():
    """The vote passes a half a quarter into the step of two scans of three, which the blur makes a normal ogive."""
    inwards = 0.6745 * 0.016
    for radii, expected in (((0.2, 0.3, 0.3), 0.3 - inwards), ((0.2, 0.2, 0.3), 0.2 + inwards)):
        surface = fused([ball(radius) for radius in radii]).surface(0.5)
        assert np.linalg.norm(surface.vertices, axis=1).mean() == pytest.approx(expected, abs=0.004)
        solid = trimesh.Trimesh(surface.vertices, surface.faces)
        assert solid.is_watertight and solid.volume > 0  # outwards


def test_scans_turned_inside_out_are_refused():
    scan = ball(0.3)
    with pytest.raises(AvatarError, match="normals point outwards"):
        fused([replace(scan, normals=-scan.normals)]).surface(0.5)


def skirt(count: int, low: float, seed: int = 0, radius: float = 0.25) -> CanonicalScan:
    """Points on a tube that is open below and closed by a flat lid on top."""
    rng = np.random.default_rng(seed)
    turn, height = rng.random(count) * 2 * np.pi, low + rng.random(count) * (0.3 - low)
    normals = np.stack([np.cos(turn), np.zeros(count), np.sin(turn)], axis=1)
    wall = radius * normals + height[:, None] * np.array([0, 1.0, 0])
    lid = rng.random((count // 3, 2)) * 2 * radius - radius
    lid = lid[np.linalg.norm(lid, axis=1) < radius]
    top = np.stack([lid[:, 0], np.full(len(lid), 0.3), lid[:, 1]], axis=1)
    up = np.tile([0, 1.0, 0], (len(top), 1))
    return scan_of(np.concatenate([wall, top]), np.concatenate([normals, up]))


def test_walls_are_supported_and_the_cap_of_an_opening_is_not():
    winding = fused([skirt(8000, -0.3, seed) for seed in range(3)])
    surface = winding.surface(0.4)
    share = winding.support(surface.vertices)[:, 1]
    radii, heights = np.linalg.norm(surface.vertices[:, [0, 2]], axis=1), surface.vertices[:, 1]
    assert (share[(radii > 0.23) & (heights > -0.25) & (heights < 0.25)] > 0.8).all()
    assert (share[(radii < 0.15) & (heights < -0.2)] < 0.2).all()


def test_the_hem_is_where_half_of_the_scans_end():
    lows = (-0.3, -0.2, -0.2, -0.1, -0.1)
    winding = fused([skirt(8000, low, seed) for seed, low in enumerate(lows)])
    surface = winding.surface(0.4)
    share = smooth_votes(
        surface.vertices,
        surface.faces,
        (winding.support(surface.vertices)[:, 1] > 0.5) * 1.0,
        np.ones(len(surface.vertices)),
        0.02,
    )
    wall = np.linalg.norm(surface.vertices[:, [0, 2]], axis=1) > 0.2
    assert surface.vertices[wall & (share > 0.5), 1].min() == pytest.approx(-0.2, abs=0.03)


def icosphere(radius: float = 0.3, subdivisions: int = 3) -> Mesh:
    solid = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(np.asarray(solid.vertices), np.asarray(solid.faces, np.int64))


def beside(first: Mesh, second: Mesh) -> Mesh:
    """Two meshes as one, the second a metre away along every axis."""
    faces = np.concatenate([first.faces, second.faces + len(first.vertices)])
    return Mesh(np.concatenate([first.vertices, second.vertices + 1]), faces)


def test_cotangent_laplacian_of_linear_and_square_functions():
    heights, widths = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21), indexing="ij")
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).reshape(-1)
    faces = np.concatenate([corner[:, None] + [0, 1, 21], corner[:, None] + [1, 22, 21]])
    plane = np.stack([widths.reshape(-1), heights.reshape(-1), np.zeros(441)], axis=1)
    inner = ((plane[:, :2] > 0.01) & (plane[:, :2] < 0.99)).all(axis=1)
    laplacian, masses = cotangent_laplacian(plane, faces), vertex_areas(plane, faces)
    assert masses.sum() == pytest.approx(1)
    assert laplacian @ np.ones(441) == pytest.approx(0, abs=1e-12)
    assert (laplacian @ plane[:, 0])[inner] == pytest.approx(0, abs=1e-12)
    assert (laplacian @ plane[:, 0] ** 2 / masses)[inner] == pytest.approx(-2, abs=1e-9)


def test_votes_are_smoothed_and_those_without_confidence_follow_their_neighbours():
    sphere = icosphere()
    votes = (sphere.vertices[:, 1] > 0).astype(float)
    votes[:5] = 1 - votes[:5]  # mistakes
    confidence = np.ones(len(votes))
    hidden = np.linalg.norm(sphere.vertices - [0, 0.3, 0], axis=1) < 0.1
    confidence[hidden] = 0
    votes[hidden] = 0
    smooth = smooth_votes(sphere.vertices, sphere.faces, votes, confidence, 0.05)
    clear = np.abs(sphere.vertices[:, 1]) > 0.03
    assert ((smooth > 0.5) == (sphere.vertices[:, 1] > 0))[clear].all()
    apart = beside(sphere, sphere)
    only_first = np.concatenate([np.ones(642), np.zeros(642)])
    both = smooth_votes(apart.vertices, apart.faces, only_first, only_first, 0.05)
    assert both[:642] == pytest.approx(1) and np.isnan(both[642:]).all()


def test_islands_take_the_label_around_them_and_the_largest_stays():
    sphere = icosphere()
    labels = sphere.vertices[:, 1] > 0.1
    spotted = labels.copy()
    spotted[np.linalg.norm(sphere.vertices - [0, -0.3, 0], axis=1) < 0.06] = True
    areas = vertex_areas(sphere.vertices, sphere.faces)
    assert (without_islands(sphere.faces, spotted, areas, 0.05) == labels).all()
    assert (without_islands(sphere.faces, labels, areas, 10.0) == labels).all()


# ---- skin: the open body with a tunic on its trunk


@pytest.fixture(scope="module")
def person():
    return open_body("female").template


def dressed_scan(template, seed: int, noise: float = 0.001, ease: float = TUNIC, points: int = 25_000) -> ScanInPose:
    """A canonical scan of points: the body's surface, on the trunk pushed out by ``ease``."""
    mesh = trimesh.Trimesh(template.vertices.numpy(), template.faces.numpy(), process=False)
    rng = np.random.default_rng(seed)
    weights = mesh.area_faces / mesh.area
    ids = rng.choice(len(weights), points, p=weights)
    root, along = np.sqrt(rng.random(points)), rng.random(points)
    shares = np.stack([1 - root, root * (1 - along), root * along], axis=1)
    corners = template.faces.numpy()[ids]
    blend = lambda values: np.einsum("nk,nkc->nc", shares, values[corners])  # noqa: E731
    normals = blend(vertex_normals(template.vertices, template.faces).numpy())
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    covered = blend(under_tunic(template)[:, None].astype(float))[:, 0] > 0.5
    places = blend(template.vertices.numpy()) + (ease * covered)[:, None] * normals
    places += noise * rng.standard_normal(places.shape)
    scan = scan_of(places, normals, None, blend(template.weights.numpy()))
    rest = torch.eye(4).expand(len(template.parents), 4, 4)
    return ScanInPose(scan, rest, template.vertices.numpy(), template)


def under_tunic(template) -> np.ndarray:
    trunk = [template.joint_names.index(name) for name in ("pelvis", "spine1", "spine2", "spine3")]
    return (template.weights[:, trunk].sum(dim=1) > 0.6).numpy()


def outer(template) -> np.ndarray:
    """Vertices that can be seen from outside: not those of the mouth and behind the eyes."""
    mesh = trimesh.Trimesh(template.vertices.numpy(), template.faces.numpy(), process=False)
    head = template.vertices[:, 1] > template.vertices[:, 1].max() - 0.3
    return ~head.numpy() & (mesh.vertex_defects < 10)


def test_skin_is_found_and_eyes_and_hands_are_whole(person):
    vote = find_skin([dressed_scan(person, seed) for seed in range(2)], person, QUICK)
    covered = under_tunic(person)
    assert (vote.bare == ~covered)[outer(person)].mean() > 0.98
    head = person.vertices[:, 1].numpy() > person.vertices[:, 1].max().item() - 0.2
    hands = np.abs(person.vertices[:, 0].numpy()) > 0.7
    assert vote.bare[head | hands].all()  # the insides of mouth and eyes, which no scan shows, too
    assert 0.0005 < vote.noise < 0.003
    parts = mesh_parts(person.faces.numpy()[~vote.bare[person.faces.numpy()].any(axis=1)], len(vote.bare))
    assert len(np.unique(parts[(~vote.bare) & covered])) <= 3  # one tunic, but for single vertices at its edge


def test_cover_far_from_the_body_is_seen_through(person):
    scan = dressed_scan(person, 0, ease=0.08)
    offsets = body_offsets(*scan.posed, scan.body, scan.body_normals)
    inner = under_tunic(person) & np.isfinite(offsets)
    assert inner.sum() > 0.7 * under_tunic(person).sum()  # not in armpits and between the legs
    assert np.median(offsets[inner]) == pytest.approx(0.08, abs=0.015)


def test_noise_is_that_of_the_barest_part_and_needs_no_names(person):
    offsets = np.random.default_rng(0).normal(0, 0.002, (4, len(person.vertices)))
    assert estimate_noise(offsets, person) == pytest.approx(0.002, rel=0.1)
    head = person.weights[:, person.joint_names.index("head")].numpy() > 0.5
    with_hair = np.where(head, 0.04, offsets)
    assert estimate_noise(with_hair, person) == pytest.approx(0.002, rel=0.1)
    nameless = replace(person, joint_names=tuple(f"j{i}" for i in range(len(person.parents))))
    assert 0 < estimate_noise(offsets, nameless) < 0.003
    with pytest.raises(AvatarError, match="one unit and one origin"):
        vote_skin(np.full((1, len(person.vertices)), np.nan), person, 0.02, 0.002)


def test_one_scan_of_points_makes_a_template(person):
    """From one scan without faces: the tunic is one part, open above and below, and skin is the body's."""
    scans = [dressed_scan(person, 0)]
    vote = find_skin(scans, person, QUICK)
    garment = fuse_garment(scans, person, vote, QUICK)
    weighed = weigh_garment(garment.mesh, person, None, [], [PosedPoints(*points_of(scans[0], vote))], QUICK)
    made = assemble(person, vote, weighed, QUICK)
    facts = template_facts(made, person)
    assert facts["garment_parts"] == 1 and facts["hems"] == 2 and facts["manifold_faults"] == 0
    assert facts["penetrating_share"] == 0
    skin = made.body_vertex >= 0
    assert (made.vertices[skin] == person.vertices.numpy()[made.body_vertex[skin]]).all()
    assert made.covered.any() and not made.covered[~skin].any()
    assert (made.covered[skin] == ~vote.bare[made.body_vertex[skin]]).all()
    visible = made.visible_faces
    assert visible[made.garment_faces].all() and not visible.all()  # the skin's overlap is hidden
    assert (
        visible[~made.garment_faces] == vote.bare[made.body_vertex[made.faces[~made.garment_faces]]].all(axis=1)
    ).all()
    assert np.abs(made.weights.sum(axis=1) - 1).max() < 1e-5
    assert any("scan" in fault for fault in find_faults(facts, 1, vote, garment, weighed))
    hits = clothed.closest_on_mesh(garment.mesh.vertices, person.vertices.numpy(), person.faces.numpy())
    assert np.median(hits.signed_distances) == pytest.approx(TUNIC, abs=0.006)


def points_of(scan: ScanInPose, vote) -> tuple[np.ndarray, torch.Tensor]:
    return scan.posed[0][scan.garment_points(vote)], scan.joint_transforms


def test_a_person_without_clothes_is_the_body(person):
    scans = [dressed_scan(person, 0, ease=0.0)]
    vote = find_skin(scans, person, QUICK)
    assert vote.bare.all()
    garment = fuse_garment(scans, person, vote, QUICK)
    assert not len(garment.mesh.faces)
    made = assemble(person, vote, None, QUICK)
    assert len(made.vertices) == len(person.vertices) and (made.body_vertex >= 0).all() and made.visible_faces.all()
    assert "no garment" in find_faults(template_facts(made, person), 9, vote, garment, None)[0]


def test_nothing_and_too_few_points_are_refused(person):
    with pytest.raises(AvatarError, match=r"at least one canonical scan, got none. Hint: run tools/canonicalize.py"):
        find_skin([], person, QUICK)
    with pytest.raises(AvatarError, match="at least one canonical scan"):
        fuse_garment([], person, None, QUICK)
    with pytest.raises(AvatarError, match="expected at least 500 a canonical scan, got 100"):
        dressed_scan(person, 0, points=100)
    for options in ({"spacing": 0.0}, {"edge": 0.001}, {"level": 1.0}, {"held_back": 0.9}, {"overlap": -1.0}):
        with pytest.raises(AvatarError, match="expected"):
            ClothedConfig(**options)


def test_a_hole_of_all_scans_is_filled_and_an_opening_is_not(person):
    sphere = icosphere(0.3)
    share, support = np.ones(len(sphere.vertices)), np.zeros((len(sphere.vertices), 2))
    hole = np.linalg.norm(sphere.vertices - [0, 0, 0.3], axis=1) < 0.1
    share[hole] = 0
    outside = replace(person, vertices=person.vertices + 5)
    closed, areas = fill_holes(sphere, share, support, outside)
    assert (closed == 1).all() and len(areas) == 1 and areas[0] == pytest.approx(np.pi * 0.01, rel=0.4)
    spine = torch.linspace(0.1, 0.5, 200)[:, None] * torch.tensor([0.0, 0.0, 1.0])  # a limb through the hole
    through = replace(person, vertices=spine)
    assert fill_holes(sphere, share, support, through)[1] == []
    support[hole, 0] = 1  # skin
    assert fill_holes(sphere, share, support, outside)[1] == []


def test_small_parts_are_dropped_and_counted():
    large, small = icosphere(0.3), icosphere(0.02)
    both = beside(large, small)
    kept, dropped = drop_small_parts(both, 0.01)
    assert len(kept.faces) == len(large.faces) and dropped == [pytest.approx(4 * np.pi * 0.0004, rel=0.02)]


def test_skin_goes_on_below_the_garment_by_the_overlap(person):
    bare = person.vertices[:, 1].numpy() > 0.4
    heights = person.vertices[:, 1].numpy()
    lowest = [heights[np.unique(skin_faces(person, bare, overlap))].min() for overlap in (0.0, 0.05, 0.1)]
    assert 0.4 > lowest[0] > lowest[1] >= 0.3 and lowest[1] > lowest[2] >= 0.25


# ---- weights and refinement: a sleeve around an arm


def sleeve(radius: float = 0.1, low: float = 0.0, high: float = 1.0) -> Mesh:
    vertices, _, faces = tube(radius, low, high)
    mesh = Mesh(vertices.numpy(), faces.numpy())
    outward = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).face_normals
    middle = mesh.vertices[mesh.faces].mean(axis=1) * [1, 0, 1]
    return mesh if (outward * middle).sum() > 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1].copy())


@pytest.mark.parametrize("transfer", [inpaint_weights, diffuse_weights])
def test_close_cloth_has_the_weights_of_the_body_below(transfer):
    template, mesh = outward_arm(), sleeve()
    weights = transfer(mesh, template)
    assert weights.min() >= 0 and np.abs(weights.sum(axis=1) - 1).max() < 1e-6
    expected = true_weights(torch.from_numpy(mesh.vertices)).numpy()
    assert np.abs(weights - expected).max() < 0.1


def outward_arm():
    """The arm with its faces wound outwards, as bodies are."""
    arm = arm_template()
    mesh = trimesh.Trimesh(arm.vertices.numpy(), arm.faces.numpy(), process=False)
    inward = (mesh.face_normals * (mesh.triangles_center * [1, 0, 1])).sum() < 0
    return replace(arm, faces=arm.faces.flip(1)) if inward else arm


def test_inpainting_goes_on_smoothly_where_the_body_is_far():
    template = outward_arm()
    mesh = sleeve(0.1, 0.0, 1.0)
    bulging = mesh.vertices.copy()
    middle = np.exp(-(((bulging[:, 1] - 0.5) / 0.12) ** 2))
    bulging[:, [0, 2]] *= (1 + 3 * middle)[:, None]  # a balloon around the elbow, 30 cm off
    weights = inpaint_weights(Mesh(bulging, mesh.faces), template)
    assert weights.min() >= 0 and np.abs(weights.sum(axis=1) - 1).max() < 1e-6
    rings = weights[:, 1].reshape(40, 24)
    assert (rings.std(axis=1) < 0.02).all()  # as round as the shape
    assert rings.mean(axis=1)[:5].max() < 0.05 and (np.diff(rings.mean(axis=1)[5:25]) > -0.02).all()


def test_weights_without_support_are_refused():
    with pytest.raises(AvatarError, match="positive weight"):
        tidy_weights(np.array([[0.0, -1.0]]))
    kept = tidy_weights(np.random.default_rng(0).random((4, 20)))
    assert ((kept > 0).sum(axis=1) == 8).all()


def test_refinement_comes_closer_and_stays_smooth():
    """From a sphere one centimetre too small to the scans' sphere, seen through two rigid motions."""
    target, start = icosphere(0.3), icosphere(0.29)
    turn = torch.eye(4)
    turn[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.3, 0.2, 0]).as_matrix()).float()
    scans = [
        PosedPoints((target.vertices @ np.eye(3)).astype(np.float32), torch.eye(4)[None]),
        PosedPoints((target.vertices @ turn[:3, :3].numpy().T).astype(np.float32), turn[None]),
    ]
    weights = np.ones((len(start.vertices), 1), np.float32)
    before = chamfer(start, weights, scans, None, 4000)
    refined = refine(start, weights, scans, None, RefineConfig(steps=30, samples=2000, length=0.05))
    after = chamfer(refined.mesh, refined.weights, scans, None, 4000)
    assert after < 0.7 * before and len(refined.losses) == 30
    radii = np.linalg.norm(refined.mesh.vertices, axis=1)
    assert radii.mean() == pytest.approx(0.3, abs=0.004) and radii.std() < 0.002
    with pytest.raises(AvatarError, match="at least one"):
        chamfer(start, weights, [], None, 100)


def test_the_best_weights_are_taken_and_a_missing_field_is_named(person):
    mesh, template = sleeve(), outward_arm()
    points = PosedPoints(mesh.vertices, torch.eye(4).expand(3, 4, 4))
    weighed = weigh_garment(mesh, template, None, [points], [], QUICK)
    assert weighed.kind == min(weighed.errors, key=weighed.errors.get) and weighed.held_back == 0
    with pytest.raises(AvatarError, match="learned weights"):
        weigh_garment(mesh, template, None, [points], [], replace(QUICK, weights=WeightKind.learned))


# ---- files


def test_a_clothed_template_survives_the_disk(tmp_path, person):
    made = ClothedTemplate(
        person.vertices.numpy()[:4],
        np.array([[0, 1, 2]]),
        np.full((4, 2), 0.5, np.float32),
        np.array([0, 1, 2, -1]),
        np.array([False, True, False, False]),
    )
    write_clothed_template(tmp_path / "t.npz", made)
    again = read_clothed_template(tmp_path / "t.npz")
    for name in ("vertices", "faces", "weights", "body_vertex", "covered"):
        assert (getattr(again, name) == getattr(made, name)).all()
    for change, message in (
        ({"weights": made.weights * 2}, "summing to 1"),
        ({"faces": np.array([[0, 1, 3]])}, "between skin and garment"),
        ({"faces": np.array([[0, 1, 9]])}, "faces"),
        ({"vertices": made.vertices * np.nan}, "finite"),
        ({"covered": ~made.covered}, "skin vertices alone, got 1"),
        ({"covered": made.covered[:3]}, "covered"),
    ):
        with pytest.raises(AvatarError, match=message):
            write_clothed_template(tmp_path / "u.npz", replace(made, **change))
    with pytest.raises(DataError):
        read_clothed_template(tmp_path / "none.npz")


def test_boundary_edges_of_a_tube_are_its_two_rings():
    mesh = sleeve()
    around = boundary_edges(mesh.faces)
    assert len(around) == 48
    loops = mesh_parts(np.concatenate([around, around[:, 1:]], axis=1), len(mesh.vertices))
    assert len(np.unique(loops[around[:, 0]])) == 2
