"""The tests that are marked ``pretended``, in a process that has the pretended accelerator."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = ("tests/test_devices.py", "tests/geometry/test_sparse.py", "tests/geometry/test_neighbours.py")


@pytest.mark.slow
def test_everything_runs_on_a_pretended_accelerator():
    line = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *FILES]
    done = subprocess.run(line, cwd=ROOT, env=os.environ | {"AVATAR_PRETENDED": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-6000:]


def test_every_file_with_such_tests_is_among_them():
    marked = [path for path in (ROOT / "tests").rglob("test_*.py") if "mark.pretended" in path.read_text()]
    assert {str(path.relative_to(ROOT)) for path in marked if path != Path(__file__)} == set(FILES)
