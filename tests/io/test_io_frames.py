"""The open dataset's frames, garments and manifest."""

import dataclasses

import numpy as np
import pytest

from avatar.checks import AvatarError, DataError
from avatar.io.frames import (
    QUANTUM,
    OpenFrame,
    OpenGarment,
    check_manifest,
    read_open_frame,
    read_open_garment,
    write_manifest,
    write_open_frame,
    write_open_garment,
)
from avatar.io.npz import read_arrays, write_arrays


def grid_cloth(columns=60, rows=90, spacing=0.02):
    """A wavy rectangle of cloth in mesh order, as a garment's surface comes."""
    u, v = np.meshgrid(np.arange(columns) * spacing, np.arange(rows) * spacing)
    wave = 0.01 * np.sin(u * 40 + 3 * v) + 0.004 * np.cos(v * 90)
    return np.stack([u, v, wave], axis=-1).reshape(-1, 3)


@pytest.fixture
def frame():
    rng = np.random.default_rng(0)
    return OpenFrame(
        pose=rng.normal(size=(22, 3)).astype(np.float32),
        translation=np.array([0.5, -1.0, 20.0], np.float32),
        cloth=(grid_cloth() + [0.5, -1.0, 20.0]).astype(np.float32),
        visible_body=rng.random(24_541) < 0.3,
        visible_cloth=rng.random(10_003) < 0.7,
        penetration_share=0.002,
        penetration_depth=0.003,
    )


@pytest.fixture
def garment():
    canonical = grid_cloth(4, 3).astype(np.float32)
    faces = np.array([[0, 1, 4], [1, 5, 4], [7, 6, 11]])
    return OpenGarment(faces, canonical, np.array([1] * 6 + [2] * 6, np.uint8), ("top", "skirt"))


def test_a_frame_keeps_everything_and_cloth_to_half_a_quantum(tmp_path, frame):
    write_open_frame(tmp_path / "a.npz", frame)
    read = read_open_frame(tmp_path / "a.npz")
    assert np.abs(read.cloth - frame.cloth).max() <= QUANTUM / 2 + 2e-6  # and float32 at 20 m
    for name in ("pose", "translation", "visible_body", "visible_cloth"):
        np.testing.assert_array_equal(getattr(read, name), getattr(frame, name))
        assert getattr(read, name).dtype == getattr(frame, name).dtype
    assert read.penetration_share == pytest.approx(0.002)
    assert read.penetration_depth == pytest.approx(0.003)
    assert read.cloth.dtype == np.float32


def test_steps_across_the_whole_range_survive(tmp_path, frame):
    jumps = np.random.default_rng(1).choice([-1.6, 0.0, 1.6], size=(2000, 3))
    write_open_frame(tmp_path / "a.npz", dataclasses.replace(frame, cloth=jumps))
    assert np.abs(read_open_frame(tmp_path / "a.npz").cloth - jumps).max() <= QUANTUM / 2 + 1e-6


def test_frames_are_small_and_reading_what_was_read_changes_nothing(tmp_path, frame):
    coherent = np.arange(24_540) % 600 < 200
    frame = dataclasses.replace(frame, visible_body=coherent, visible_cloth=coherent[:10_680])
    write_open_frame(tmp_path / "a.npz", frame)
    assert (tmp_path / "a.npz").stat().st_size < 6 * len(frame.cloth)
    write_open_frame(tmp_path / "b.npz", read_open_frame(tmp_path / "a.npz"))
    write_open_frame(tmp_path / "c.npz", read_open_frame(tmp_path / "b.npz"))
    assert (tmp_path / "b.npz").read_bytes() == (tmp_path / "c.npz").read_bytes()


def test_unsound_frames_are_refused(tmp_path, frame):
    for change, message in (
        ({"cloth": frame.cloth * 100}, "at most 3.2 m across"),
        ({"cloth": frame.cloth[:, :2]}, "cloth: expected shape"),
        ({"pose": np.full((22, 3), np.nan)}, "pose: expected finite"),
    ):
        with pytest.raises(AvatarError, match=message):
            write_open_frame(tmp_path / "a.npz", dataclasses.replace(frame, **change))
    assert not (tmp_path / "a.npz").exists()


@pytest.mark.parametrize("key", ["origin", "translation"])
def test_frames_beyond_the_horizon_are_refused(tmp_path, frame, key):
    write_open_frame(tmp_path / "f.npz", frame)
    with np.load(tmp_path / "f.npz") as stored:
        arrays = dict(stored)
    np.savez(tmp_path / "f.npz", **(arrays | {key: np.full(3, 1e30, np.float32)}))
    with pytest.raises(DataError, match=f"{key}: expected metres"):
        read_open_frame(tmp_path / "f.npz")


def test_other_versions_and_miscounted_faces_are_refused(tmp_path, frame):
    write_open_frame(tmp_path / "a.npz", frame)
    with np.load(tmp_path / "a.npz") as stored:
        arrays = dict(stored)
    write_arrays(tmp_path / "b.npz", {**arrays, "format": np.array("open-frame/99")})
    with pytest.raises(DataError, match=r"b.npz: expected format open-frame/1, got open-frame/99"):
        read_open_frame(tmp_path / "b.npz")
    write_arrays(tmp_path / "b.npz", {**arrays, "face_counts": np.array([24_541, 9_000])})
    with pytest.raises(DataError, match="visible_cloth: expected bits for 9000 faces, got 1251 bytes"):
        read_open_frame(tmp_path / "b.npz")


def test_a_garment_is_read_as_written(tmp_path, garment):
    write_open_garment(tmp_path / "garment.npz", garment)
    read = read_open_garment(tmp_path / "garment.npz")
    for name in ("faces", "canonical", "labels"):
        np.testing.assert_array_equal(getattr(read, name), getattr(garment, name))
    assert read.names == garment.names
    assert (read.faces.dtype, read.labels.dtype) == (np.int64, np.uint8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"faces": np.array([[0, 1, 12]])}, r"faces: expected vertex indices in \[0, 12\)"),
        ({"labels": np.array([0] + [1] * 11, np.uint8)}, "labels: expected 1 to 2"),
        ({"labels": np.array([3] * 12, np.uint8)}, "labels: expected 1 to 2"),
    ],
)
def test_a_garment_that_points_at_nothing_is_refused(tmp_path, garment, change, message):
    with pytest.raises(AvatarError, match=message):
        write_open_garment(tmp_path / "garment.npz", dataclasses.replace(garment, **change))
    write_open_garment(tmp_path / "garment.npz", garment)
    arrays = read_arrays(
        tmp_path / "garment.npz",
        {"format": "text ", "faces": "int F 3", "canonical": "float V 3", "labels": "uint8 V", "names": "text G"},
    )
    write_arrays(tmp_path / "garment.npz", {**arrays, **change})
    with pytest.raises(DataError, match=message):
        read_open_garment(tmp_path / "garment.npz")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "a.npz").write_bytes(b"aaaa")
    (tmp_path / "outfit.yaml").write_text("name: x")
    (tmp_path / ".a.npz.tmp-1").write_text("half written")
    write_manifest(tmp_path)
    return tmp_path


def test_an_unchanged_folder_agrees_with_its_manifest(folder):
    before = (folder / "manifest.json").read_bytes()
    check_manifest(folder, verify_hashes=True)
    write_manifest(folder)
    assert (folder / "manifest.json").read_bytes() == before


def test_every_change_to_a_folder_names_its_file(folder):
    file = folder / "train" / "a.npz"
    file.write_bytes(b"aaab")
    check_manifest(folder)
    with pytest.raises(DataError, match=r"a\.npz: its sha256 is not"):
        check_manifest(folder, verify_hashes=True)
    file.write_bytes(b"aaabb")
    with pytest.raises(DataError, match=r"a\.npz: expected 4 bytes, got 5"):
        check_manifest(folder)
    file.unlink()
    with pytest.raises(DataError, match=r"a\.npz: the manifest lists it"):
        check_manifest(folder)
    file.write_bytes(b"aaaa")
    (folder / "train" / "b.npz").write_bytes(b"b")
    with pytest.raises(DataError, match=r"b\.npz: it is not in the manifest"):
        check_manifest(folder)


@pytest.mark.parametrize("text", ["", "[]", '{"files": {"a": 1}}', '{"files": []}'])
def test_a_broken_manifest_is_one_error(folder, text):
    (folder / "manifest.json").write_text(text)
    with pytest.raises(DataError, match="expected a manifest"):
        check_manifest(folder)
