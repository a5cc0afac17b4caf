"""Runs verbs of the checkout that this folder is in, whatever Python starts them; the standard library alone."""

import os
import sys
from pathlib import Path

ROOT = str(Path(__file__).resolve().parents[1])
sys.path.insert(0, ROOT)  # before any other package of the name
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [ROOT, os.environ.get("PYTHONPATH")]))  # of its processes

from avatar.cli import run  # noqa: E402

__all__ = ["run"]
