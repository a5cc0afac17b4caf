"""OBJ files as other programs write them: polygons, colours, line ends, comments, normals and texture coordinates."""

import numpy as np
import pytest

from avatar.checks import DataError
from avatar.io.meshes import read_mesh
from avatar.io.surfaces import read_surface

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALVES = [[0, 1, 2], [0, 2, 3]]


def read(tmp_path, content):
    path = tmp_path / "a.obj"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_surface(path)


@pytest.mark.parametrize(
    ("faces", "expected"),
    [
        ("f 1 2 3 4\n", HALVES),
        ("f -4 -3 -2 -1\n", HALVES),
        ("f 1 2 3\nf 1 2 3 4\nf 2 3 4\n", [[0, 1, 2], *HALVES, [1, 2, 3]]),
        ("f 1/1/1 2/2/1 3/3/1 4/4/1\n", HALVES),
        ("f 1//1 2//1 3//1 4//1\n", HALVES),
        ("f 1/1 2/2 3/3 4/4\n", HALVES),
        ("f 1 2 3 # a triangle\nf 1 3 4#another\n", HALVES),
        ("f 1 2 \\\n3 4\n", HALVES),
        ("f\t1\t2\t3\t4\n", HALVES),
        ("  f 1 2 3 4", HALVES),
        ("s off\ng one two\nl 1 2\np 1\nf 1 2 3 4\nusemap x\n", HALVES),
        ("v 5 5 5\nf 1 2 3 4 5\n", [[0, 1, 2], [0, 2, 3], [0, 3, 4]]),
    ],
)
def test_polygons_are_fans_in_the_files_order(tmp_path, faces, expected):
    surface = read(tmp_path, SQUARE + faces)
    np.testing.assert_array_equal(surface.faces, expected)
    np.testing.assert_array_equal(surface.vertices[:4], CORNERS)
    assert surface.notes == ()


def test_negative_indices_count_from_the_vertices_so_far(tmp_path):
    surface = read(tmp_path, "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nf -4 -2 -1\n")
    np.testing.assert_array_equal(surface.faces, HALVES)


@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_line_ends_of_other_systems(tmp_path, end):
    text = (SQUARE + "f 1 2 \\\n3 4\n").replace("\n", end)
    np.testing.assert_array_equal(read(tmp_path, text).faces, HALVES)


def test_a_byte_order_mark_hides_no_vertex_and_latin_names_are_read(tmp_path):
    assert read(tmp_path, b"\xef\xbb\xbf" + SQUARE.encode() + b"f 1 2 3\n").vertices.shape == (4, 3)
    assert read(tmp_path, b"# caf\xe9\n" + SQUARE.encode() + b"g t\xeate\nf 1 2 3 4\n").faces.shape == (2, 3)
    with pytest.raises(DataError, match=r"expected OBJ in UTF-8, got UTF-16\. Hint: save it"):
        read(tmp_path, (SQUARE + "f 1 2 3\n").encode("utf-16"))


def test_materials_and_groups_split_no_vertices_and_are_not_opened(tmp_path):
    text = "mtllib missing.mtl\nmtllib /etc/passwd\n" + SQUARE
    text += "usemtl skin\ng left\nf 1 2 3\nusemtl cloth\no right\nf 1 3 4\nusemtl skin\nf 2 3 4\n"
    surface = read(tmp_path, text)
    assert surface.vertices.shape == (4, 3)
    np.testing.assert_array_equal(surface.faces, [*HALVES, [1, 2, 3]])


def test_texture_coordinates_and_normals_of_corners_split_no_vertices(tmp_path):
    text = "mtllib a.mtl\nusemtl skin\n" + SQUARE + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt .5 .5\nvn 0 0 1\nvn 0 1 0\n"
    surface = read(tmp_path, text + "f 1/1/1 2/2/1 3/3/1\nf 1/5/2 3/4/2 4/4/2\n")
    np.testing.assert_array_equal(surface.vertices, CORNERS)
    np.testing.assert_array_equal(surface.faces, HALVES)
    assert surface.colors is None and surface.normals is None
    assert surface.notes == ("Materials and textures are not read: no colours.",)


@pytest.mark.parametrize(("scale", "notes"), [(1, ()), (255, ("Colours are taken to go from 0 to 255.",))])
@pytest.mark.parametrize("alpha", ["", " 1"])
def test_colours_after_the_position(tmp_path, scale, notes, alpha):
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 0.2]])
    rows = zip(CORNERS[:3].tolist(), (colors * scale).tolist())
    lines = [f"v {' '.join(map(str, position))} {' '.join(map(str, color))}{alpha}" for position, color in rows]
    surface = read(tmp_path, "\n".join(lines) + "\nf 1 2 3\n")
    np.testing.assert_allclose(surface.colors, colors, atol=1e-7)
    np.testing.assert_array_equal(surface.vertices, CORNERS[:3])
    assert surface.notes == notes


def test_colours_of_some_vertices_are_left_out_with_their_number(tmp_path):
    surface = read(tmp_path, "v 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert surface.colors is None and surface.notes == ("Colours are left out: 1 of 3 vertices have them.",)
    assert read(tmp_path, "v 0 0 0 1\nv 1 0 0 1\nv 0 1 0 1\nf 1 2 3\n").colors is None  # w, not a colour


def test_faces_of_fewer_than_three_corners_are_left_out_with_their_number(tmp_path):
    surface = read(tmp_path, SQUARE + "f\nf 1 2\nf 1 2 3\n")
    np.testing.assert_array_equal(surface.faces, [[0, 1, 2]])
    assert surface.notes == ("2 faces of fewer than 3 corners are left out.",)


def test_points_with_normals_are_a_cloud(tmp_path):
    surface = read(tmp_path, "vn 0 0 1\nv 0 0 0\nvn 0 0 2\nv 1 0 0\n")
    np.testing.assert_array_equal(surface.cloud.normals, [[0, 0, 1], [0, 0, 1]])
    with pytest.raises(DataError, match=r"expected triangles, got a point cloud of 2 points\. Hint: "):
        read_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (SQUARE + "f 1 2 9\n", r"expected vertex indices in \[0, 4\), got 0 to 8"),
        (SQUARE + "f 0 1 2\n", "corner 0 points to vertex 0 of 4"),
        (SQUARE + "f -5 1 2\n", "corner -5 points to vertex -5 of 4"),
        (SQUARE + "f 1 2 x\n", "line b'f 1 2 x' cannot be read"),
        ("v 0 0\nv 1 0\n", "expected x, y and z"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "got 1 NaN or infinite"),
        ("v 0 0 1e400\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "got 1 NaN or infinite"),
        ("v 0 0 0 300 0 0\nv 1 0 0 0 0 0\nv 0 1 0 0 0 0\nf 1 2 3\n", "colours from 0 to 1 or to 255, got 0 to 300"),
        ("g nothing\n", "expected triangles or points, got no vertices"),
        (SQUARE + "f 1 1 1\n", "triangles with area"),
    ],
)
def test_bad_files_are_named_with_their_reason(tmp_path, text, reason):
    with pytest.raises(DataError, match=reason) as caught:
        read(tmp_path, text)
    assert str(tmp_path / "a.obj") in str(caught.value)
