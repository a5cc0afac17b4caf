"""The doctor: what is there, what is missing, and the line that mends it."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from avatar.environment import inspect_package, mending_line
from avatar.invocation import interpreter

ROOT = Path(__file__).parents[1]


def test_a_package_that_is_there_is_named_with_its_version():
    finding = inspect_package("numpy", "core", needed=True)
    assert finding.present and finding.seen[0].isdigit()


def test_a_missing_package_comes_with_its_install_line():
    finding = inspect_package("no_such_package_here", "nothing", needed=True)
    assert not finding.present
    assert "No module named" in finding.seen
    assert finding.mend.endswith("python -m pip install no_such_package_here")


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ("ImportError: libGL.so.1: cannot open shared object file", "apt-get install -y libgl1"),
        ("OSError: libusb-1.0.so.0: cannot open shared object file", "apt-get install -y libusb-1.0-0"),
        ("ModuleNotFoundError: No module named 'open3d'", f"{interpreter()} -m pip install -e '{ROOT}[mesh]'"),
    ],
)
def test_a_missing_library_is_mended_by_its_package(message, line):
    assert mending_line("open3d", message).startswith(line)


def in_fresh_python(code: str, **variables: str) -> subprocess.CompletedProcess:
    """A new interpreter's output, without what this one says about threads."""
    told = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
    kept = {name: value for name, value in os.environ.items() if name not in told}
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True, env=kept | variables
    )


def test_every_verb_has_its_idle_threads_sleep_soon_unless_told_otherwise():
    """OpenMP itself says what it has read; it does so when torch loads it."""
    said = in_fresh_python("import avatar.config", OMP_DISPLAY_ENV="verbose").stderr
    assert "OMP_WAIT_POLICY = 'PASSIVE'" in said and "GOMP_SPINCOUNT = '10000'" in said
    said = in_fresh_python("import avatar.config", OMP_DISPLAY_ENV="verbose", OMP_WAIT_POLICY="ACTIVE").stderr
    assert "OMP_WAIT_POLICY = 'ACTIVE'" in said and "GOMP_SPINCOUNT = '10000'" not in said


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator")
def test_every_verb_keeps_freed_memory_for_what_comes_next():
    """A large array costs page faults every time, or only the first time."""
    code = (
        "import resource, torch\n"
        "from avatar.config import command\n"
        "def faults():\n"
        "    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "    for _ in range(3): torch.ones(1 << 24)\n"
        "    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before\n"
        "print(min(faults() for _ in range(8)))\n"
        "command('bench', lambda config: print(min(faults() for _ in range(8))))"
    )
    thrown_away, kept = map(int, in_fresh_python(code).stdout.split())
    assert thrown_away > 3 * 10_000 and kept < 1000


def test_every_verb_takes_the_smallest_numbers_for_zero_in_all_threads():
    code = (
        "import torch\n"
        "from avatar.config import command\n"
        "def left(config):\n"
        "    tiny = torch.tensor([1e-20]).repeat(1 << 20)\n"
        "    print(int((tiny * tiny).count_nonzero()))\n"
        "command('bench', left)"
    )
    if platform.machine() in ("x86_64", "AMD64"):
        assert in_fresh_python(code, OMP_NUM_THREADS="2").stdout.strip() == "0"


@pytest.mark.slow
def test_doctor_finds_this_machine_complete():
    result = subprocess.run([sys.executable, "tools/doctor.py"], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout
    assert "MISSING" not in result.stdout and "absent" not in result.stdout
    assert "training would run on" in result.stdout
