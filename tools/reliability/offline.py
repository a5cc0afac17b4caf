"""`network`: the demo in a network namespace of its own, where there is nobody to talk to."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from avatar.checks import AvatarError
from reliability.findings import Finding, all_of
from reliability.payloads import TOOLS

CALL = "import socket; socket.create_connection(('192.0.2.1', 80), 3)"  # an address of documentation


def network_trial(root: Path, minutes: float) -> list[Finding]:
    """Runs the demo from data to report without a network, after making sure that there is none.

    Raises:
        AvatarError: where the system lets nobody make a namespace.
    """
    shutil.rmtree(root / "offline", ignore_errors=True)
    (root / "offline").mkdir(parents=True)
    alone = ["unshare", "--net"] if os.getuid() == 0 else ["unshare", "--map-root-user", "--net"]
    if shutil.which("unshare") is None or subprocess.run([*alone, "true"], capture_output=True).returncode:
        raise AvatarError("network: unshare --net is not allowed here. Leave this trial out (only=[...]).")
    call = subprocess.run([*alone, sys.executable, "-c", CALL], capture_output=True, text=True)
    options = [
        f"train.minutes={minutes}",
        "points=5000",
        "meshes=1",
        "score.metrics=[cd_point]",
        "score.scan_points=5000",
    ]
    line = [*alone, sys.executable, str(TOOLS / "demo.py"), *options]
    with (root / "offline" / "log.txt").open("w") as log:
        done = subprocess.run(line, cwd=root / "offline", stdout=log, stderr=log)
    summary = root / "offline" / "runs" / "demo" / "summary.json"
    made = json.loads(summary.read_text())["made"] if summary.is_file() else {}
    files = [path for value in made.values() for path in (value if isinstance(value, list) else [value])]
    there = sum((root / "offline" / path).exists() for path in files)
    return [
        Finding("network", "calls that get out", int("unreachable" not in call.stderr), "of 1", 1, 0, 0),
        Finding("network", "exit code of the demo", done.returncode, "", 1, 0, 0),
        all_of("network", "files and folders of its summary that are there", there, max(len(files), 1)),
    ]
