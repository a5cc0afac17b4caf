"""UV atlases: rasterising against a loop and by area, images of values in closed form, seams against a loop."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import Delaunay

from avatar.checks import AvatarError
from avatar.geometry.surface import interpolate
from avatar.geometry.uv import (
    check_atlas,
    paint,
    rasterise_uv,
    sample_uv,
    seam_edges,
    uv_areas,
    uv_barycentric,
)

SQUARE = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
HALVES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def random_atlas(seed: int = 0, points: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """A triangulated point set; every fourth triangle is left out, every third one turned over."""
    uv = np.random.default_rng(seed).random((points, 2)) * 0.9 + 0.05
    faces = Delaunay(uv).simplices
    faces[::3] = faces[::3, ::-1]
    return torch.from_numpy(uv), torch.from_numpy(np.delete(faces, np.s_[::4], axis=0)).long()


def rasterise_loop(uv, uv_faces, size) -> dict[int, int]:
    """Pixel to the first triangle that holds its centre: same side of all edges."""
    found = {}
    for pixel in range(size * size):
        x, y = (pixel % size + 0.5) / size, (pixel // size + 0.5) / size
        for face, ids in enumerate(uv_faces.tolist()):
            corners = [uv[i].tolist() for i in ids]
            sides = [
                (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
                for a, b in zip(corners, [corners[1], corners[2], corners[0]])
            ]
            if any(sides) and (min(sides) >= 0 or max(sides) <= 0):
                found[pixel] = face
                break
    return found


@pytest.mark.parametrize("seed", range(3))
def test_rasterising_agrees_with_a_loop(seed):
    uv, faces = random_atlas(seed)
    grid = rasterise_uv(uv, faces, faces, 24)
    expected = rasterise_loop(uv, faces, 24)
    assert dict(zip(grid.pixels.tolist(), grid.samples.face_ids.tolist())) == expected
    assert 200 < len(expected) < 24**2


def test_pixels_lie_where_their_samples_are():
    uv, faces = random_atlas()
    grid = rasterise_uv(uv, faces, faces, 50)
    centres = torch.stack([grid.pixels % 50 + 0.5, grid.pixels // 50 + 0.5], dim=-1) / 50
    torch.testing.assert_close(sample_uv(uv, faces, grid.samples), centres.double())
    assert torch.equal(grid.pixels, grid.pixels.sort().values)
    assert grid.samples.barycentric.min() >= 0
    torch.testing.assert_close(grid.samples.barycentric.sum(dim=1), torch.ones(len(grid.pixels)).double())


def test_samples_name_the_surface_not_the_atlas():
    uv, uv_faces = random_atlas()
    faces = uv_faces + 7
    samples = rasterise_uv(uv, uv_faces, faces, 20).samples
    assert torch.equal(samples.vertex_ids, faces[samples.face_ids])


def test_centres_on_a_shared_edge_belong_to_the_first_triangle():
    """The diagonal of the square runs through the centres of all diagonal pixels; no pixel is lost or counted twice."""
    for order in ([0, 1], [1, 0]):
        grid = rasterise_uv(SQUARE, HALVES[order], HALVES[order], 16)
        assert grid.pixels.tolist() == list(range(256))
        assert (grid.samples.face_ids[:: 16 + 1] == 0).all()
        assert int((grid.samples.face_ids == 0).sum()) == 16 * 17 // 2


def test_pixel_count_follows_the_area():
    uv, faces = random_atlas()
    share = float(uv_areas(uv, faces).sum())
    assert len(rasterise_uv(uv, faces, faces, 400).pixels) / 400**2 == pytest.approx(share, rel=0.005)


def test_triangles_without_area_and_smaller_than_a_pixel_are_passed_over():
    uv = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0.5, 0.5], [0.51, 0.5], [0.51, 0.51]])
    faces = torch.tensor([[0, 2, 3], [0, 0, 1], [3, 4, 5], [0, 1, 2]])
    grid = rasterise_uv(uv, faces, faces, 10)
    assert grid.samples.face_ids.unique().tolist() == [3]
    with pytest.raises(AvatarError, match="covers pixels of a 10 x 10 image"):
        rasterise_uv(uv, faces[:3], faces[:3], 10)


@pytest.mark.parametrize(
    ("uv", "uv_faces", "size", "message"),
    [
        (SQUARE * 2, HALVES, 8, r"in \[0, 1\], got 0 to 2"),
        (SQUARE - 0.5, HALVES, 8, r"in \[0, 1\], got -0.5"),
        (SQUARE, HALVES, 0, "at least 1 pixel"),
        (SQUARE, HALVES + 2, 8, r"uv_faces: expected indices in \[0, 4\), got 2 to 5"),
        (SQUARE, HALVES[:1], 8, "uv_faces: expected shape"),
        (SQUARE / 0, HALVES, 8, "finite"),
        (None, HALVES, 8, "uv: expected shape"),
    ],
)
def test_bad_atlases_are_refused(uv, uv_faces, size, message):
    with pytest.raises(AvatarError, match=message):
        rasterise_uv(uv, uv_faces, HALVES, size)
    if "finite" in message or "uv_faces" in message:
        with pytest.raises(AvatarError, match=message):
            check_atlas(uv, uv_faces, 2)


def test_barycentric_coordinates_extrapolate():
    generator = torch.Generator().manual_seed(0)
    triangles = torch.rand(20, 3, 2, generator=generator, dtype=torch.float64)
    points = torch.rand(20, 2, generator=generator, dtype=torch.float64) * 4 - 2
    found = uv_barycentric(points, triangles)
    torch.testing.assert_close((found.unsqueeze(-1) * triangles).sum(dim=1), points)
    torch.testing.assert_close(found.sum(dim=1), torch.ones(20, dtype=torch.float64))
    assert found.min() < 0
    assert not uv_barycentric(points[:1], torch.zeros(1, 3, 2).double()).isfinite().any()


def test_painting_a_linear_function_is_exact_inside_and_zero_outside():
    uv, faces = random_atlas()
    grid = rasterise_uv(uv, faces, faces, 32)
    slopes = torch.tensor([[1.0, -2, 0.5], [3.0, 0, 1]], dtype=torch.float64)
    image = paint((uv @ slopes).expand(2, -1, -1), grid)
    v, u = torch.meshgrid(*[(torch.arange(32).double() + 0.5) / 32] * 2, indexing="ij")
    expected = torch.stack([u, v], dim=-1) @ slopes
    inside = torch.zeros(32 * 32, dtype=torch.bool).index_fill(0, grid.pixels, True).view(32, 32)
    assert image.shape == (2, 3, 32, 32)
    torch.testing.assert_close(image[1].permute(1, 2, 0)[inside], expected[inside])
    assert image[:, :, ~inside].abs().max() == 0


def test_painting_is_differentiable():
    grid = rasterise_uv(SQUARE.double(), HALVES, HALVES, 3)
    values = torch.rand(1, 4, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: paint(v, grid), values)


def cut_sphere() -> tuple[trimesh.Trimesh, torch.Tensor, torch.Tensor]:
    """A sphere cut into a front and a back island."""
    sphere = trimesh.creation.icosphere(2)
    faces = torch.from_numpy(np.array(sphere.faces)).long()
    back = torch.from_numpy(sphere.triangles_center[:, 2] < 0)
    return sphere, faces, faces + back[:, None] * len(sphere.vertices)


def test_seams_are_the_edges_between_islands():
    sphere, faces, uv_faces = cut_sphere()
    back = sphere.triangles_center[:, 2] < 0
    expected = {
        tuple(sorted(edge))
        for edge, (a, b) in zip(sphere.face_adjacency_edges.tolist(), sphere.face_adjacency)
        if back[a] != back[b]
    }
    assert {tuple(edge) for edge in seam_edges(faces, uv_faces).tolist()} == expected
    assert len(seam_edges(faces, faces)) == 0
    assert len(seam_edges(HALVES, torch.tensor([[0, 1, 2], [3, 2, 4]]))) == 1  # only one end is moved


def test_a_point_on_a_seam_is_at_two_places():
    """The same surface point seen from the triangles at either side of a cut."""
    sphere, faces, uv_faces = cut_sphere()
    vertices = torch.from_numpy(np.array(sphere.vertices))
    uv = torch.cat([vertices[:, :2] * 0.2 + 0.25, vertices[:, :2] * 0.2 + 0.75])
    ends = seam_edges(faces, uv_faces)[0]
    sides = [face for face, ids in enumerate(faces.tolist()) if set(ends.tolist()) <= set(ids)]
    halves = torch.isin(faces[sides], ends).double() / 2
    samples = type(rasterise_uv(uv, uv_faces, faces, 64).samples)(faces[sides], halves, torch.tensor(sides))
    spots, places = interpolate(vertices, samples), sample_uv(uv, uv_faces, samples)
    torch.testing.assert_close(spots[0], spots[1])
    torch.testing.assert_close((places[0] - places[1]).abs(), torch.tensor([0.5, 0.5]).double())
