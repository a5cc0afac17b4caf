"""The wheel: built without the network, installed beside the packages that are here, and used from another folder."""

import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> Path:
    """A virtual environment with the wheel, which sees this one's packages but no checkout; gives its Python."""
    folder = tmp_path_factory.mktemp("wheel")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in listed.rstrip("\0").split("\0"):  # setuptools writes where it builds
        target = folder / "source" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, target)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", folder, folder / "source"]
    subprocess.run(build, check=True, capture_output=True, timeout=300)
    (wheel,) = folder.glob("clothed_avatar-*.whl")
    shutil.rmtree(folder / "source")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True, timeout=100)
    python = folder / "venv" / "bin" / "python"
    (site,) = (folder / "venv").glob("lib/python*/site-packages")
    subprocess.run(
        [*pip, "install", "--no-deps", "--no-index", "--target", site, wheel], check=True, capture_output=True
    )
    (site / "packages.pth").write_text(sysconfig.get_path("purelib"))  # its own .pth files, the checkout's, stay unread
    return python


def in_wheel(python: Path, folder: Path, *line: str, check: bool = True) -> subprocess.CompletedProcess:
    """A command of the environment with the wheel, from a folder of its own."""
    return subprocess.run([python, *line], cwd=folder, env={}, capture_output=True, text=True, check=check, timeout=200)


@pytest.mark.slow
def test_an_installed_wheel_has_its_assets(environment, tmp_path):
    code = (
        "import avatar\n"
        "from pathlib import Path\n"
        "from avatar.body.open import open_body\n"
        "from avatar.data.layouts import find_outfit\n"
        "outfit = find_outfit(Path('nowhere'), 'sample', 'dress')\n"
        "frame = outfit.load('test', outfit.frames('test')[0])\n"
        "print(avatar.__file__, len(open_body('female').template.vertices), len(frame.scan.points) > 1000)"
    )
    where, vertices, scanned = in_wheel(environment, tmp_path, "-c", code).stdout.split()
    assert Path(where).is_relative_to(environment.parents[1]) and int(vertices) > 1000 and scanned == "True"


@pytest.mark.slow
def test_an_installed_wheel_holds_no_benchmarks_nor_reliability_tests(environment, tmp_path):
    (site,) = environment.parents[1].glob("lib/python*/site-packages")
    names = {path.name for path in site.rglob("*")}
    assert "train.yaml" in names
    assert not names & {"benchmarks", "reliability", "bench.yaml", "check_reliability.yaml"}
    refused = in_wheel(environment, tmp_path, "-m", "avatar", "bench", check=False)
    assert refused.returncode == 2 and "no verb 'bench'" in refused.stderr


@pytest.mark.slow
def test_an_installed_wheel_names_requirements_and_not_itself(environment, tmp_path):
    code = "from avatar.invocation import install_line; print(install_line('newton'))"
    line = in_wheel(environment, tmp_path, "-c", code).stdout.strip()
    assert line == f"{environment} -m pip install newton==1.8.0 warp-lang==1.19.0"


@pytest.mark.slow
def test_an_installed_wheel_runs_verbs_without_a_checkout(environment, tmp_path):
    listed = in_wheel(environment, tmp_path, "-m", "avatar", "--help").stdout
    assert "train         trains an avatar" in listed
    refused = in_wheel(environment, tmp_path, "-m", "avatar", "trian", check=False)
    assert refused.returncode == 2 and "Did you mean train?" in refused.stderr
    options = ["method=static", "train.steps=2", "train.points=500", "train.scan_points=500", "train.batch=1"]
    done = in_wheel(environment, tmp_path, "-m", "avatar", "train", *options)
    assert (tmp_path / "runs/static/sample/dress/default/avatar.safetensors").is_file()
    assert f"next: {environment} -m avatar predict run=runs/static/sample/dress/default\n" in done.stderr
    console = environment.parent / "avatar"
    assert not console.exists() or subprocess.run([console, "--help"], capture_output=True, check=True).stdout
