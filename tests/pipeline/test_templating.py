"""The verb `template` as a process: made, resumed, and refused with the command that helps."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from tiny import write_tiny_outfit

from avatar.io.clothed_templates import read_clothed_template
from avatar.io.meshes import read_mesh

ROOT = Path(__file__).parents[2]


def call(tool: str, *words: str) -> subprocess.CompletedProcess:
    line = [sys.executable, ROOT / "tools" / f"{tool}.py", *words]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
def test_the_verb_makes_a_template_resumes_and_says_what_is_missing(tmp_path):
    write_tiny_outfit(tmp_path / "data" / "open" / "tiny")
    where = [f"data_root={tmp_path / 'data'}", f"runs_root={tmp_path / 'runs'}", "dataset=open", "outfit=tiny"]
    quick = ["pictures=0", "clothed.spacing=0.02", "clothed.edge=0.05", "clothed.refine.steps=2"]
    missing = call("template", *where, *quick)
    assert missing.returncode == 2 and "there is none" in missing.stderr and "canonicalize" in missing.stderr
    scanner = ["scan.mesh=false", "scan.points=8000", "scan.holes=0", "scan.merge=0"]
    made = call("canonicalize", *where, "weights=knn", "pictures=0", *scanner)
    assert made.returncode == 0, made.stderr
    assert "tools/template.py" in made.stdout + made.stderr  # the command that may follow
    done = call("template", *where, *quick)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "runs" / "canonical" / "open" / "tiny" / "default" / "template"
    clothed = read_clothed_template(folder / "template.npz")
    report = json.loads((folder / "report.json").read_text())
    assert (
        report["scans"] == 5 and report["held_back"] == 1 and set(report["chamfer_m2"]) >= {"inpainting", "diffusion"}
    )
    assert (
        report["counts"]["garment_parts"] == 1 and (clothed.body_vertex < 0).any() and (clothed.body_vertex >= 0).any()
    )
    assert len(read_mesh(folder / "template.ply").faces) == len(clothed.faces)
    before = (folder / "template.npz").read_bytes()
    again = call("template", *where, *quick)
    assert again.returncode == 0 and "finished already" in again.stdout + again.stderr
    assert (folder / "template.npz").read_bytes() == before
