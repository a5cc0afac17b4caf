"""PLY files as other programs write them: all encodings, names of properties, lists, normals, faces of any size."""

import struct

import numpy as np
import pytest

from avatar.checks import DataError
from avatar.io.meshes import read_mesh
from avatar.io.surfaces import read_surface

CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
HALVES = [[0, 1, 2], [0, 2, 3]]
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}


def ply(path, encoding, *elements):
    """Writes elements ``(name, properties, rows)``; a property is ``type name`` or ``list type type name``."""
    header, order = f"ply\nformat {encoding} 1.0\ncomment by hand\n", FORMATS[encoding]
    body = b""
    for name, properties, rows in elements:
        header += f"element {name} {len(rows)}\n" + "".join(f"property {of}\n" for of in properties)
        for row in rows:
            words = []
            for of, value in zip(properties, row, strict=True):
                kinds = of.split()
                if kinds[0] == "list":
                    words += [(kinds[1], len(value)), *((kinds[2], each) for each in value)]
                else:
                    words.append((kinds[0], value))
            if order:
                body += b"".join(struct.pack(order + CODES[kind], each) for kind, each in words)
            else:
                body += " ".join(str(each) for _, each in words).encode() + b"\n"
    path.write_bytes(header.encode() + b"end_header\n" + body)
    return path


def xyz(kind="float"):
    return [f"{kind} {name}" for name in "xyz"]


FACE = ["list uchar int vertex_indices"]


@pytest.mark.parametrize("encoding", FORMATS)
class TestEncodings:
    @pytest.mark.parametrize("name", ["vertex_indices", "vertex_index"])
    @pytest.mark.parametrize(("length", "index"), [("uchar", "int"), ("int", "uint"), ("ushort", "ushort")])
    def test_triangles_and_quads_in_the_files_order(self, tmp_path, encoding, name, length, index):
        faces = [[(0, 1, 2, 3)], [(0, 1, 2)], [(1, 2, 3, 0)]]
        path = ply(
            tmp_path / "a.ply",
            encoding,
            ("vertex", xyz("double"), CORNERS),
            ("face", [f"list {length} {index} {name}"], faces),
        )
        mesh = read_mesh(path)
        np.testing.assert_array_equal(mesh.vertices, CORNERS)
        np.testing.assert_array_equal(mesh.faces, [*HALVES, [0, 1, 2], [1, 2, 3], [1, 3, 0]])
        assert mesh.vertices.dtype == np.float32 and mesh.faces.dtype == np.int64

    def test_elements_and_lists_around_vertices_and_faces(self, tmp_path, encoding):
        path = ply(
            tmp_path / "a.ply",
            encoding,
            ("camera", ["list uchar float view", "int id"], [[(1, 2), 5], [(1, 2, 3), 6]]),
            (
                "vertex",
                ["list uchar short seen", *xyz(), "uchar flag"],
                [[(1,) * i, *at, 9] for i, at in enumerate(CORNERS)],
            ),
            ("empty", ["int nothing"], []),
            (
                "face",
                ["uchar red", "list uchar float texcoord", "list uchar int vertex_indices", "int flags"],
                [[9, (0, 0, 1, 0, 1, 1), (0, 1, 2), 7], [9, (), (0, 2, 3), 8]],
            ),
            ("edge", ["int vertex1", "int vertex2"], [[0, 1]]),
        )
        surface = read_surface(path)
        np.testing.assert_array_equal(surface.vertices, CORNERS)
        np.testing.assert_array_equal(surface.faces, HALVES)

    @pytest.mark.parametrize("prefix", ["", "diffuse_"])
    @pytest.mark.parametrize(("kind", "highest"), [("uchar", 255), ("float", 1), ("ushort", 65535)])
    def test_colours_by_either_name(self, tmp_path, encoding, prefix, kind, highest):
        color = [round(share * highest) if highest > 1 else share for share in (1, 0, 0.2)]
        names = [f"{kind} {prefix}{name}" for name in ("red", "green", "blue", "alpha")]
        rows = [[*color, highest, *at] for at in CORNERS]  # before the position, with alpha
        path = ply(tmp_path / "a.ply", encoding, ("vertex", names + xyz(), rows), ("face", FACE, [[(0, 1, 2)]]))
        surface = read_surface(path)
        np.testing.assert_allclose(surface.colors, [[1, 0, 0.2]] * 4, atol=1e-6)
        np.testing.assert_array_equal(surface.vertices, CORNERS)

    def test_dark_bytes_are_no_unit_floats(self, tmp_path, encoding):
        names = [*xyz(), "uchar red", "uchar green", "uchar blue"]
        path = ply(tmp_path / "a.ply", encoding, ("vertex", names, [[*at, 1, 0, 0] for at in CORNERS]))
        np.testing.assert_allclose(read_surface(path).colors, [[1 / 255, 0, 0]] * 4)

    @pytest.mark.parametrize("names", ["nx ny nz", "normal_x normal_y normal_z"])
    def test_normals_by_either_name_are_normalised(self, tmp_path, encoding, names):
        properties = [*xyz(), *(f"float {name}" for name in names.split())]
        path = ply(tmp_path / "a.ply", encoding, ("vertex", properties, [[*at, 0, 0, 3] for at in CORNERS]))
        surface = read_surface(path)
        np.testing.assert_array_equal(surface.cloud.normals, [[0, 0, 1]] * 4)
        assert surface.notes == ("Normals had lengths from 3 to 3 and were normalised.",)

    def test_strips(self, tmp_path, encoding):
        strips = ("tristrips", ["list int int vertex_indices"], [[(0, 1, 3, 2, -1, 3, 1, 0)]])
        path = ply(tmp_path / "a.ply", encoding, ("vertex", xyz(), CORNERS), strips)
        np.testing.assert_array_equal(read_mesh(path).faces, [[0, 1, 3], [3, 1, 2], [3, 1, 0]])

    def test_faces_without_indices_are_no_points(self, tmp_path, encoding):
        faces = ("face", ["uchar red", "list uchar float texcoord"], [[1, (0, 1)]])
        path = ply(tmp_path / "a.ply", encoding, ("void", [], []), ("vertex", xyz(), CORNERS), faces)
        with pytest.raises(DataError, match="expected faces with vertex_indices, got red, texcoord"):
            read_surface(path)
        path.write_bytes(path.read_bytes().replace(b"element void 0", b"element void 9"))
        with pytest.raises(DataError, match="expected faces with vertex_indices"):
            read_surface(path)

    def test_cut_files_are_refused(self, tmp_path, encoding):
        path = ply(
            tmp_path / "a.ply", encoding, ("vertex", xyz(), CORNERS), ("face", FACE, [[(0, 1, 2, 3)], [(0, 1, 2)]])
        )
        whole, header = path.read_bytes(), path.read_bytes().index(b"end_header\n") + 11
        for end in range(header, len(whole) - 2):
            path.write_bytes(whole[:end])
            with pytest.raises(DataError, match="cut short"):
                read_surface(path)


def normals_of(tmp_path, normals, faces):
    names = [*xyz(), "float nx", "float ny", "float nz"]
    rows = [[*at, *normal] for at, normal in zip(CORNERS, normals)]
    elements = [("face", FACE, [[face] for face in faces])] if faces else []
    return read_surface(ply(tmp_path / "a.ply", "ascii", ("vertex", names, rows), *elements))


def test_zero_normals_of_a_mesh_are_recomputed_from_its_faces(tmp_path):
    surface = normals_of(tmp_path, [(0, 0, 0), (0, 1, 0), ("nan", 0, 0), (0, 0, 1)], [(0, 1, 2), (0, 2, 3)])
    np.testing.assert_allclose(surface.normals, [[0, 0, 1], [0, 1, 0], [0, 0, 1], [0, 0, 1]])
    assert surface.notes == ("2 of 4 normals had no direction: recomputed from the faces.",)


def test_zero_normals_without_a_face_leave_all_out_and_say_so(tmp_path):
    unused = normals_of(tmp_path, [(0, 0, 1), (0, 0, 1), (0, 0, 1), (0, 0, 0)], [(0, 1, 2)])
    assert unused.normals is None and unused.notes == ("1 of 4 normals have no direction: the normals are left out.",)
    cloud = normals_of(tmp_path, [(0, 0, 1), (0, 0, 0), (0, 0, 0), (0, 0, 1)], [])
    with pytest.raises(
        DataError, match=r"expected unit normals, got 4 points without\. 2 of 4 normals .*Hint: estimate"
    ):
        _ = cloud.cloud


def test_points_where_a_mesh_is_needed_say_so(tmp_path):
    path = ply(tmp_path / "a.ply", "binary_little_endian", ("vertex", xyz(), CORNERS), ("face", FACE, []))
    with pytest.raises(DataError, match=r"expected triangles, got a point cloud of 4 points\. Hint: reconstruct"):
        read_mesh(path)
    assert read_surface(path).faces is None


def test_ascii_rows_may_be_broken_anywhere_and_windows_lines_are_read(tmp_path):
    path = ply(tmp_path / "a.ply", "ascii", ("vertex", xyz(), CORNERS), ("face", FACE, [[(0, 1, 2, 3)]]))
    data = path.read_bytes()
    head, body = data.split(b"end_header\n")
    path.write_bytes(head + b"end_header\n" + b"\n".join(body.split()))
    np.testing.assert_array_equal(read_mesh(path).faces, HALVES)
    path.write_bytes(data.replace(b"\n", b"\r\n"))
    np.testing.assert_array_equal(read_mesh(path).faces, HALVES)


def test_a_texture_is_left_out_with_a_note(tmp_path):
    path = ply(tmp_path / "a.ply", "ascii", ("vertex", xyz(), CORNERS), ("face", FACE, [[(0, 1, 2, 3)]]))
    path.write_bytes(path.read_bytes().replace(b"comment by hand", b"comment TextureFile skin.png"))
    assert read_surface(path).notes == ("Its texture is not read: no colours.",)


HEADER = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
POINTS = "0 0 0\n1 0 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("solid nothing", "cannot be read as PLY"),
        (HEADER.replace("ascii", "utf9") + "end_header\n" + POINTS, "expected a PLY header|known format"),
        (
            HEADER.replace("vertex 3", "vertex 4000000000") + "end_header\n" + POINTS,
            "promises 4000000000 rows of vertex",
        ),
        (HEADER + "element face 3000000000\nproperty list uchar int vertex_indices\nend_header\n" + POINTS, "promises"),
        (HEADER + "element nothing 3000000000\nend_header\n" + POINTS, "promises 3000000000 rows of nothing"),
        (HEADER.replace("float z", "float q") + "end_header\n" + POINTS, "with x, y and z"),
        (HEADER.replace("float z", "float x") + "end_header\n" + POINTS, "every property of vertex once"),
        (HEADER + "element vertex 1\nend_header\n" + POINTS, "every element once"),
        (HEADER + "property list float int q\nend_header\n" + POINTS, "expected a PLY header, got the line"),
        (HEADER + "end_header\n0 0 0\nx 0 0\n0 1 0\n", "a value is no number"),
        (HEADER + "end_header\n0 0 0\nnan 0 0\n0 1 0\n", "holds no valid points.*1 NaN"),
        (HEADER.replace("vertex 3", "vertex 0") + "end_header\n", "got no vertices"),
        (HEADER + "element face 1\n" + f"property {FACE[0]}\nend_header\n{POINTS}3 0 1 2.5\n", "not whole"),
        (HEADER + "element face 1\n" + f"property {FACE[0]}\nend_header\n{POINTS}-3 0 1 2\n", "length of a list"),
        (HEADER + "element face 1\n" + f"property {FACE[0]}\nend_header\n{POINTS}3 0 1 nan\n", "not whole"),
        (HEADER + "element face 1\n" + f"property {FACE[0]}\nend_header\n{POINTS}3 0 1 -1\n", r"indices in \[0, 3\)"),
    ],
)
def test_bad_files_are_named_with_their_reason(tmp_path, text, reason):
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(DataError, match=reason) as caught:
        read_surface(tmp_path / "a.ply")
    assert str(tmp_path / "a.ply") in str(caught.value)
