"""Processes that start their work at the same moment."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
WAIT = "import sys\nprint('ready', flush=True)\nsys.stdin.readline()\n"  # where the work of a process begins


def run_at_once(code: str, arguments: Sequence[Sequence[str]], timeout: float = 300) -> None:
    """Runs Python code that contains `WAIT` in one process for each list of arguments, and expects exit code 0."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    jobs = [subprocess.Popen([sys.executable, "-c", code, *a], cwd=ROOT, env=environment, **pipes) for a in arguments]
    assert [job.stdout.readline() for job in jobs] == ["ready\n"] * len(jobs)
    for job in jobs:
        job.stdin.write("go\n")
        job.stdin.flush()
    for job in jobs:
        job.communicate(timeout=timeout)
        assert job.returncode == 0
