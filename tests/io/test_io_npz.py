"""Reading arrays without trust and writing them whole."""

import io
import zipfile

import numpy as np
import pytest

from avatar.checks import AvatarError, DataError
from avatar.io.npz import npz_keys, read_arrays, read_npy, write_arrays, write_whole

KEYS = {"points": "float N 3", "labels": "uint8 N"}


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    return {"points": rng.normal(size=(5, 3)), "labels": np.arange(5, dtype=np.uint8)}


def npy(array, **kwargs):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(array), **kwargs)
    return stream.getvalue()


def zipped(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return path


def test_what_is_written_is_read_and_numpy_reads_it_too(tmp_path, arrays):
    arrays |= {"fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)), "name": np.array("résumé")}
    write_arrays(tmp_path / "deep" / "a.npz", arrays)
    read = read_arrays(tmp_path / "deep" / "a.npz", {**KEYS, "fortran": "float 2 3", "name": "text "})
    with np.load(tmp_path / "deep" / "a.npz", allow_pickle=False) as known:
        for key, value in arrays.items():
            np.testing.assert_array_equal(read[key], value)
            np.testing.assert_array_equal(known[key], value)
    read["points"][0] = 1  # readers get arrays of their own


def test_optional_keys_come_where_present_and_others_are_not_touched(tmp_path, arrays):
    pickled = npy(np.array([{"a": 1}], dtype=object), allow_pickle=True)
    path = zipped(tmp_path / "a.npz", [("points.npy", npy(arrays["points"])), ("foreign.npy", pickled)])
    read = read_arrays(path, {"points": "float N 3"}, {"labels": "uint8 N"})
    assert list(read) == ["points"]
    with pytest.raises(DataError, match="foreign: expected float, found Python objects"):
        read_arrays(path, {"foreign": "float N"})


def test_one_of_several_shapes_fits(tmp_path):
    for side in (3, 4):
        write_arrays(tmp_path / "a.npz", {"a": np.ones((2, side, side))})
        assert read_arrays(tmp_path / "a.npz", {"a": "float V 3 3 | V 4 4"})["a"].shape == (2, side, side)
    write_arrays(tmp_path / "a.npz", {"a": np.ones((2, 5, 5))})
    with pytest.raises(DataError, match="a: expected shape"):
        read_arrays(tmp_path / "a.npz", {"a": "float V 3 3 | V 4 4"})


def test_equal_arrays_give_equal_bytes(tmp_path, arrays, monkeypatch):
    write_arrays(tmp_path / "a.npz", arrays)
    monkeypatch.setattr("time.time", lambda: 2e9)
    monkeypatch.setattr("time.localtime", lambda *_: (2033, 5, 18, 3, 33, 20, 0, 0, 0))
    write_arrays(tmp_path / "b.npz", arrays)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"labels": None}, r"expected the keys labels, found only: points"),
        ({"points": np.ones((5, 2))}, r"points: expected shape \(N, 3\), got \(5, 2\)"),
        ({"labels": np.zeros(4, np.uint8)}, r"labels: expected shape \(N\) with N=5, got \(4,\)"),
        ({"labels": np.zeros(5, np.int64)}, r"labels: expected uint8, got int64"),
        ({"points": np.ones((5, 3), int)}, r"points: expected float, got int64"),
        ({"points": np.full((5, 3), np.nan)}, r"points: expected finite numbers, got 15 NaN"),
    ],
)
def test_unsound_arrays_are_named(tmp_path, arrays, change, message):
    changed = {key: value for key, value in {**arrays, **change}.items() if value is not None}
    write_arrays(tmp_path / "a.npz", changed)
    with pytest.raises(DataError, match=message) as caught:
        read_arrays(tmp_path / "a.npz", KEYS)
    assert str(tmp_path / "a.npz") in str(caught.value)


def test_a_header_that_promises_more_than_the_file_holds_is_refused_before_allocating(tmp_path):
    plain = npy(np.zeros(4)).replace(b"(4,), }" + b" " * 12, b"(400000000000,), }  "[:19])
    assert b"400000000000" in plain
    path = zipped(tmp_path / "bomb.npz", [("points.npy", plain)])
    with pytest.raises(DataError, match="header declares 3200000000000 bytes"):
        read_arrays(path, {"points": "float N"})


def test_a_file_that_swells_is_refused_before_it_does(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(5 << 20))
    with pytest.raises(DataError, match="it swells from"):
        read_arrays(tmp_path / "a.npz", {"x": "float N"})
    np.savez_compressed(tmp_path / "b.npz", x=np.random.default_rng(0).random(3 << 20))
    assert len(read_arrays(tmp_path / "b.npz", {"x": "float N"})["x"]) == 3 << 20


def test_a_header_that_is_no_header_is_one_error(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (3,"  # numpy hands it to Python's tokenizer
        archive.writestr("x.npy", b"\x93NUMPY\x01\x00" + bytes([len(header), 0]) + header)
    with pytest.raises(DataError, match="x: expected a plain array"):
        read_arrays(tmp_path / "a.npz", {"x": "float N"})


def test_oversized_and_overcrowded_files_are_refused(tmp_path, arrays):
    write_arrays(tmp_path / "a.npz", {"zeros": np.zeros(100_000)})
    with pytest.raises(DataError, match="at most 1000 bytes of arrays"):
        read_arrays(tmp_path / "a.npz", {"zeros": "float N"}, limit=1000)
    write_arrays(tmp_path / "b.npz", {f"k{i}": np.zeros(1) for i in range(201)})
    with pytest.raises(DataError, match="at most 200 arrays, found 201"):
        read_arrays(tmp_path / "b.npz", {"k0": "float N"})
    with pytest.warns(UserWarning, match="Duplicate"):
        zipped(tmp_path / "c.npz", [("a.npy", npy(np.ones(1)))] * 2)
    with pytest.raises(DataError, match="a key twice"):
        read_arrays(tmp_path / "c.npz", {"a": "float N"})


def test_damage_anywhere_is_one_error_or_the_same_numbers(tmp_path, arrays):
    write_arrays(tmp_path / "a.npz", arrays)
    whole = (tmp_path / "a.npz").read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for trial in range(300):
        broken = bytearray(whole)
        if trial % 3:
            broken[rng.integers(len(broken))] ^= 1 << rng.integers(8)
        else:
            del broken[rng.integers(len(broken)) :]
        (tmp_path / "b.npz").write_bytes(broken)
        try:
            read = read_arrays(tmp_path / "b.npz", KEYS)
        except DataError:
            refused += 1
            continue
        for key, value in arrays.items():
            np.testing.assert_array_equal(read[key], value)
    assert refused > 150


@pytest.mark.parametrize("data", [b"", b"not a zip", b"PK\x03\x04"])
def test_what_is_no_npz_is_one_error(tmp_path, data):
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(DataError, match="expected a valid npz file"):
        read_arrays(tmp_path / "a.npz", KEYS)
    with pytest.raises(DataError, match="there is none"):
        read_arrays(tmp_path / "none.npz", KEYS)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, arrays, monkeypatch):
    write_arrays(tmp_path / "a.npz", arrays)
    before = (tmp_path / "a.npz").read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(DataError, match=r"a\.npz.*No space left"):
        write_whole(tmp_path / "a.npz", b"half")
    assert (tmp_path / "a.npz").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_objects_are_not_written(tmp_path):
    with pytest.raises(AvatarError, match="a: expected numbers or text"):
        write_arrays(tmp_path / "a.npz", {"a": np.array([None])})
    assert not (tmp_path / "a.npz").exists()


def test_keys_are_listed_without_reading(tmp_path, arrays):
    write_arrays(tmp_path / "a.npz", arrays)
    assert npz_keys(tmp_path / "a.npz") == set(arrays)
    (tmp_path / "b.npz").write_bytes(b"not a zip")
    assert npz_keys(tmp_path / "b.npz") == npz_keys(tmp_path / "none.npz") == set()


def test_one_array_is_read_as_those_of_an_npz(tmp_path, arrays):
    path = tmp_path / "a.npy"
    np.save(path, np.asfortranarray(arrays["points"]))
    np.testing.assert_array_equal(read_npy(path, "float V 3"), arrays["points"])
    whole = path.read_bytes()
    for data, message in (
        (whole[:-1], "its header declares 120 bytes"),
        (b"", "at least 1 bytes"),
        (b"\x93NUM", r"a\.npy"),
        (npy(np.array([{}, None]), allow_pickle=True), "Python objects"),
        (npy(np.full((2, 3), np.inf)), "expected finite"),
        (npy(np.zeros((2, 2))), "expected shape"),
    ):
        path.write_bytes(data)
        with pytest.raises(DataError, match=message):
            read_npy(path, "float V 3")
