"""Meshes on disk: round trips in every format, bad files, and mutated files."""

import json
import struct

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError, DataError
from avatar.io.meshes import FORMATS, check_mesh, read_mesh, write_mesh
from avatar.records import Mesh


def sphere(colored=False, subdivisions=2):
    solid = trimesh.creation.icosphere(subdivisions)
    colors = np.random.default_rng(0).random((len(solid.vertices), 3)) if colored else None
    return Mesh(np.array(solid.vertices) * 0.9, np.array(solid.faces), colors)


@pytest.mark.parametrize("suffix", FORMATS)
def test_round_trip_keeps_the_triangles(tmp_path, suffix):
    mesh = sphere()
    write_mesh(tmp_path / f"walk.0001{suffix}", mesh)
    back = read_mesh(tmp_path / f"walk.0001{suffix}")
    assert back.vertices.shape == mesh.vertices.shape and back.faces.shape == mesh.faces.shape
    np.testing.assert_allclose(back.vertices[back.faces], mesh.vertices[mesh.faces], atol=1e-6)
    assert back.vertices.dtype == np.float32 and back.faces.dtype == np.int64
    if suffix != ".stl":
        np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-6)
        np.testing.assert_array_equal(back.faces, mesh.faces)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_colors_are_kept(tmp_path, suffix):
    mesh = sphere(colored=True)
    write_mesh(tmp_path / f"a{suffix}", mesh)
    np.testing.assert_allclose(read_mesh(tmp_path / f"a{suffix}").colors, mesh.colors, atol=0.5001 / 255)
    write_mesh(tmp_path / f"b{suffix}", sphere())
    assert read_mesh(tmp_path / f"b{suffix}").colors is None


@pytest.mark.parametrize("suffix", FORMATS)
def test_equal_meshes_give_equal_bytes(tmp_path, suffix):
    for name in "ab":
        write_mesh(tmp_path / f"{name}{suffix}", sphere())
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_vertices_keep_their_order_even_where_unused_or_doubled(tmp_path):
    vertices = np.array([[9, 9, 9], [0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 0, 1.0]])
    mesh = Mesh(vertices, np.array([[3, 1, 2], [4, 6, 5]]))
    for suffix in (".ply", ".obj", ".glb", ".off"):
        write_mesh(tmp_path / f"a{suffix}", mesh)
        back = read_mesh(tmp_path / f"a{suffix}")
        np.testing.assert_array_equal(back.vertices, vertices)
        np.testing.assert_array_equal(back.faces, mesh.faces)


def test_obj_with_quads_normals_and_materials_opens_nothing_else(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(
        "mtllib /etc/passwd\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nusemtl skin\nf 1//1 2//1 3//1 4//1\n"
    )
    mesh = read_mesh(path)
    assert mesh.vertices.shape == (4, 3) and mesh.faces.shape == (2, 3)


def ascii_ply(vertices, faces, count=None):
    header = f"ply\nformat ascii 1.0\nelement vertex {len(vertices) if count is None else count}\n"
    header += "property float x\nproperty float y\nproperty float z\n"
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    lines = [" ".join(map(str, row)) for row in vertices] + [f"3 {' '.join(map(str, row))}" for row in faces]
    return (header + "\n".join(lines) + "\n").encode()


def giant_glb():
    document = {
        "asset": {"version": "2.0"},
        "accessors": [{"componentType": 5126, "type": "VEC3", "count": 4_000_000_000}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<III", 2, 20 + len(text), len(text)) + b"JSON" + text


CORNERS = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
BAD_FILES = {
    ("empty.ply", "bytes, got 0"): b"",
    ("noise.glb", "cannot be read"): b"glTFnoise and more noise" * 3,
    ("points.ply", "expected triangles"): ascii_ply(CORNERS, []),
    ("range.ply", "indices in"): ascii_ply(CORNERS, [[0, 1, 3]]),
    ("negative.ply", "indices in"): ascii_ply(CORNERS, [[0, 1, -1]]),
    ("nan.ply", "NaN"): ascii_ply([[0, 0, "nan"], *CORNERS[1:]], [[0, 1, 2]]),
    ("infinite.ply", "NaN or infinite"): ascii_ply([[0, 0, 1e300], *CORNERS[1:]], [[0, 1, 2]]),
    ("flat.ply", "with area"): ascii_ply([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2], [1, 1, 1]]),
    ("giant.ply", "promises 4000000000"): ascii_ply(CORNERS, [[0, 1, 2]], 4_000_000_000),
    ("giant.off", "promises 4000000000"): b"OFF\n4000000000 1 0\n0 0 0\n",
    ("giant.glb", "promises 4000000000"): giant_glb(),
    ("text.obj", "expected triangles|cannot be read"): b"nothing here\n",
}


@pytest.mark.parametrize(("name", "reason"), BAD_FILES)
def test_bad_files_are_named_with_their_reason(tmp_path, name, reason):
    (tmp_path / name).write_bytes(BAD_FILES[name, reason])
    with pytest.raises(DataError, match=reason) as caught:
        read_mesh(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


def test_a_missing_file_and_other_suffixes_are_refused(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_mesh(tmp_path / "a.ply")
    for name in ("a.zip", "a.ply.gz", "a.dae", "a"):
        with pytest.raises(DataError, match="ending in"):
            read_mesh(tmp_path / name)
        with pytest.raises(DataError, match="ending in"):
            write_mesh(tmp_path / name, sphere())


def test_writing_refuses_unsound_meshes(tmp_path):
    good = sphere()
    shifted = Mesh(good.vertices, good.faces + 1)
    beyond_float32 = Mesh(good.vertices * 1e300, good.faces)
    for bad in (shifted, beyond_float32, Mesh(good.vertices, good.faces[:0]), Mesh(good.vertices, good.faces * 0.5)):
        with pytest.raises(AvatarError):
            write_mesh(tmp_path / "a.ply", bad)
    assert not list(tmp_path.iterdir())


def mutate(data, generator):
    """Bytes flipped, a piece cut out or doubled, or the end cut off."""
    data = bytearray(data)
    kind = generator.integers(0, 4)
    if kind < 2:
        reach = 400 if kind == 0 else len(data)  # headers deserve half of the blows
        for place in generator.integers(0, min(reach, len(data)), generator.integers(1, 9)):
            data[place] = generator.integers(0, 256)
    else:
        start, length = generator.integers(0, len(data)), generator.integers(1, 64)
        piece = data[start : start + length]
        data[start : start + length] = piece * 2 if kind == 2 else b""
    return bytes(data)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".off", ".stl"])
def test_mutated_files_are_sound_or_refused(tmp_path, suffix):
    write_mesh(tmp_path / f"a{suffix}", sphere(colored=True, subdivisions=1))
    original = (tmp_path / f"a{suffix}").read_bytes()
    generator = np.random.default_rng(0)
    refused = 0
    for _ in range(60):
        (tmp_path / f"b{suffix}").write_bytes(mutate(original, generator))
        try:
            mesh = read_mesh(tmp_path / f"b{suffix}")
        except DataError:
            refused += 1
            continue
        assert np.isfinite(mesh.vertices).all() and mesh.faces.min() >= 0
        assert mesh.faces.max() < len(mesh.vertices)
        check_mesh(mesh)
    assert refused > 5
