"""Canonical scans on disk: what goes in comes out, and files that are refused."""

from dataclasses import replace

import numpy as np
import pytest

from avatar.checks import AvatarError, DataError
from avatar.io.frames import read_canonical_scan, write_canonical_scan
from avatar.io.npz import read_arrays, write_arrays
from avatar.records import CanonicalScan


def random_scan(count: int = 60, seed: int = 0, **more) -> CanonicalScan:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    weights = rng.random((count, 5)) ** 6
    return CanonicalScan(
        points=rng.normal(size=(count, 3)).astype(np.float32),
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        source=np.sort(rng.permutation(2 * count)[:count]),
        **more,
    )


def whole_scan() -> CanonicalScan:
    rng = np.random.default_rng(1)
    return random_scan(faces=rng.integers(0, 60, (30, 3)), colors=rng.random((60, 3)).astype(np.float32))


@pytest.mark.parametrize("scan", [random_scan(), whole_scan()], ids=["points", "mesh"])
def test_round_trip(tmp_path, scan):
    path = tmp_path / "walk.00012.npz"
    write_canonical_scan(path, scan)
    back = read_canonical_scan(path)
    for name in ("points", "normals", "source", "faces", "colors"):
        assert np.array_equal(getattr(back, name), getattr(scan, name)), name
    np.testing.assert_allclose(back.weights, scan.weights, atol=3e-5)
    np.testing.assert_allclose(back.weights.sum(axis=1), 1, atol=1e-6)
    assert back.weights.dtype == np.float32 and back.source.dtype == np.int64


def test_equal_scans_give_equal_bytes(tmp_path):
    for name in ("a.npz", "b.npz"):
        write_canonical_scan(tmp_path / name, whole_scan())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((0, 3))}, "normals"),
        ({"normals": np.zeros((60, 3))}, "unit normals"),
        ({"weights": np.full((60, 5), 0.3)}, "summing to 1"),
        ({"points": np.full((60, 3), np.nan)}, "points.*finite"),
        ({"source": np.zeros(60, int)}, "rising"),
        ({"faces": np.array([[0, 1, 60]])}, "faces"),
        ({"faces": np.zeros((0, 3), int)}, "faces"),
        ({"colors": np.zeros((59, 3))}, "colors"),
    ],
)
def test_unsound_scans_are_not_written(tmp_path, change, message):
    with pytest.raises(AvatarError, match=message):
        write_canonical_scan(tmp_path / "a.npz", replace(random_scan(), **change))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": np.array("canonical-scan/9")}, "expected format canonical-scan/1"),
        ({"weights": np.zeros((5, 60), np.uint16)}, "summing to 1"),
        ({"normals": np.zeros((60, 3), np.float32)}, "unit normals"),
        ({"source": np.arange(60)[::-1].astype(np.int32)}, "rising"),
        ({"faces": np.array([[0, 1, 99]], np.int32)}, "faces"),
        ({"points": np.zeros((61, 3), np.float32)}, "61"),
        ({"points": None}, "points"),
    ],
)
def test_unsound_files_are_refused_by_name(tmp_path, change, message):
    path = tmp_path / "a.npz"
    write_canonical_scan(path, random_scan())
    keys = {
        "format": "text ",
        "points": "float M 3",
        "normals": "float M 3",
        "weights": "uint16 J M",
        "source": "int M",
    }
    arrays = read_arrays(path, keys) | change
    write_arrays(path, {key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(DataError, match=message) as caught:
        read_canonical_scan(path)
    assert "a.npz" in str(caught.value)


def test_missing_and_damaged_files_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(DataError, match="none"):
        read_canonical_scan(path)
    write_canonical_scan(path, random_scan())
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DataError, match="valid"):
        read_canonical_scan(path)
