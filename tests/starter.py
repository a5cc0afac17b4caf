"""A process that has imported the program and starts commands by forking, which saves each five seconds of importing.

Reads a request a line, ``{"words": [...], "folder": ..., "output": ..., "timeout": ...}`` in JSON, of which ``words``
begin with the command's file, and answers with the exit code.
"""

import gc
import importlib
import json
import os
import runpy
import signal
import sys
import time
from pathlib import Path

from avatar.export.pictures import load_pyvista

IMPORTED = ("avatar.config", "avatar.pipeline.experiments", "roma", "matplotlib.figure")


def run(words: list[str], folder: str, output: str) -> None:
    """Becomes the command: its arguments, its folder, no terminal."""
    os.setsid()
    os.chdir(folder)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    target = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(target, 1)
    os.dup2(target, 2)
    sys.stdin = os.fdopen(0, closefd=False)
    sys.argv, sys.path[0] = words, str(Path(words[0]).parent)
    runpy.run_path(words[0], run_name="__main__")


def wait(child: int, seconds: float) -> int:
    """The exit code of a process, which is killed when its time is up (-1)."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -1


for name in IMPORTED:
    importlib.import_module(name)
load_pyvista().Plotter  # noqa: B018  what draws is imported with it
gc.freeze()  # a child's garbage collection would write to all of these objects' pages, and so copy them
for line in sys.stdin:
    request = json.loads(line)
    child = os.fork()
    if child == 0:
        run(request["words"], request["folder"], request["output"])
        sys.exit(0)
    print(wait(child, request["timeout"]), flush=True)
