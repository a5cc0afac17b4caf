"""Point clouds on disk: exact round trips, foreign files, and every kind of bad file."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError, DataError
from avatar.io.points import read_points, write_points
from avatar.records import PointCloud


def random_cloud(count=500, seed=0):
    generator = np.random.default_rng(seed)
    normals = generator.normal(size=(count, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    return PointCloud(generator.normal(size=(count, 3)).astype(np.float32), normals)


def write_text(path, rows, columns="x y z nx ny nz", count=None, extra=""):
    properties = "\n".join(f"property float {name}" for name in columns.split())
    header = f"ply\nformat ascii 1.0\nelement vertex {len(rows) if count is None else count}\n{properties}\n{extra}"
    path.write_text(header + "end_header\n" + "\n".join(" ".join(map(str, row)) for row in rows) + "\n")
    return path


def test_round_trip_is_exact(tmp_path):
    cloud = random_cloud()
    write_points(tmp_path / "a.b.0001.ply", cloud)
    back = read_points(tmp_path / "a.b.0001.ply")
    np.testing.assert_array_equal(back.points, cloud.points)
    np.testing.assert_array_equal(back.normals, cloud.normals)
    assert [path.name for path in tmp_path.iterdir()] == ["a.b.0001.ply"]


def test_equal_clouds_give_equal_bytes(tmp_path):
    for name in ("a.ply", "b.ply"):
        write_points(tmp_path / name, random_cloud())
    first, second = (hashlib.sha256((tmp_path / n).read_bytes()).digest() for n in ("a.ply", "b.ply"))
    assert first == second


def test_a_second_library_reads_the_same(tmp_path):
    cloud = random_cloud()
    write_points(tmp_path / "a.ply", cloud)
    loaded = trimesh.load(tmp_path / "a.ply", process=False)
    rows = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(loaded.vertices, cloud.points)
    np.testing.assert_array_equal(
        np.stack([rows[n] for n in ("nx", "ny", "nz")], axis=-1).reshape(-1, 3), cloud.normals
    )


def test_reads_foreign_ascii_with_other_order_and_properties(tmp_path):
    cloud = random_cloud(20)
    rows = np.concatenate([cloud.normals, np.full((20, 1), 7), cloud.points], axis=1).tolist()
    extra = "element face 1\nproperty list uchar int vertex_indices\n"
    path = write_text(tmp_path / "a.ply", [*rows, [3, 0, 1, 2]], "nx ny nz quality x y z", 20, extra)
    back = read_points(path)
    np.testing.assert_allclose(back.points, cloud.points, atol=1e-6)
    np.testing.assert_allclose(back.normals, cloud.normals, atol=1e-6)


def test_reads_big_endian_doubles_with_windows_lines(tmp_path):
    cloud = random_cloud(20)
    header = "ply\nformat binary_big_endian 1.0\nelement vertex 20\nproperty uchar red\n"
    header += "".join(f"property double {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")) + "end_header\n"
    rows = np.zeros(20, [("red", "u1"), ("v", ">f8", 6)])
    rows["v"] = np.concatenate([cloud.points, cloud.normals], axis=1)
    (tmp_path / "a.ply").write_bytes(header.replace("\n", "\r\n").encode() + rows.tobytes())
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply").points, cloud.points)


def test_normals_a_little_off_are_renormalised(tmp_path):
    cloud = random_cloud()
    write_points(tmp_path / "a.ply", PointCloud(cloud.points, cloud.normals * 1.005))
    back = read_points(tmp_path / "a.ply")
    np.testing.assert_allclose(np.linalg.norm(back.normals, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(back.normals, cloud.normals, atol=1e-6)


def test_colours_are_kept_to_8_bits(tmp_path):
    cloud = random_cloud()
    colors = np.random.default_rng(1).random((500, 3)).astype(np.float32)
    write_points(tmp_path / "a.ply", replace(cloud, colors=colors))
    back = read_points(tmp_path / "a.ply")
    assert back.colors.dtype == np.float32
    np.testing.assert_allclose(back.colors, colors, atol=0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(back.points, cloud.points)
    np.testing.assert_array_equal(back.normals, cloud.normals)
    loaded = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_array_equal(loaded.visual.vertex_colors[:, :3], np.rint(colors * 255))
    write_points(tmp_path / "b.ply", back)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    write_points(tmp_path / "c.ply", cloud)
    assert read_points(tmp_path / "c.ply").colors is None


def test_foreign_colours_are_bytes_or_unit_floats(tmp_path):
    row = [0, 0, 0, 0, 0, 1]
    floats = write_text(tmp_path / "a.ply", [[*row, 0.5, 0, 1]], "x y z nx ny nz red green blue")
    np.testing.assert_allclose(read_points(floats).colors, [[0.5, 0, 1]])
    whole = write_text(tmp_path / "b.ply", [[*row, 51, 0, 255]], "x y z nx ny nz red green blue")
    with pytest.raises(DataError, match="expected colours from 0 to 1, got 0 to 255"):
        read_points(whole)
    for name in ("red", "green", "blue"):
        whole.write_text(whole.read_text().replace(f"float {name}", f"uchar {name}"))
    np.testing.assert_allclose(read_points(whole).colors, [[0.2, 0, 1]])
    two = write_text(tmp_path / "c.ply", [[*row, 0.5, 0]], "x y z nx ny nz red green")
    assert read_points(two).colors is None


@pytest.mark.parametrize("colors", [np.full((3, 3), 255.0), np.full((3, 3), np.nan), np.zeros((2, 3))])
def test_colours_that_are_none_are_not_written(tmp_path, colors):
    with pytest.raises(AvatarError, match="colors: expected"):
        write_points(tmp_path / "a.ply", replace(random_cloud(3), colors=colors))
    assert not list(tmp_path.iterdir())


def nan_row(path):
    return write_text(path, [[0, 0, 0, 0, 0, 1], [float("nan"), 0, 0, 0, 0, 1]])


def cut_binary(path):
    write_points(path, random_cloud())
    path.write_bytes(path.read_bytes()[:-10])
    return path


BAD_FILES = {
    "no such file": lambda path: path,
    "NaN": nan_row,
    "cut short": cut_binary,
    "missing": lambda path: write_text(path, [[0, 0, 0]], "x y z"),
    "empty cloud": lambda path: write_text(path, []),
    "length 0.5": lambda path: write_text(path, [[0, 0, 0, 0, 0, 0.5]]),
    "length 0": lambda path: write_text(path, [[0, 0, 0, 0, 0, 0]]),
    "promises 3 vertices": lambda path: write_text(path, [[0, 0, 0, 0, 0, 1]], count=3),
    "promises 2000000000 vertices": lambda path: write_text(path, [[0, 0, 0, 0, 0, 1]], count=2_000_000_000),
    "cannot be read": lambda path: write_text(path, [["x", 0, 0, 0, 0, 1]]),
    "twice": lambda path: write_text(path, [[0, 0, 0, 0, 0, 1, 1]], "x y z nx ny nz x"),
    "expected a PLY file": lambda path: path.write_bytes(b"solid nothing") and path,
    "the vertices first": lambda path: path.write_text("ply\nformat ascii 1.0\nelement face 0\nend_header\n") and path,
    "known format": lambda path: path.write_text("ply\nformat binary 9\nelement vertex 0\nend_header\n") and path,
}


@pytest.mark.parametrize("reason", BAD_FILES)
def test_bad_files_are_named_with_their_reason(tmp_path, reason):
    path = BAD_FILES[reason](tmp_path / "bad.ply")
    with pytest.raises(DataError, match=reason) as caught:
        read_points(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("action", [read_points, lambda path: write_points(path, random_cloud())])
def test_other_suffixes_are_refused(tmp_path, action):
    with pytest.raises(DataError, match=r"\.ply"):
        action(tmp_path / "a.xyz")


def test_writing_refuses_unsound_clouds_and_keeps_the_old_file(tmp_path):
    cloud = random_cloud(3)
    write_points(tmp_path / "a.ply", cloud)
    before = (tmp_path / "a.ply").read_bytes()
    points = cloud.points.copy()
    points[1, 1] = np.inf
    for bad in (
        PointCloud(points, cloud.normals),
        PointCloud(cloud.points, cloud.normals[:2]),
        PointCloud(cloud.points[:0], cloud.normals[:0]),
    ):
        with pytest.raises(AvatarError):
            write_points(tmp_path / "a.ply", bad)
    assert (tmp_path / "a.ply").read_bytes() == before


def test_mutated_files_are_sound_or_refused(tmp_path):
    write_points(tmp_path / "a.ply", random_cloud(30))
    original = (tmp_path / "a.ply").read_bytes()
    generator = np.random.default_rng(0)
    refused = 0
    for _ in range(100):
        mutated = bytearray(original)
        for place in generator.integers(0, len(mutated), generator.integers(1, 6)):
            mutated[place] = generator.integers(0, 256)
        (tmp_path / "b.ply").write_bytes(mutated[: generator.integers(1, 2 * len(mutated))])
        try:
            cloud = read_points(tmp_path / "b.ply")
        except DataError:
            refused += 1
            continue
        assert len(cloud.points) and np.isfinite(cloud.points).all()
        np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    assert 20 < refused < 100
