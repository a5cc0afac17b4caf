"""`network`: the demo in a network namespace without interfaces."""

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

CALL = "import socket; socket.create_connection(('192.0.2.1', 80), 3)"  # an address reserved for documentation


def network_trial(root: Path, minutes: float) -> list[Finding]:
    """Runs the demo from data to report without a network, after checking that there is none.

    Raises:
        AvatarError: where the system allows no network namespace.
    """
    shutil.rmtree(root / "offline", ignore_errors=True)
    (root / "offline").mkdir(parents=True)
    offline = ["unshare", "--net"] if os.getuid() == 0 else ["unshare", "--map-root-user", "--net"]
    if shutil.which("unshare") is None or subprocess.run([*offline, "true"], capture_output=True).returncode:
        raise AvatarError("network: unshare --net is not allowed here. Leave this trial out (only=[...]).")
    connection = subprocess.run([*offline, sys.executable, "-c", CALL], capture_output=True, text=True)
    options = [
        f"train.minutes={minutes}",
        "points=5000",
        "meshes=1",
        "score.metrics=[cd_point]",
        "score.scan_points=5000",
    ]
    line = [*offline, sys.executable, str(TOOLS / "demo.py"), *options]
    with (root / "offline" / "log.txt").open("w") as log:
        done = subprocess.run(line, cwd=root / "offline", stdout=log, stderr=log)
    summary = root / "offline" / "runs" / "demo" / "summary.json"
    made = json.loads(summary.read_text())["made"] if summary.is_file() else {}
    files = [path for value in made.values() for path in (value if isinstance(value, list) else [value])]
    found = sum((root / "offline" / path).exists() for path in files)
    return [
        Finding("network", "connections that were made", int("unreachable" not in connection.stderr), "of 1", 1, 0, 0),
        Finding("network", "exit code of the demo", done.returncode, "", 1, 0, 0),
        all_of("network", "files and folders of its summary that exist", found, max(len(files), 1)),
    ]
