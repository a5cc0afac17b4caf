"""The ledger of finished work: what is finished stays so, what is damaged, changed or torn is done again."""

import json

import pytest

from avatar.checks import DataError
from avatar.io.ledger import LEDGER, Ledger, files_digest


def test_finished_work_is_known_until_its_files_or_what_made_them_change(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"points")
    Ledger(tmp_path).record("a", "key", [tmp_path / "a.ply"])
    Ledger(tmp_path).record("b", "key", note={"cd": 0.1 + 0.2})
    ledger = Ledger(tmp_path)
    assert ledger.find("a", "key") is True
    assert ledger.find("b", "key") == {"cd": 0.1 + 0.2}  # to the bit
    assert ledger.find("a", "other key") is None and ledger.find("c", "key") is None
    (tmp_path / "a.ply").write_bytes(b"paints")
    assert Ledger(tmp_path).find("a", "key") is None
    (tmp_path / "a.ply").unlink()
    assert Ledger(tmp_path).find("a", "key") is None


def test_the_last_word_counts(tmp_path):
    for note in (1, 2):
        Ledger(tmp_path).record("a", f"key {note}", note=note)
    assert Ledger(tmp_path).find("a", "key 1") is None and Ledger(tmp_path).find("a", "key 2") == 2


def test_a_torn_or_tampered_line_takes_no_other_with_it(tmp_path):
    ledger = Ledger(tmp_path)
    for name in "abc":
        ledger.record(name, "key", note=name)
    path = tmp_path / LEDGER
    lines = path.read_bytes().splitlines(keepends=True)
    for cut in range(1, len(lines[2]) - 1, 9):
        path.write_bytes(b"".join(lines[:2]) + lines[2][:cut])
        again = Ledger(tmp_path)
        assert [again.find(name, "key") for name in "abc"] == ["a", "b", None]
        again.record("d", "key", note="d")
        assert [Ledger(tmp_path).find(name, "key") for name in "abcd"] == ["a", "b", None, "d"]
    path.write_bytes(lines[0].replace(b'"note": "a"', b'"note": "x"') + b"[" * 5000 + b"\n" + lines[1])
    assert [Ledger(tmp_path).find(name, "key") for name in "ab"] == [None, "b"]


def test_a_refusing_disk_is_one_error_and_the_manifest_is_no_part_of_a_folder(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="could not be written"):
        Ledger(tmp_path / "file").record("a", "key")
    (tmp_path / "garment.npz").write_bytes(b"1")
    before = files_digest(tmp_path)
    (tmp_path / "manifest.json").write_text(json.dumps({}))
    assert files_digest(tmp_path) == before
    (tmp_path / "garment.npz").write_bytes(b"2")
    assert files_digest(tmp_path) != before
