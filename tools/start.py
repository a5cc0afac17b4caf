"""Runs verbs of the checkout that this folder is in, whatever Python starts them; the standard library alone.

Those of this folder alone, which are no part of the package, are named by where their `avatar.verbs.Verb` stands.
"""

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback from here on; verbs listen themselves

import os  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

TOOLS = str(Path(__file__).resolve().parent)
ROOT = str(Path(TOOLS).parent)
sys.path.insert(0, ROOT)  # before any other package of the name
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [ROOT, os.environ.get("PYTHONPATH")]))  # of its processes

from typing import NoReturn  # noqa: E402

from avatar import cli  # noqa: E402
from avatar.verbs import resolve  # noqa: E402


def run(name: str, own: str = "") -> NoReturn:
    """Runs a verb of the package, or with ``own``, ``module:attribute`` of a `Verb`, one of this folder's."""
    if not own:
        cli.run(name)
    os.environ["PYTHONPATH"] += os.pathsep + TOOLS  # of processes that a launcher starts
    cli.run(name, resolve(own))
