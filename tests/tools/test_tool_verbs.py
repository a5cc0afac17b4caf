"""Verbs of `tools/` that are not in the package: started from another folder, they behave as the package's verbs do."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
QUICK = ["only=[chamfer]", "quick=true", "memory=false", "out=tables"]


def start(folder: Path, tool: str, *options: str) -> subprocess.CompletedProcess:
    """A tool's process without this one's path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    line = [sys.executable, str(ROOT / "tools" / tool), *options]
    return subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tool", "option", "message"),
    [
        ("bench.py", "repeat=1", "bench: repeat: no such option. Did you mean 'repeats'? There are: only, repeats, "),
        ("check_reliability.py", "kill=1", "check_reliability: kill: no such option. Did you mean 'kills'?"),
        ("check_reliability.py", "only=[kills]", "check_reliability only=[kills]: only: expected some of kill, "),
    ],
)
def test_wrong_options_are_named_with_the_nearest_there_is(tmp_path, tool, option, message):
    done = start(tmp_path, tool, option)
    assert done.returncode == 2 and done.stderr.startswith(message) and done.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["workers", "submitit_local"])
def test_jobs_of_other_launchers_find_the_tool_s_code(tmp_path, launcher):
    done = start(tmp_path, "bench.py", "-m", f"hydra/launcher={launcher}", "repeats=1,0", *QUICK)
    assert done.returncode == 2 and "2 jobs: 1 finished, 1 failed." in done.stderr, done.stderr
    assert "repeats, frames: expected at least 1" in done.stderr
    assert (tmp_path / "tables" / "bench.md").is_file()


@pytest.mark.slow
def test_the_end_of_a_tool_says_what_it_made(tmp_path):
    done = start(tmp_path, "check_reliability.py", "only=[fuzz]", "files=20", "out=tables")
    assert done.returncode == 0 and "check_reliability: done in " in done.stderr, done.stderr
    assert done.stderr.endswith("  tables/reliability.md\n")
