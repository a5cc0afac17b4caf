"""The doctor: what is there, what is missing, and the command that installs it."""

import inspect
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from avatar.environment import inspect_package, install_hint
from avatar.invocation import interpreter
from avatar.runs.canonicalizing import canonicalize_frames, train_canonicalizer
from avatar.runs.prediction import predict_frames
from avatar.runs.training import fit_outfit
from avatar.runs.training import train as train_run
from avatar.verbs import VERBS, resolve
from benchmarks import BENCH
from reliability import CHECK_RELIABILITY
from reliability.small_jobs import weights_digest, write_data

ROOT = Path(__file__).parents[1]
TWO_THREADS = {"OMP_NUM_THREADS": "2"}
WORK = "avatar.verbs.Verb('', '__main__:work', 'avatar.pipeline.parameters:ParametersConfig')"
RUN_WORK = f"import avatar.verbs; command('parameters', {WORK})"


def test_a_package_that_is_there_is_named_with_its_version():
    finding = inspect_package("numpy", "core", needed=True)
    assert finding.present and finding.seen[0].isdigit()


def test_a_missing_package_comes_with_its_install_line():
    finding = inspect_package("no_such_package_here", "nothing", needed=True)
    assert not finding.present
    assert "No module named" in finding.seen
    assert finding.hint.endswith("python -m pip install no_such_package_here")


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ("ImportError: libGL.so.1: cannot open shared object file", "apt-get install -y libgl1"),
        ("OSError: libusb-1.0.so.0: cannot open shared object file", "apt-get install -y libusb-1.0-0"),
        ("ModuleNotFoundError: No module named 'open3d'", f"{interpreter()} -m pip install -e '{ROOT}[mesh]'"),
    ],
)
def test_a_missing_library_is_mended_by_its_package(message, line):
    assert install_hint("open3d", message).startswith(line)


def in_fresh_python(code: str, *arguments: str, **variables: str) -> subprocess.CompletedProcess:
    """A new interpreter's output, without what this one says about threads."""
    preset = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
    kept = {name: value for name, value in os.environ.items() if name not in preset}
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        env=kept | variables,
    )


def test_every_verb_has_its_idle_threads_sleep_soon_unless_told_otherwise():
    """OpenMP itself says what it has read; it does so when torch loads it."""
    said = in_fresh_python("import avatar.config, torch", OMP_DISPLAY_ENV="verbose").stderr
    assert "OMP_WAIT_POLICY = 'PASSIVE'" in said and "GOMP_SPINCOUNT = '10000'" in said
    said = in_fresh_python("import avatar.config, torch", OMP_DISPLAY_ENV="verbose", OMP_WAIT_POLICY="ACTIVE").stderr
    assert "OMP_WAIT_POLICY = 'ACTIVE'" in said and "GOMP_SPINCOUNT = '10000'" not in said


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator")
def test_every_verb_keeps_freed_memory_for_what_comes_next():
    """A large array costs page faults every time, or only the first time."""
    code = (
        "import resource, torch\n"
        "from avatar.config import command\n"
        "def faults():\n"
        "    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "    for _ in range(3): torch.ones(1 << 24)\n"
        "    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before\n"
        "print(min(faults() for _ in range(8)))\n"
        "def work(config): return print(min(faults() for _ in range(8))) or []\n"
    ) + RUN_WORK
    thrown_away, kept = map(int, in_fresh_python(code).stdout.split())
    assert thrown_away > 3 * 10_000 and kept < 1000


@pytest.mark.parametrize("settings", ["avatar.pipeline.parameters:ParametersConfig", ""])
def test_garbage_is_looked_for_while_a_verb_works_alone(settings):
    """Not amid torch's import, and neither then nor at the end among the objects that it has made."""
    code = (
        "import atexit, gc, avatar.verbs\n"
        "from avatar.cli import run\n"
        "collections = []\n"
        "gc.callbacks.append(lambda phase, facts: collections.append(facts))\n"
        "def work(*settings):\n"
        "    frozen, others = gc.get_freeze_count(), len(gc.get_objects())\n"
        "    print(len(collections), gc.isenabled(), 100 * frozen // (frozen + others))\n"
        "    return []\n"
        "def count(): print(len(gc.get_objects()))\n"
        "atexit.register(count)\n"
        "collections.clear()\n"
        f"run('parameters', avatar.verbs.Verb('', '__main__:work', {settings!r}))"
    )
    collections, enabled, frozen, left = in_fresh_python(code).stdout.split()
    assert (collections, enabled) == ("0", "True") and int(frozen) > 95 and int(left) < 1000


def test_garbage_is_looked_for_once_workers_have_done_the_jobs():
    code = (
        "import gc\n"
        "from avatar.config import conclude\n"
        "from avatar.pipeline.outcomes import Outcome\n"
        "from avatar.verbs import Verb\n"
        "def then(done): return print(gc.isenabled())\n"
        "gc.disable()\n"
        "verb = Verb('', '__main__:work', 'avatar.pipeline.parameters:ParametersConfig', '__main__:then')\n"
        "conclude('parameters', verb, [Outcome(0, 'parameters', 'finished')])"
    )
    assert in_fresh_python(code).stdout == "True\n"


X86 = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the switch of x86 processors")
LEFT = (
    "import torch\n"
    "def left():\n"
    "    tiny = torch.full((1 << 20,), 1e-20)\n"
    "    return int((tiny * tiny).count_nonzero())\n"
)


@X86
def test_every_verb_takes_the_smallest_numbers_for_zero_in_all_threads():
    """Also in OpenMP threads that were at work before; and numbers are the caller's own again afterwards."""
    code = LEFT + (
        "from avatar.config import command\n"
        "print(left())\n"
        "def work(config): return print(left()) or []\n"
        f"try: {RUN_WORK}\n"
        "except SystemExit: print(left())"
    )
    assert in_fresh_python(code, **TWO_THREADS).stdout.split() == [str(1 << 20), "0", str(1 << 20)]


@X86
def test_blocks_of_a_prepared_process_may_be_nested_and_left_by_errors():
    code = LEFT + (
        "from avatar.environment import prepared_process\n"
        "@prepared_process()\n"
        "def work(depth):\n"
        "    if depth == 2: raise KeyError\n"
        "    try: work(depth + 1)\n"
        "    finally: print(left())\n"
        "try: work(0)\n"
        "except KeyError: print(left())"
    )
    assert in_fresh_python(code, **TWO_THREADS).stdout.split() == ["0", "0", str(1 << 20)]


@X86
def test_a_fork_does_not_wait_for_its_parents_threads():
    code = LEFT + (
        "import os\n"
        "from avatar.environment import prepared_process\n"
        "left()\n"
        "torch.set_num_threads(1)\n"
        "child = os.fork()\n"
        "with prepared_process(): found = left()\n"
        "if child == 0: os._exit(found and 3)\n"
        "print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))"
    )
    assert in_fresh_python(code, **TWO_THREADS).stdout.strip() == "0"


@pytest.mark.parametrize("first", ["torch", "avatar"])
def test_who_imports_torch_too_early_is_warned_once(first):
    code = f"import {first}, torch\nfrom avatar.environment import prepared_process\n"
    code += "for _ in range(2):\n    with prepared_process(): pass"
    said = in_fresh_python(code).stderr
    assert said.count("Hint: import avatar first") == (first == "torch")
    assert "Hint" not in in_fresh_python(code, OMP_WAIT_POLICY="ACTIVE").stderr


def test_all_that_verbs_and_callers_of_the_package_start_prepares_the_process():
    """Every verb with settings, and the functions that the docs call from Python."""
    started = [train_run, train_canonicalizer, canonicalize_frames, fit_outfit, predict_frames]
    started += [resolve(verb.run) for name, verb in VERBS.items() if verb.settings and name != "parameters"]
    started += [resolve(verb.run) for verb in (BENCH, CHECK_RELIABILITY)]
    assert len(started) == 26
    bare = [f.__qualname__ for f in started if not inspect.getsource(f).startswith("@prepared_process()")]
    assert bare == []


@pytest.mark.slow
def test_a_run_from_python_has_the_bits_of_the_command_s(tmp_path):
    """Codes that start at zero and move by 1e-39 a step, in two threads, after other work with torch."""
    write_data(tmp_path)
    line = [
        sys.executable,
        str(ROOT / "tools" / "train.py"),
        "dataset=open",
        "outfit=tee",
        "name=command",
        "size=small",
    ]
    line += [f"data_root={tmp_path / 'data'}", f"runs_root={tmp_path / 'runs'}", "device=cpu", "name=command"]
    line += ["scan.points=1000", "train.steps=2", "train.batch=1", "train.points=300", "train.scan_points=300"]
    line += ["train.code_lr=1e-39", "method.settings.code_std=0"]
    done = subprocess.run(line, cwd=tmp_path, env=os.environ | TWO_THREADS, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "runs" / "closet" / "open" / "tee" / "command"
    code = (
        "import sys, torch\n"
        "torch.ones(1 << 20).exp().sum()  # two OpenMP threads are there before the package is\n"
        "from dataclasses import replace\n"
        "from pathlib import Path\n"
        "from avatar.io.documents import read_yaml\n"
        "from avatar.settings import settings_from_dict\n"
        "from avatar.methods.settings import RunConfig\n"
        "from avatar.runs.training import train\n"
        "config = settings_from_dict(RunConfig, read_yaml(Path(sys.argv[1]) / 'config.yaml'))\n"
        "train(replace(config, name='python'))"
    )
    in_fresh_python(code, str(folder), **TWO_THREADS)
    assert weights_digest(folder) == weights_digest(folder.with_name("python")) != ""


@pytest.mark.slow
def test_doctor_finds_this_machine_complete():
    result = subprocess.run([sys.executable, "tools/doctor.py"], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout
    assert "MISSING" not in result.stdout and "absent" not in result.stdout
    assert "training would run on" in result.stdout
