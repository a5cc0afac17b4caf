"""Surfaces of any format: STL, heights and units, what a mesh or a cloud can be had of, endings."""

import struct

import numpy as np
import pytest

from avatar.checks import DataError
from avatar.geometry.units import guess_unit, possible_units
from avatar.io.surfaces import READERS, read_surface

SQUARE = [((0, 0, 0), (1, 0, 0), (1, 1, 0)), ((0, 0, 0), (1, 1, 0), (-0.0, 1, 0))]


def binary_stl(triangles, name=b""):
    data = name.ljust(80, b" ") + struct.pack("<I", len(triangles))
    return data + b"".join(struct.pack("<12fH", 0, 0, 0, *sum(corners, ()), 7) for corners in triangles)


def ascii_stl(triangles, solids=1, end="\n", upper=False):
    text = ""
    for part in np.array_split(np.array(triangles), solids):
        text += "solid a body\n"
        for corners in part:
            text += "  facet normal 0 0 0\n    outer loop\n"
            text += "".join(f"      vertex {x:e} {y:e} {z:e}\n" for x, y, z in corners)
            text += "    endloop\n  endfacet\n"
        text += "endsolid a body\n"
    return (text.upper() if upper else text).replace("\n", end).encode()


@pytest.mark.parametrize(
    "data",
    [
        binary_stl(SQUARE),
        binary_stl(SQUARE, b"solid by a program that says so"),
        ascii_stl(SQUARE),
        ascii_stl(SQUARE, solids=2),
        ascii_stl(SQUARE, end="\r\n"),
        ascii_stl(SQUARE, upper=True),
    ],
)
def test_stl_vertices_at_equal_positions_are_one(tmp_path, data):
    (tmp_path / "a.stl").write_bytes(data)
    mesh = read_surface(tmp_path / "a.stl").mesh
    assert mesh.vertices.shape == (4, 3)
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], SQUARE)


@pytest.mark.parametrize(
    "data", [binary_stl(SQUARE)[:-1], binary_stl([]), ascii_stl(SQUARE)[:-60], b"solid x\nendsolid x\n", bytes(100)]
)
def test_damaged_stl_is_refused(tmp_path, data):
    (tmp_path / "a.stl").write_bytes(data)
    with pytest.raises(DataError, match=r"a\.stl: "):
        read_surface(tmp_path / "a.stl")


@pytest.mark.parametrize(
    ("height", "units"),
    [
        (1.7, ("m",)),
        (0.5, ("m",)),
        (2.5, ("m",)),
        (170, ("cm",)),
        (1700, ("mm",)),
        (500, ("mm",)),
        (67, ("in", "cm")),
        (40, ("in",)),
        (95, ("cm", "in")),
        (0.49, ()),
        (2.6, ()),
        (10, ()),
        (300, ()),
        (58_980, ()),
        (0, ()),
        (float("nan"), ()),
    ],
)
def test_units_of_a_persons_height(height, units):
    assert set(possible_units(height)) == set(units)
    assert guess_unit(height) in units or (units == () and guess_unit(height) is None)


def test_inches_of_an_adult_are_likelier_than_centimetres_of_a_child():
    assert guess_unit(67) == "in"


def test_height_is_the_longest_side_of_the_box(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 5\nv 300 0 5\nv 0 200 1705\nf 1 2 3\n")
    surface = read_surface(tmp_path / "a.obj")
    np.testing.assert_array_equal(surface.extents, [300, 200, 1700])
    assert surface.height == 1700 and guess_unit(surface.height) == "mm"


def test_missing_files_and_other_endings_are_refused(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_surface(tmp_path / "a.obj")
    for name in ("a.fbx", "a.ply.gz", "a"):
        with pytest.raises(DataError, match="ending in"):
            read_surface(tmp_path / name)


@pytest.mark.parametrize("suffix", READERS)
def test_noise_is_refused(tmp_path, suffix):
    for seed in range(20):
        (tmp_path / f"a{suffix}").write_bytes(np.random.default_rng(seed).bytes(400))
        with pytest.raises(DataError, match=f"a{suffix}: "):
            read_surface(tmp_path / f"a{suffix}")
