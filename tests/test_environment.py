"""The doctor: what is there, what is missing, and the line that mends it."""

import subprocess
import sys
from pathlib import Path

import pytest

from avatar.environment import inspect_package, mending_line

ROOT = Path(__file__).parents[1]


def test_a_package_that_is_there_is_named_with_its_version():
    finding = inspect_package("numpy", "core", needed=True)
    assert finding.present and finding.seen[0].isdigit()


def test_a_missing_package_comes_with_its_install_line():
    finding = inspect_package("no_such_package_here", "nothing", needed=True)
    assert not finding.present
    assert "No module named" in finding.seen
    assert finding.mend == "pip install no_such_package_here"


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ("ImportError: libGL.so.1: cannot open shared object file", "apt-get install -y libgl1"),
        ("OSError: libusb-1.0.so.0: cannot open shared object file", "apt-get install -y libusb-1.0-0"),
        ("ModuleNotFoundError: No module named 'open3d'", "pip install 'avatar[mesh]'"),
    ],
)
def test_a_missing_library_is_mended_by_its_package(message, line):
    assert mending_line("open3d", message).startswith(line)


@pytest.mark.slow
def test_doctor_finds_this_machine_complete():
    result = subprocess.run([sys.executable, "tools/doctor.py"], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout
    assert "MISSING" not in result.stdout and "absent" not in result.stdout
    assert "training would run on" in result.stdout
