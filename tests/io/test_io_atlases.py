"""UV atlases from OBJ files: matched by vertices whatever the order, and refused where they are not the mesh's."""

import numpy as np
import pytest

from avatar.checks import DataError
from avatar.io.meshes import read_mesh, read_obj_atlas

# Two squares beside each other, folded at the edge 1-4; the right one's island lies apart in the atlas.
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 1], [0, 1, 0], [1, 1, 0], [2, 1, 1]], float)
FACES = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
PLACES = np.array([[0, 0], [0.4, 0], [0.4, 1], [0, 1], [0.6, 0], [1, 0], [1, 1], [0.6, 1]])
ISLANDS = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
QUADS = ["f 1/1 2/2 5/3 4/4", "f 2/5 3/6 6/7 5/8"]
TRIANGLES = [f"f {' '.join(f'{v + 1}/{p + 1}' for v, p in zip(*pair))}" for pair in zip(FACES, ISLANDS)]


def write_obj(path, polygons, vertices=VERTICES, places=PLACES):
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"vt {u} {v}" for u, v in places]
    path.write_text("\n".join(["# a comment", *lines, "g body", *polygons]) + "\n")
    return path


@pytest.mark.parametrize(
    "polygons",
    [
        TRIANGLES,
        TRIANGLES[::-1],
        ["f 5/3 1/1 2/2", *TRIANGLES[1:]],  # a triangle that begins elsewhere
        QUADS,
        ["f 1/1/1 2/2/1 5/3/1 4/4/1", "f 2/5/9 3/6/9 \\", "6/7/9 5/8/9"],  # normals are not looked at
        ["f -6/-8 -5/-7 -2/-6 -3/-5", "f -5/-4 -4/-3 -1/-2 -2/-1"],
    ],
    ids=["same", "reversed", "turned", "quads", "normals and a broken line", "from the end"],
)
def test_every_triangle_has_the_places_of_its_own_polygon(tmp_path, polygons):
    atlas = read_obj_atlas(write_obj(tmp_path / "body.obj", polygons), FACES, 6)
    np.testing.assert_allclose(atlas.uv[atlas.uv_faces], PLACES[ISLANDS], atol=1e-7)
    assert (atlas.uv.dtype, atlas.uv_faces.dtype) == (np.float32, np.int64)


def test_without_texture_coordinates_there_is_no_atlas(tmp_path):
    assert read_obj_atlas(write_obj(tmp_path / "body.obj", ["f 1 2 5 4", "f 2 3 6 5"], places=[]), FACES, 6) is None


def test_coordinates_a_rounding_error_out_are_taken_as_the_border(tmp_path):
    atlas = read_obj_atlas(write_obj(tmp_path / "body.obj", QUADS, places=PLACES * 1.000002), FACES, 6)
    assert atlas.uv.max() == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vertices": VERTICES[:5], "polygons": TRIANGLES[:2]}, "expected the body's 6 vertices, got 5"),
        (
            {"polygons": TRIANGLES[:3]},
            r"1 of the body's 4 triangles have no .* first is 3 \(vertices 1, 5, 4\).*Unwrap",
        ),
        ({"polygons": ["f 1 2 5 4", *QUADS[1:]]}, "2 of the body's 4 triangles"),
        ({"polygons": QUADS, "places": PLACES + [1.0, 0.0]}, r"in \[0, 1\], got 0 to 2.*one tile"),
        ({"polygons": QUADS, "places": PLACES * np.nan}, r"in \[0, 1\]"),
        ({"polygons": ["f 1/1 2/2 3/99"]}, "points to number 99 of 8"),
        ({"polygons": ["f 0/1 2/2 3/3"]}, "has no vertex"),
        ({"polygons": ["f 1/a 2/2 3/3"]}, "cannot be read as OBJ"),
        ({"polygons": ["f 1/1 2/2 3/3 4/4 5/5"]}, "polygon of 5 corners"),
    ],
)
def test_what_is_not_the_meshs_atlas_is_refused(tmp_path, options, message):
    path = write_obj(tmp_path / "body.obj", **options)
    with pytest.raises(DataError, match=rf"body\.obj.*{message}"):
        read_obj_atlas(path, FACES, 6)


def test_a_missing_file_and_one_that_is_no_text_are_named(tmp_path):
    with pytest.raises(DataError, match=r"none\.obj: there is no such file"):
        read_obj_atlas(tmp_path / "none.obj", FACES, 6)
    (tmp_path / "body.obj").write_bytes(b"\x93NUMPY\xff\xfe")
    with pytest.raises(DataError, match="cannot be read as OBJ"):
        read_obj_atlas(tmp_path / "body.obj", FACES, 6)


def test_the_mesh_reader_keeps_the_vertices_of_an_unwrapped_mesh(tmp_path):
    mesh = read_mesh(write_obj(tmp_path / "body.obj", TRIANGLES))
    np.testing.assert_allclose(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)
