"""docs/paper_map.md names code and tests that are there."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
CELLS = re.findall(r"`([^`]+)`", (ROOT / "docs" / "paper_map.md").read_text())


def test_every_file_and_test_it_names_is_there():
    tests = {
        name for path in (ROOT / "tests").rglob("*.py") for name in re.findall(r"def (test_\w+)", path.read_text())
    }
    named = {name for cell in CELLS for name in re.findall(r"^test_\w+$", cell)}
    files = {name for cell in CELLS for name in re.findall(r"[\w/]+\.py", cell)}
    assert len(named) > 20 and len(files) > 20
    assert named <= tests, sorted(named - tests)
    folders = (ROOT, ROOT / "avatar", *(ROOT / "avatar").glob("*/"))  # `a/b.py, c.py`: the second in the first's folder
    assert [name for name in files if not any((folder / name).is_file() for folder in folders)] == []


def test_every_function_and_class_it_names_is_in_its_file():
    for file, names in (cell.split(": ", 1) for cell in CELLS if ".py: " in cell):
        text = (ROOT / "avatar" / file.split(", ")[0]).read_text()
        for name in re.split(r"[,.] ?", names):
            assert re.search(rf"\b{name}\b", text), f"{file}: {name}"
