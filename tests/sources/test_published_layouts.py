"""Layouts of published data: found, listed, read, and converted to outfits that hold the same to a micrometre."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from foreign_layouts import WRITERS, write_bodies

from avatar.data.packed_layout import PackedOutfit
from avatar.sources.base import SourceBody
from avatar.sources.conversion import ConvertConfig, convert_outfit
from avatar.sources.registry import open_sources

MICROMETRE = 1e-6  # metres


@pytest.fixture(scope="module")
def bodies(person, tmp_path_factory):
    return write_bodies(tmp_path_factory.mktemp("bodies"), person)


@pytest.fixture(scope="module", params=WRITERS)
def converted(request, person, bodies, tmp_path_factory):
    """A data set of a layout, converted: its name, folder and truth, the settings, and the outfits."""
    write, kind = WRITERS[request.param]
    root = tmp_path_factory.mktemp(request.param) / "theirs"
    root.mkdir()
    truth = write(root, person)
    before = tree_digest(root)
    config = ConvertConfig(source=root, body=SourceBody(path=bodies[kind]), data_root=root.parent / "data", test=0.5)
    folders = [convert_outfit(source, config) for source in open_sources(config)]
    assert tree_digest(root) == before  # nothing of the originals is touched
    return request.param, root, truth, config, [PackedOutfit(folder) for folder in folders]


def tree_digest(root: Path) -> dict[str, str]:
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in root.rglob("*") if path.is_file()}


def frames_of(outfits):
    for outfit in outfits:
        for split in ("train", "test"):
            for name in outfit.frames(split):
                yield outfit, split, name


def truth_key(truth, outfit, split, name):
    return next(key for key in (name, f"{split}/{name}", f"{outfit.name}/{name}") if key in truth)


def test_the_layout_is_found_by_its_files(converted):
    layout, _, _, config, outfits = converted
    sources = open_sources(config)
    assert {source.layout for source in sources} == {layout}
    assert [source.name for source in sources] == [outfit.name for outfit in outfits]
    one = open_sources(ConvertConfig(source=sources[0].path, layout=layout, body=config.body))
    assert [source.name for source in one if source.name == sources[0].name] == [sources[0].name]


def test_scans_and_bodies_are_the_same_after_conversion(converted):
    _, _, truth, _, outfits = converted
    seen = set()
    for outfit, split, name in frames_of(outfits):
        frame, key = outfit.load(split, name), truth_key(truth, outfit, split, name)
        np.testing.assert_allclose(frame.scan.points, truth[key].scan, rtol=0, atol=MICROMETRE)
        np.testing.assert_allclose(frame.body.vertices, truth[key].body, rtol=0, atol=MICROMETRE)
        posed = outfit.fit_pose(frame.body.pose, frame.body.translation)
        np.testing.assert_allclose(posed.vertices, truth[key].body, rtol=0, atol=MICROMETRE)
        np.testing.assert_allclose(frame.body.pose[:22], truth[key].pose, rtol=0, atol=MICROMETRE)
        seen.add(key)
    assert seen == set(truth)


def test_a_second_conversion_makes_nothing_anew(converted):
    _, _, _, config, outfits = converted
    before = {path: path.stat().st_mtime_ns for outfit in outfits for path in outfit.path.rglob("*.npz")}
    for source in open_sources(config):
        convert_outfit(source, config)
    frames = {path: path.stat().st_mtime_ns for outfit in outfits for path in outfit.path.glob("t*/*.npz")}
    assert frames == {path: time for path, time in before.items() if path.parent.name in ("train", "test")}
