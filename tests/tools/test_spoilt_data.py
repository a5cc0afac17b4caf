"""People's own data, spoilt in every way of the published table: read, warned about or refused as it says."""

import re
from pathlib import Path

import numpy as np
import pytest

from avatar.data import outfits
from reliability.spoilt import READ, REFUSED, WARNED, Base, Spoilt
from reliability.spoilt_data import all_spoilt, read_spoilt, spoilt_table

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Base:
    return Base(tmp_path_factory.mktemp("base"))


@pytest.fixture(scope="module")
def results(base, tmp_path_factory):
    folder = tmp_path_factory.mktemp("spoilt")
    return [read_spoilt(spoilt, base, folder) for spoilt in all_spoilt()]


def test_everything_spoilt_ends_as_it_should_with_its_cause(results):
    unmet = [f"{r.spoilt.part} {r.spoilt.words}: {r.outcome} {r.untyped} {r.message}" for r in results if not r.met]
    assert unmet == []


def test_there_are_ways_of_all_kinds(results):
    kinds = {(r.spoilt.part, r.spoilt.wanted) for r in results}
    assert len({(r.spoilt.part, r.spoilt.words) for r in results}) == len(results) > 250
    assert {part for part, _ in kinds} == {"scan", "fit", "body", "folder", "motion", "mesh"}
    assert all({(part, READ), (part, REFUSED)} < kinds for part, _ in kinds)
    assert all(r.spoilt.cause for r in results if r.spoilt.wanted != READ)
    named = [r.message for r in results if r.spoilt.wanted == WARNED and r.spoilt.part == "scan"]
    assert all(re.search(r"\d", message) for message in named)  # a figure


def test_the_published_table_has_the_same_rows(results):
    """But for figures, which may differ in a last digit from machine to machine."""
    table = (ROOT / "docs" / "results" / "spoilt_data.md").read_text()
    assert table in (ROOT / "docs" / "reliability.md").read_text()

    def rows(text):
        return [re.sub(r"[\d.]+", "0", line.rpartition(" | ")[0]) for line in text.splitlines()]

    assert rows(spoilt_table(results)) == rows(table)


def test_a_check_that_is_missing_is_detected(base, tmp_path, monkeypatch):
    monkeypatch.setattr(outfits, "check_frame", lambda *args: {})
    spoilt = next(s for s in all_spoilt() if s.words == "0.9 times as large")
    result = read_spoilt(spoilt, base, tmp_path)
    assert result.silent and not result.met


def test_an_untyped_error_and_another_cause_are_detected(base, tmp_path):
    crash = Spoilt("scan", "crash", REFUSED, "", lambda frame, base: frame["none"])
    assert read_spoilt(crash, base, tmp_path).untyped == "KeyError"
    other = Spoilt("scan", "NaN", REFUSED, "centimetres", lambda f, base: f | {"scan_pc": f["scan_pc"] * np.nan})
    result = read_spoilt(other, base, tmp_path)
    assert result.outcome == REFUSED and not result.met and not result.silent
