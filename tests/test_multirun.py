"""Multiruns by every launcher: one corrupt outfit stops no other, and the end of it says which and why."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from avatar.pipeline.outcomes import State, note_outcome, read_outcomes, summarise

ROOT = Path(__file__).parents[1]
SHORT = ["dataset=open", "data_root=data", "train.points=500", "train.scan_points=500", "train.batch=1"]
SHORT += ["train.mirror=false", "method=static"]


@pytest.fixture(scope="module")
def folder(tiny_folder, tmp_path_factory) -> Path:
    """A working folder with five tiny outfits in ``data/open``, the third with a corrupt frame."""
    folder = tmp_path_factory.mktemp("multirun")
    for name in ("one", "two", "three", "four", "five"):
        shutil.copytree(tiny_folder, folder / "data" / "open" / name)
    for frame in (folder / "data/open/three/train").glob("*.npz"):
        frame.write_bytes(frame.read_bytes()[:1000])
    return folder


def command(*overrides: str) -> list[str]:
    return [sys.executable, str(ROOT / "tools/train.py"), *sorted(overrides), *SHORT]  # -m before all else


def multirun(folder: Path, *overrides: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    line = command("-m", "train.steps=2", *overrides)
    return subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=900)


def finished(folder: Path) -> set[str]:
    return {path.parents[1].name for path in folder.glob("runs/static/open/*/default/avatar.safetensors")}


@pytest.mark.slow
def test_four_of_five_outfits_finish_and_the_fifth_is_named_with_the_reason(folder):
    result = multirun(folder, "outfit=one,two,three,four,five")
    assert result.returncode == 2
    assert finished(folder) == {"one", "two", "four", "five"}
    summary = result.stderr[result.stderr.index("5 jobs: ") :]
    assert summary.startswith("5 jobs: 4 finished, 1 failed.")
    failed = [line for line in summary.splitlines() if line.startswith("  failed: ")]
    assert len(failed) == 1 and "outfit=three" in failed[0] and ".npz" in failed[0]
    assert "Traceback" not in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["workers", "submitit_local"])
def test_other_launchers_name_the_failure_too(folder, launcher):
    name = f"name={launcher}"
    result = multirun(folder, f"hydra/launcher={launcher}", "outfit=three,four", name)
    assert result.returncode == 2, result.stderr
    assert "2 jobs: 1 finished, 1 failed." in result.stderr
    assert any("failed: train" in line and "outfit=three" in line for line in result.stderr.splitlines())
    assert (folder / f"runs/static/open/four/{launcher}/avatar.safetensors").is_file()


@pytest.mark.slow
def test_sigterm_saves_and_leaves_with_code_75(folder):
    """Sent to the command alone, as a batch system may: a multirun passes it on to its workers."""
    endless = ["train.steps=100000", "train.save_every=100000"]
    lines = {"alone": ["outfit=one"], "several": ["-m", "hydra/launcher=workers", "outfit=one,two,four"]}
    processes = {
        name: subprocess.Popen(
            command(*options, *endless, f"name={name}"),
            cwd=folder,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stderr=subprocess.PIPE,
            text=True,
        )
        for name, options in lines.items()
    }
    logs = [folder / f"runs/static/open/{run}/metrics.csv" for run in ("one/alone", "one/several", "two/several")]
    deadline = time.monotonic() + 400
    while time.monotonic() < deadline and not all(log.is_file() and log.read_text().count("\n") > 1 for log in logs):
        time.sleep(0.1)
    for process in processes.values():
        process.send_signal(signal.SIGTERM)
    told = {name: process.communicate(timeout=300)[1] for name, process in processes.items()}
    assert {name: process.returncode for name, process in processes.items()} == {"alone": 75, "several": 75}, told
    assert "stopped by SIGTERM, everything is saved" in told["alone"]
    assert "3 jobs: 3 stopped." in told["several"]
    assert all(list((log.parent / "checkpoints").glob("step-*.pt")) for log in logs)


def test_a_job_that_died_is_named_as_well(tmp_path):
    note_outcome(tmp_path, 0, "train outfit=one", State.running)
    note_outcome(tmp_path, 0, "train outfit=one", State.finished)
    note_outcome(tmp_path, 1, "train outfit=two", State.running)
    note_outcome(tmp_path, 2, "train outfit=three", State.stopped, "SIGTERM")
    told = summarise(read_outcomes(tmp_path))
    assert told.startswith("3 jobs: 1 crashed or still running, 1 finished, 1 stopped.")
    assert f"running: train outfit=two: process {os.getpid()} on" in told
    assert "outfit=one" not in told
    assert summarise(read_outcomes(tmp_path)[:1]) == "1 jobs: 1 finished."
