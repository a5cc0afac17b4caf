"""The verb `texture` as a process, on the tiny outfit's coloured layered run: made, kept, used by `mesh`, refused."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tiny import SETTINGS, dressed_trunk, quick_training, write_tiny_outfit

from avatar.body.packed import write_template
from avatar.checks import AvatarError, DataError
from avatar.data.layouts import OpenOutfit
from avatar.data.scanner import Pattern, ScanConfig
from avatar.io.clothed_templates import write_clothed_template
from avatar.io.meshes import read_mesh, write_mesh
from avatar.io.textures import read_texture
from avatar.methods.settings import MethodChoice, RunConfig
from avatar.records import Mesh
from avatar.runs.texturing import TextureConfig, make_texture, open_run, spaced
from avatar.runs.training import train

ROOT = Path(__file__).parents[2]
pytest.importorskip("xatlas")


def call(tool: str, *words: str) -> subprocess.CompletedProcess:
    line = [sys.executable, ROOT / "tools" / f"{tool}.py", *words]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Path]:
    """Folders of runs on the tiny outfit: coloured, without colours, and with points of its own (coloured)."""
    base = tmp_path_factory.mktemp("texturing")
    outfit = OpenOutfit(write_tiny_outfit(base / "data" / "open" / "tiny"), "open")
    folder = base / "runs" / "canonical" / "open" / "tiny" / "default"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("{dataset: open, outfit: tiny}")
    write_template(folder / "template.npz", outfit.template)
    write_clothed_template(folder / "template" / "template.npz", dressed_trunk(outfit.template))
    settings = quick_training(steps=2, points=1000, scan_points=1000)
    where = {"dataset": "open", "outfit": ("tiny",), "data_root": base / "data", "runs_root": base / "runs"}
    found = {}
    for name, pattern, more in (
        ("colored", Pattern.checks, {}),
        ("plain", Pattern.none, {}),
        ("points", Pattern.checks, {"head": "points"}),
    ):
        choice = MethodChoice("layered", "layered", SETTINGS | {"pose": False, "handles": 0} | more)
        scan = ScanConfig(points=8000, pattern=pattern)
        found[name] = train(RunConfig(method=choice, name=name, scan=scan, train=settings, **where))
    return found


def test_runs_that_can_have_no_texture_are_refused_before_anything_is_written(runs):
    with pytest.raises(DataError, match=r"train/rise.*expected a scan with colours, got none.*scan\.pattern"):
        make_texture(TextureConfig(run=runs["plain"]))
    with pytest.raises(AvatarError, match=r"run: expected a run with a mesh of its own.*method=layered"):
        make_texture(TextureConfig(run=runs["points"]))
    assert not any((runs[name] / "texture").exists() for name in ("plain", "points"))
    for wrong in ({"texel": 0.0}, {"reach": 0.0}, {"frames": 0}, {"scored": -1}, {"texel": float("nan")}):
        with pytest.raises(AvatarError, match=next(iter(wrong))):
            TextureConfig(**wrong)


def test_without_xatlas_the_line_that_installs_it_is_named(runs, monkeypatch):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(AvatarError, match=r"xatlas is needed here.*pip install"):
        make_texture(TextureConfig(run=runs["colored"]))


def test_frames_are_spaced_evenly():
    names = tuple("abcdefghij")
    assert spaced(names, None) == spaced(names, 20) == list(names)
    assert spaced(names, 2) == ["c", "h"] and spaced(names, 1) == ["f"]


@pytest.mark.slow
def test_the_verb_bakes_keeps_and_meshes_with_the_texture(runs):
    run = runs["colored"]
    words = [f"run={run}", "texel=0.006", "scored=2", "pictures=0"]
    done = call("texture", *words)
    assert done.returncode == 0, done.stderr
    assert "mean difference of colours" in done.stdout + done.stderr and "tools/mesh.py" in done.stdout + done.stderr
    folder = run / "texture"
    texture, report = read_texture(folder), json.loads((folder / "report.json").read_text())
    clothed = open_run(TextureConfig(run=run)).clothed
    assert texture.fits(Mesh(clothed.vertices, clothed.faces))
    assert sum(report["frames"].values()) + report["unseen"] == pytest.approx(1)
    for split in ("test", "first frame"):
        found = report["errors"][split]
        assert found["texture"]["error"] < found["flat"]["error"]
        assert found["texture"]["garment_contrast"] > found["vertices"]["garment_contrast"]
    own = report["errors"]["first frame"]
    assert own["texture"]["garment_error"] < 0.8 * own["vertices"]["garment_error"]
    rest = trimesh.load(folder / "template.glb", force="mesh", process=False)
    assert rest.visual.kind == "texture" and len(rest.faces) == len(clothed.faces)
    before = {path: path.read_bytes() for path in folder.iterdir() if path.suffix in (".npz", ".png", ".glb")}
    again = call("texture", *words)
    assert again.returncode == 0 and "finished already" in again.stdout + again.stderr
    assert all(path.read_bytes() == data for path, data in before.items())

    predicted = call("predict", f"run={run}", "points=1000")
    assert predicted.returncode == 0, predicted.stderr
    meshed = call("mesh", f"run={run}", "frames=2")
    assert meshed.returncode == 0, meshed.stderr
    meshes = run / "meshes" / "test" / "tiny"
    plain = read_mesh(meshes / "check.00000.ply")
    textured = trimesh.load(meshes / "check.00000.glb", force="mesh", process=False)
    np.testing.assert_allclose(textured.triangles, plain.vertices[plain.faces], atol=1e-5)
    assert {path.name for path in meshes.glob("texture.*")} == {"texture.mtl", "texture.png"}
    assert len(list(meshes.glob("*.obj"))) == 2 and "finished already" in call("mesh", f"run={run}", "frames=2").stderr
    write_mesh(meshes / "check.00000.ply", replace(plain, faces=plain.faces[::-1].copy()))
    (meshes / "check.00000.obj").unlink()
    other = call("mesh", f"run={run}", "frames=1")
    assert other.returncode == 0 and "the texture is of other faces" in other.stdout + other.stderr
    assert "usemtl" not in (meshes / "check.00000.obj").read_text()
    shutil.rmtree(folder)
    assert call("mesh", f"run={run}", "formats=[obj,glb]").returncode == 0  # a run without texture
    assert (
        all("usemtl" not in path.read_text() for path in meshes.glob("*.obj")) and len(list(meshes.glob("*.glb"))) == 3
    )
