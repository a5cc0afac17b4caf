"""The ledger of finished work: what is finished stays so, what is damaged, changed or torn is done again."""

import json
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from concurrent_jobs import WAIT, run_at_once

from avatar.checks import DataError
from avatar.io.ledger import LEDGER, SOURCES, Ledger, files_digest, imported_modules, module_digest, source_digest
from avatar.io.locks import lock_file

ROOT = Path(__file__).parents[2]


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


def test_what_one_name_was_made_of_stands_beside_what_it_is_made_of_now(tmp_path):
    for note in (1, 2):
        Ledger(tmp_path).record("a", f"key {note}", note=note)
    Ledger(tmp_path).record_notes("key 2", {"a": 3, "b": 4})
    ledger = Ledger(tmp_path)
    assert [ledger.find("a", "key 1"), ledger.find("a", "key 2"), ledger.find("b", "key 2")] == [1, 3, 4]


def test_a_line_that_another_process_left_half_written_takes_no_later_one_with_it(tmp_path):
    ledger = Ledger(tmp_path)
    ledger.record("a", "key", note=1)
    with ledger.path.open("ab") as stream:
        stream.write(b'{"name": "killed", "ke')
    ledger.record("b", "key", note=2)
    assert [Ledger(tmp_path).find(name, "key") for name in "ab"] == [1, 2]


def test_processes_that_write_at_once_lose_no_line(tmp_path):
    code = (
        "import sys\nfrom pathlib import Path\nfrom avatar.io.ledger import Ledger\n"
        f"who, ledger = sys.argv[1], Ledger(Path(sys.argv[2]))\n{WAIT}"
        "for i in range(150): ledger.record(f'{who}{i}', 'key', note=who * (7000 + 100 * i))"
    )
    run_at_once(code, [(who, str(tmp_path)) for who in "abc"], timeout=100)
    ledger = Ledger(tmp_path)
    assert {(who, i) for who in "abc" for i in range(150) if ledger.find(f"{who}{i}", "key") is None} == set()


def test_a_line_waits_while_another_process_writes_one(tmp_path):
    ledger = Ledger(tmp_path)
    ledger.record("a", "key", note=1)
    writer = threading.Thread(target=ledger.record, args=("b", "key"))
    with ledger.path.open("ab") as stream:
        lock_file(stream)
        stream.write(b'{"name": "half of a li')
        stream.flush()
        writer.start()
        writer.join(0.3)
        assert writer.is_alive()
        stream.write(b'ne"}\n')
    writer.join(30)
    assert Ledger(tmp_path).find("b", "key") is True
    assert len(ledger.path.read_bytes().splitlines()) == 3


SCORING = ("avatar.evaluation.scoring", "avatar.data.layouts")


def test_the_code_that_counts_is_what_a_program_loads_to_run_it():
    found, new = set(), set(SCORING)
    while new:
        found |= new
        new = {other for name in new for other in imported_modules(name)} - found
    code = f"import importlib, sys\nfor name in {SCORING}: importlib.import_module(name)\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = {name for name in done.stdout.split() if name in SOURCES and SOURCES[name].count(b"import ")}
    assert loaded <= found
    assert not {name for name in found if name.startswith(("avatar.nn", "avatar.training", "avatar.pipeline"))}


@pytest.mark.parametrize(
    ("module", "counts"),
    [
        ("avatar.evaluation.metrics", True),
        ("avatar.geometry.neighbours", True),  # which metrics import
        ("avatar.data.scanner", True),
        ("avatar.evaluation.plots", False),
        ("avatar.training.trainer", False),
    ],
)
def test_a_change_counts_where_the_code_that_changed_is_run(change_source, module, counts):
    before = source_digest(*SCORING)
    change_source(module)
    assert (source_digest(*SCORING) != before) == counts


def test_comments_and_line_breaks_are_no_change(monkeypatch):
    name, digest_anew = "avatar.evaluation.metrics", module_digest.__wrapped__
    before = module_digest(name)
    monkeypatch.setitem(SOURCES, name, SOURCES[name] + b"\n\n# why\n")
    assert digest_anew(name) == before
    monkeypatch.setitem(SOURCES, name, SOURCES[name] + b"x = 1\n")
    assert digest_anew(name) != before


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
