"""PCD files as the Point Cloud Library writes them: encodings, packed colours, missing measurements."""

import struct

import numpy as np
import pytest

from avatar.checks import DataError
from avatar.io import pcd
from avatar.io.surfaces import read_surface

POINTS = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 2.0, 0.0)]
NORMAL = (0.0, 0.0, 1.0)
RED = 0x00FF0033  # red 255, green 0, blue 51


def header(fields, sizes, types, count=3, kind="ascii", more=""):
    names = fields.split()
    counts = " ".join(["1"] * len(names))
    text = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nWIDTH {count}\n"
    return (text + f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n{more}POINTS {count}\nDATA {kind}\n").encode()


ORIENTED = ("x y z normal_x normal_y normal_z rgb", "4 4 4 4 4 4 4")


def as_float(bits):
    return struct.unpack("<f", struct.pack("<I", bits))[0]


def oriented(kind, code="F"):
    head = header(*ORIENTED, f"F F F F F F {code}", kind=kind)
    color = as_float(RED) if code == "F" else RED
    if kind == "ascii":
        return head + "".join(f"{x} {y} {z} 0 0 1 {color!r}\n" for x, y, z in POINTS).encode()
    rows = [(*point, *NORMAL, color) for point in POINTS]
    if kind == "binary":
        return head + b"".join(struct.pack(f"<6f{'f' if code == 'F' else 'I'}", *row) for row in rows)
    columns = b"".join(struct.pack(f"<3{'f' if i < 6 or code == 'F' else 'I'}", *of) for i, of in enumerate(zip(*rows)))
    literals = b"".join(bytes([len(columns[i : i + 32]) - 1]) + columns[i : i + 32] for i in range(0, len(columns), 32))
    return head + struct.pack("<II", len(literals), len(columns)) + literals


def read(tmp_path, data):
    (tmp_path / "a.pcd").write_bytes(data)
    return read_surface(tmp_path / "a.pcd")


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("code", ["F", "U"])
def test_oriented_coloured_points_in_every_encoding(tmp_path, kind, code):
    cloud = read(tmp_path, oriented(kind, code)).cloud
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.normals, [NORMAL] * 3)
    np.testing.assert_allclose(cloud.colors, [[1, 0, 0.2]] * 3, atol=1e-7)


def test_rgba_doubles_padding_and_windows_lines(tmp_path):
    head = header("x y z _ rgba _", "8 8 8 1 4 1", "F F F U U U", kind="binary").replace(b"1 1 1 1 1 1", b"1 1 1 4 1 8")
    data = b"".join(struct.pack("<3d4xI8x", *point, 0x80FF0033) for point in POINTS)
    surface = read(tmp_path, head.replace(b"\n", b"\r\n") + data)
    np.testing.assert_array_equal(surface.vertices, POINTS)
    np.testing.assert_allclose(surface.colors, [[1, 0, 0.2]] * 3, atol=1e-7)
    with pytest.raises(DataError, match=r"expected unit normals, got 3 points without\. Hint: estimate"):
        _ = surface.cloud


def test_copies_in_a_compressed_stream_may_overlap_themselves():
    path = "a.pcd"
    assert pcd._unpack_lzf(path, b"\x01ab" + bytes([(2 << 5), 1]), 6) == b"ababab"
    assert pcd._unpack_lzf(path, b"\x00a" + bytes([(7 << 5), 3, 0]), 13) == b"a" * 13
    assert pcd._unpack_lzf(path, b"\x03abcd" + bytes([(1 << 5), 3]), 7) == b"abcdabc"
    for damaged in (b"\x05a", bytes([1 << 5, 0]), b"\x00a" + bytes([(7 << 5)]), b"\x00a"):
        with pytest.raises(DataError, match="damaged"):
            pcd._unpack_lzf(path, damaged, 9)


def test_points_without_a_measurement_are_left_out_with_their_number(tmp_path):
    rows = "nan nan nan 0 0 1 0\n0 0 0 0 0 1 0\nNaN NaN NaN 0 0 1 0\n"
    surface = read(tmp_path, header(*ORIENTED, "F F F F F F F") + rows.encode())
    np.testing.assert_array_equal(surface.cloud.points, [[0, 0, 0]])
    assert surface.notes == ("2 of 3 points without a measurement (NaN) are left out.",)
    with pytest.raises(DataError, match="holds no valid points"):
        read(tmp_path, header("x y z", "4 4 4", "F F F") + b"0 0 nan\n0 0 0\n1 1 1\n")


def test_a_viewpoint_is_noted(tmp_path):
    data = oriented("binary").replace(b"VIEWPOINT 0 0 0", b"VIEWPOINT 1 0 0")
    assert read(tmp_path, data).notes == ("Its VIEWPOINT is not applied: points stay in the file's own frame.",)


def test_large_compressed_files_are_refused_with_the_command_that_unpacks_them(tmp_path, monkeypatch):
    monkeypatch.setattr(pcd, "COMPRESSED_BYTES", 50)
    with pytest.raises(DataError, match=r"got 84\. Hint: pcl_convert_pcd_ascii_binary in\.pcd out\.pcd 1"):
        read(tmp_path, oriented("binary_compressed"))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"nothing\n", "cannot be read as PCD"),
        (header("x y z", "4 4 4", "F F F", 4_000_000_000, "binary"), "promises 4000000000 points"),
        (header("x y z", "4 4 4", "F F F", 4_000_000_000), "promises 4000000000 points"),
        (header("x y z", "4 4 4", "F F F", 4_000_000_000, "binary_compressed"), "promises 4000000000 points"),
        (header("x y z", "4 4", "F F F"), "cannot be read as PCD"),
        (header("x y z", "4 4 3", "F F F"), "cannot be read as PCD"),
        (header("x y q", "4 4 4", "F F F") + b"0 0 0\n" * 3, "expected the fields x y z"),
        (header("x y z", "4 4 4", "F F F") + b"0 0 0\n0 x 0\n0 0 0", "got 1: cut short, or a value is no number"),
        (header("x y z", "4 4 4", "F F F", kind="binary") + bytes(35), "got 2: cut short"),
        (header("x y z", "4 4 4", "F F F", kind="zipped") + bytes(36), "DATA ascii, binary or binary_compressed"),
        (header("x y z", "4 4 4", "F F F", kind="binary_compressed") + struct.pack("<II", 9, 36), "a cut end"),
        (header("x y z", "4 4 4", "F F F", 0), "got no vertices"),
    ],
)
def test_bad_files_are_named_with_their_reason(tmp_path, data, reason):
    with pytest.raises(DataError, match=reason) as caught:
        read(tmp_path, data)
    assert str(tmp_path / "a.pcd") in str(caught.value)
