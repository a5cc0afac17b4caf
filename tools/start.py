"""Runs verbs of the checkout that this folder is in, whatever Python starts them; the standard library alone."""

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback from here on; verbs listen themselves

import os  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

ROOT = str(Path(__file__).resolve().parents[1])
sys.path.insert(0, ROOT)  # before any other package of the name
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [ROOT, os.environ.get("PYTHONPATH")]))  # of its processes

from avatar.cli import run  # noqa: E402

__all__ = ["run"]
