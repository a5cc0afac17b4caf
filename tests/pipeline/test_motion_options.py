"""The options of predict and export that say what a motion file does not, as processes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from motion_files import Z_FROM_Y, smpl_arrays, write_bvh

from avatar.body.model import SMPL_JOINTS
from avatar.io.points import read_points
from avatar.simulate.angles import authored_motion

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]


def command(folder, line: str) -> subprocess.CompletedProcess:
    words = [sys.executable, str(ROOT / "tools" / line.split()[0]), *line.split()[1:]]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=300)


def test_a_file_that_says_neither_axis_nor_rate_nor_unit(run, tmp_path):
    """Refused with the option that settles each; then the frames that were asked for, upright, and exported."""
    motion = authored_motion("walk", fps=30, seconds=0.5)
    arrays = smpl_arrays(motion, np.eye(3))
    poses = np.concatenate([arrays["root"], arrays["body"]], axis=1)
    travel = np.linspace([0, 0, 0], [0, 0, 100], len(poses))
    np.savez(tmp_path / "stroll.npz", poses=poses, trans=travel)
    predict = f"predict.py run={run} motion=stroll.npz points=1000 device=cpu"
    for options, problem in (
        ("", "Give fps="),
        ("fps=30", "Give up=y, or up=z if people really lie down"),
        ("fps=30 up=y", "Give units=cm"),
        ("fps=30 up=north", "up: expected one of y, z, -y, -z, auto, got 'north'"),
        ("fps=30 start=4 stop=2", "start, stop, step: expected 0 <= start < stop"),
    ):
        done = command(tmp_path, f"{predict} {options}")
        assert done.returncode == 2 and problem in done.stderr and "Traceback" not in done.stderr, done.stderr
    chosen = "up=y units=cm start=2 stop=10 step=4"
    done = command(tmp_path, f"{predict} fps=10 {chosen}")
    assert done.returncode == 0, done.stderr
    (folder,) = (run / "predictions" / "stroll").iterdir()
    assert sorted(path.name for path in folder.glob("*.ply")) == ["stroll.00000.ply", "stroll.00001.ply"]
    assert json.loads((folder / "motion.json").read_text()) == {"fps": 10.0, "frames": 2}
    first, second = (read_points(path).points for path in sorted(folder.glob("*.ply")))
    assert np.ptp(first, axis=0).argmax() == 1  # upright
    assert (second - first).mean(axis=0)[2] == pytest.approx(0.04 / 14 * 100, abs=0.05)
    export = f"export.py run={run} predictions=stroll motion=stroll.npz"
    done = command(tmp_path, f"{export} up=y units=cm start=2 stop=10 step=2")
    assert done.returncode == 2 and "expected the 2 frames that were predicted, got 4. Give start=" in done.stderr
    assert command(tmp_path, f"{export} {chosen}").returncode == 0


def test_a_z_up_rig_of_unknown_names(run, tmp_path):
    names = {joint: f"Bone {number}" for number, joint in enumerate(SMPL_JOINTS)}
    motion = authored_motion("walk", fps=30, seconds=0.1)
    write_bvh(tmp_path / "rig.bvh", motion, names=names, prefix="", basis=Z_FROM_Y)
    (tmp_path / "map.yaml").write_text("".join(f"{ours}: {theirs}\n" for ours, theirs in names.items()))
    predict = f"predict.py run={run} motion=rig.bvh points=1000 device=cpu"
    for options, problem in (("", "Give joints=map.yaml"), ("joints=map.yaml", "Give up=z, or up=y")):
        done = command(tmp_path, f"{predict} {options}")
        assert done.returncode == 2 and problem in done.stderr
    assert command(tmp_path, f"{predict} joints=map.yaml up=z").returncode == 0
    (folder,) = (run / "predictions" / "rig").iterdir()
    assert np.ptp(read_points(folder / "rig.00000.ply").points, axis=0).argmax() == 1
