"""Parameter counts: the full networks are as large as the originals, and the table in docs/ is the command's."""

import csv
from pathlib import Path

import pytest

from avatar.body.open import open_body
from avatar.config import compose_settings
from avatar.pipeline.parameters import CODES, ORIGINAL, TOTAL, build_network, count_parameters, write_parameters

TABLE = Path(__file__).parents[2] / "docs" / "results" / "parameters.csv"
CLOSET = {"pose encoder": 10_244_096, "garment encoder": 280_928, "garment decoder": 567_046, "pose decoder": 599_814}


@pytest.fixture(scope="module")
def template():
    return open_body("female").template


def counted(method, size, template) -> dict[str, int]:
    choice = compose_settings("train", f"method={method}", f"size={size}").method
    return {count.part: count.parameters for count in count_parameters(method, size, build_network(choice, template))}


@pytest.mark.slow
def test_full_sizes_are_those_of_the_originals_and_the_table_has_them(template):
    pop, closet = (counted(method, "full", template) for method in ("pop", "closet"))
    assert {("pop", part): count for part, count in pop.items()} == ORIGINAL
    assert closet == CLOSET | {TOTAL: sum(CLOSET.values()), CODES: 64 * len(template.vertices)}
    assert abs(closet[TOTAL] / pop[TOTAL] - 1) < 0.05  # "comparable parameters": CloSET, section 4
    rows = list(csv.DictReader(TABLE.read_text().splitlines()))
    for method, counts in (("pop", pop), ("closet", closet)):
        found = {
            row["part"]: int(row["parameters"]) for row in rows if (row["method"], row["size"]) == (method, "full")
        }
        assert found == counts


def test_the_implicit_avatar_and_the_small_preset_are_counted_too(template, tmp_path):
    choices = {
        (method, "small"): compose_settings("train", f"method={method}", "size=small").method
        for method in ("scanimate", "pop")
    }
    text = write_parameters(tmp_path, choices, template)
    assert "| scanimate |" in text and "original" not in text.split("\n\n")[1]
    rows = list(csv.DictReader((tmp_path / "parameters.csv").read_text().splitlines()))
    kept = {(row["method"], row["part"]): int(row["parameters"]) for row in rows}
    assert kept["scanimate", TOTAL] == kept["scanimate", "sdf"] and ("scanimate", CODES) not in kept
    assert {row["original"] for row in rows} == {""}
    expected = [row for row in csv.DictReader(TABLE.read_text().splitlines()) if row["size"] == "small"]
    assert all(row in expected for row in rows)
