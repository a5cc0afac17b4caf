"""The command line as a new user meets it: install lines, missing packages, mistyped options, signals, pipes, endings.

Verbs run as real processes, with real signals and pipes, from another folder than the checkout's.
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

import avatar.invocation
from avatar.arguments import explain, tidy_arguments
from avatar.checks import AvatarError
from avatar.config import CONF, register
from avatar.invocation import DISTRIBUTION, EXTRAS, install_line
from avatar.pipeline.outcomes import find_ending
from avatar.pipeline.surfaces import MeshConfig, mesh
from avatar.progress import Progress
from avatar.verbs import VERBS, typed_words

ROOT = Path(__file__).parents[1]
OUTSIDE = {  # not in the package
    "bench": "benchmarks:BENCH",
    "fit_bodies": "benchmarks:FIT_BODIES",
    "check_reliability": "reliability:CHECK_RELIABILITY",
}
CALLED = {typed_words(verb)[0] for verb in VERBS}  # verbs, and groups of verbs
TOOLS = sorted(path for path in (ROOT / "tools").glob("*.py") if path.stem in CALLED or path.stem in OUTSIDE)
SHORT = ["dataset=open", "outfit=tiny", "method=static", "train.points=500", "train.scan_points=500", "train.batch=1"]
SHORT += ["train.mirror=false"]


@pytest.fixture(scope="module")
def folder(tiny_folder, tmp_path_factory) -> Path:
    """A working folder with the tiny outfit in ``data/open``."""
    folder = tmp_path_factory.mktemp("work")
    shutil.copytree(tiny_folder, folder / "data" / "open" / "tiny")
    return folder


def begin(folder: Path, verb: str, *options: str, **streams) -> subprocess.Popen:
    """A verb in a process group of its own, as a terminal starts it."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    line = [sys.executable, str(ROOT / "tools" / f"{verb}.py"), *options]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams
    return subprocess.Popen(line, cwd=folder, env=environment, text=True, start_new_session=True, **streams)


def finish(process: subprocess.Popen) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a process at its end."""
    out, err = process.communicate(timeout=300)
    assert "Traceback" not in err, err
    return process.returncode, out or "", err


def wait_for(process: subprocess.Popen, text: str) -> None:
    """Reads a process's standard error up to a text."""
    seen = ""
    while text not in seen:
        line = process.stderr.readline()
        assert line, seen
        seen += line


def test_nothing_names_a_distribution_that_belongs_to_somebody_else():
    """``pip install 'avatar[...]'`` would install a stranger's package."""
    files = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    for name in files:
        path = ROOT / name
        if path.suffix in (".py", ".md", ".sh", ".yaml", ".cfg", ".toml") or path.name == "Makefile":
            found = re.findall(r"""pip install [^\n]*['" ]avatar[['" ][^\n]*""", path.read_text())
            assert path == Path(__file__) or not found, f"{path}: {found}"
    assert DISTRIBUTION != "avatar" and f"\nname = {DISTRIBUTION}\n" in (ROOT / "setup.cfg").read_text()


def test_install_lines_are_right_in_a_checkout_and_from_a_wheel(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(avatar.invocation, "interpreter", lambda: "/my env/bin/python")
    expected = ["/my env/bin/python", "-m", "pip", "install", "-e", f"{ROOT}[simulate]"]
    assert shlex.split(install_line("newton")) == expected
    monkeypatch.setattr(avatar.invocation, "checkout", lambda: None)
    listed = [
        "torch>=2.10",
        'open3d-cpu>=0.19; sys_platform == "linux" and extra == "mesh"',
        'newton==1.8.0; extra == "simulate"',
        'warp-lang==1.19.0; extra == "simulate"',
    ]
    monkeypatch.setattr("importlib.metadata.requires", lambda name: listed)
    assert shlex.split(install_line("warp"))[4:] == ["newton==1.8.0", "warp-lang==1.19.0"]
    assert shlex.split(install_line("open3d").partition(" and, ")[0])[4:] == [
        'open3d-cpu>=0.19; sys_platform == "linux"'
    ]
    assert shlex.split(install_line("torch"))[4:] == ["torch>=2.10"]


def test_every_package_of_an_install_line_is_in_the_extra_it_names():
    listed = (ROOT / "setup.cfg").read_text()
    for package, extra in EXTRAS.items():
        name = {"hydra_plugins": "hydra-joblib-launcher"}.get(
            package, avatar.invocation.DISTRIBUTIONS.get(package, package)
        )
        block = re.search(rf"^{extra} =\n((?:    .*\n)+)", listed, re.M)
        assert block and re.search(rf"^    {name}\b", block[1], re.M), (package, extra)


@pytest.mark.parametrize("tool", [path for path in TOOLS if path.stem != "doctor"], ids=lambda path: path.stem)
def test_a_python_without_packages_names_the_line_to_run(tool, tmp_path):
    """``-S`` leaves out all that is installed, as the system's own Python has it."""
    needed = {
        "convert_body": ["a", "b"],
        "pack": ["a", "b"],
        "make_motion": ["walk", "b"],
        "make_body": ["a"],
        "data": ["check"],
    }
    line = [sys.executable, "-S", tool, *needed.get(tool.stem, [])]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "is not installed" in done.stderr and ".venv/bin/activate" in done.stderr


def test_the_doctor_needs_no_package():
    code = "import avatar.cli, avatar.environment; print(avatar.environment.install_hint('torch', ''))"
    line = [sys.executable, "-S", "-c", code]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=100, check=True)
    assert done.stdout.endswith(f"-m pip install -e {ROOT}\n")


def test_every_verb_has_its_tool_and_no_tool_does_more():
    assert {path.stem for path in TOOLS} == CALLED | OUTSIDE.keys() and not CALLED & OUTSIDE.keys()
    for tool in TOOLS:
        words = ", ".join(f'"{word}"' for word in (tool.stem, OUTSIDE.get(tool.stem)) if word)
        assert tool.read_text().endswith(f'from start import run\n\nif __name__ == "__main__":\n    run({words})\n')


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["data"], 0, "  data convert  converts a data set"),
        (["data", "--help"], 0, "  data check  "),
        (["data", "chek"], 2, "avatar: no verb 'data chek'. Did you mean data check? There are: data info, "),
        (["data_check"], 2, "avatar: no verb 'data_check'. Did you mean data check?"),
        (["data", "check", "source=nowhere"], 2, "data check source=nowhere: nowhere: expected a folder of scans"),
        (["data", "check", "sourc=."], 2, "data check: sourc: no such option. Did you mean 'source'?"),
    ],
)
def test_verbs_of_a_group_are_two_words(words, code, said, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "avatar", *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=100,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == code and said in done.stdout + done.stderr and "Traceback" not in done.stderr


def test_lists_in_printed_commands_are_quoted():
    """zsh takes brackets for a pattern of file names."""
    for path in (ROOT / "README.md", *CONF.glob("*.yaml"), *(ROOT / "tools").rglob("*.yaml"), *TOOLS):
        assert re.findall(r"(?:tools/\w+\.py|simulate) [^\n]*?(?<!')\b\w+=\[[^\n]*", path.read_text()) == [], path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--outfit", "dress"], "Options are written without dashes: outfit=dress"),
        (["--outfit=dress"], "Options are written without dashes: outfit=dress"),
        (["dress"], "dress: expected an option, written NAME=VALUE."),
        (["runs=[a,", "b"], "runs=[a,: a list without its end"),
        (["outfit=a,b"], "for a list write 'outfit=[a,b]'; for one job each put -m before the options."),
        (["motion=dir(1)/walk.npz"], "as 'motion=\"dir(1)/walk.npz\"'."),
        (["--cfg", "wrong"], "invalid choice: 'wrong'"),
        (["--resolve"], "--resolve: goes with --cfg"),
        (["-m", "--cfg", "job"], "expected one of --run"),
    ],
)
def test_forms_that_are_not_options_are_explained(arguments, message):
    with pytest.raises(AvatarError) as caught:
        tidy_arguments(arguments, {})
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_flags_may_follow_options_and_lists_may_have_blanks():
    assert tidy_arguments(["outfit=a,b", "-m", "runs=[a,", "b]"], {}) == ["-m", "outfit=a,b", "runs=[a, b]"]


@pytest.mark.parametrize(
    ("verb", "override", "message"),
    [
        ("train", "train.minuts=1", "train.minuts: no such option. Did you mean 'train.minutes'? There are: steps, "),
        ("train", "minutes=1", "minutes: no such option. Did you mean 'train.minutes'?"),
        ("train", "trian.steps=1", "Did you mean 'train.steps'?"),
        ("train", "~train.minuts", "train.minuts: no such option. Did you mean 'train.minutes'?"),
        ("train", "method.settings.offset_scal=1", "Did you mean 'method.settings.offset_scale'?"),
        ("train", "method=closett", "method: expected one of closet, "),
        ("train", "size=smal", "size: expected one of full, small, got 'smal'. Did you mean 'small'?"),
        ("experiment", "experiment=closet55", "got 'closet55'. Did you mean 'closet5'?"),
        ("predict", "outfit=dress", "outfit: no such option. There are: "),
        ("train", "hydra/launcher=workerz", "Did you mean 'workers'?"),
    ],
)
def test_a_mistyped_option_is_named_with_the_nearest_there_is(verb, override, message):
    import hydra

    register(verb)
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"), pytest.raises(Exception) as caught:
        hydra.compose(verb, [override])
    text = explain(caught.value, verb, [override])
    assert message in text and "\n" not in text and "+" not in text and "_defaults" not in text


def test_mistyped_runs_and_predictions_are_named_with_the_nearest_there_is(tmp_path):
    (tmp_path / "runs/closet/sample/dress/default").mkdir(parents=True)
    with pytest.raises(AvatarError, match=r"Did you mean '.*/runs/closet/sample/dress/default'"):
        mesh(MeshConfig(run=tmp_path / "runs/closett/sample/dres/default"))


@pytest.mark.slow
def test_ctrl_c_saves_and_says_how_to_go_on_and_a_second_leaves_at_once(folder):
    endless = [*SHORT, "train.steps=100000", "train.save_every=100000", "train.log_every=1"]
    processes = {name: begin(folder, "train", *endless, f"name={name}") for name in ("once", "twice")}
    for process in processes.values():
        wait_for(process, "step 2 of ")
        os.killpg(process.pid, signal.SIGINT)
    while processes["twice"].poll() is None:  # signals that come together count as one
        os.killpg(processes["twice"].pid, signal.SIGINT)
        time.sleep(0.02)
    assert finish(processes["twice"])[0] == -signal.SIGINT
    code, _, err = finish(processes["once"])
    assert code == 75 and "stopped by SIGINT, everything is saved. The same command goes on" in err
    assert len(list((folder / "runs/static/open/tiny/once/checkpoints").glob("step-*.pt"))) == 1
    early = begin(folder, "train", *endless)
    while "libtorch" not in Path(f"/proc/{early.pid}/maps").read_text():  # amid the imports
        time.sleep(0.01)
    os.killpg(early.pid, signal.SIGINT)
    code, _, err = finish(early)
    assert code == 75 and err == "train: stopped by SIGINT before it began.\n"


WORKERS = """
import sys, time
from pathlib import Path
from types import SimpleNamespace
from avatar.processes import in_workers
from avatar.training.signals import leave_when_asked

if __name__ != "__main__":
    Path("importing").touch()
    time.sleep(1)

def sleep_on(name):
    Path(name).touch()
    time.sleep(1000)

if __name__ == "__main__":
    with leave_when_asked():
        list(in_workers(sleep_on, [(name,) for name in "abcd"], 2))
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_workers_end_quietly_with_who_started_them(tmp_path, number):
    """Ctrl-C goes to the whole group, SIGTERM to the command alone, and SIGKILL leaves it no time for anything."""
    (tmp_path / "script.py").write_text(WORKERS)
    options = {"cwd": tmp_path, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    process = subprocess.Popen([sys.executable, "script.py"], env=os.environ | {"PYTHONPATH": str(ROOT)}, **options)
    deadline = time.monotonic() + 60
    awaited = ["importing"] if number == signal.SIGINT else ["a", "b"]  # a traceback is likeliest amid the imports
    while not all((tmp_path / name).exists() for name in awaited):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    code, _, err = finish(process)  # at the end of standard error, which the workers hold as well
    assert code == (75 if number != signal.SIGKILL else -signal.SIGKILL)
    assert (err == "" or number == signal.SIGKILL) and not (tmp_path / "c").exists()  # Python counts what was leaked


@pytest.mark.slow
@pytest.mark.parametrize("line", ["train --help", "train --cfg job", "convert_body --help"])
def test_a_reader_that_leaves_is_no_error(line, folder):
    reading, writing = os.pipe()
    os.close(reading)
    process = begin(folder, *line.split(), stdout=writing)
    os.close(writing)
    code, _, err = finish(process)
    assert code == (0 if line.startswith("convert_body") else 141) and err == ""  # argparse hides it


@pytest.mark.slow
def test_a_reader_of_progress_that_leaves_stops_training_with_all_saved(folder):
    process = begin(folder, "train", *SHORT, "train.steps=100000", "train.log_every=1", "name=piped")
    wait_for(process, "step 1 of ")
    process.stderr.close()
    assert process.wait(timeout=200) in (75, 141)
    assert list((folder / "runs/static/open/tiny/piped/checkpoints").glob("step-*.pt"))


@pytest.mark.slow
def test_a_verb_says_what_it_made_and_the_next_command_works_as_printed(folder):
    odd = "it's (1), ä $x/runs"
    train = [*SHORT, "train.steps=4", "train.log_every=2", "name=next", f"runs_root={odd}"]
    code, _, err = finish(begin(folder, "train", *train))
    assert code == 0 and "train: step 2 of 4, loss " in err and "train: step 4 of 4, loss " in err
    assert "train: done in " in err and f"(4 steps).\n  {odd}/static/open/tiny/next/avatar.safetensors\n" in err
    code, _, again = finish(begin(folder, "train", *train))
    assert code == 0 and "train: finished already, nothing was left to do." in again
    (following,) = re.findall(r"^next: (.*)$", err, re.M)
    assert again.count(f"next: {following}\n") == 1
    done = subprocess.run(
        f"{following} points=1000", shell=True, cwd=folder, capture_output=True, text=True, check=True
    )
    assert "predict: done in " in done.stderr and "(3 made)" in done.stderr
    (following,) = re.findall(r"^next: (.*)$", done.stderr, re.M)
    assert shlex.split(following)[-1] == f'runs=["{odd}/static/open/tiny/next"]'
    done = subprocess.run(following, shell=True, cwd=folder, capture_output=True, text=True, check=True)
    assert f"  {odd}/static/open/tiny/next/scores.csv\n" in done.stderr


ODD = ["walk(2).npz", "1 a#b,c.npz", 'it\'s "ä" [x] {y} $z ${w}.npz', "a\u0308=%d.npz", "true", "~no one"]


@pytest.mark.parametrize("name", ODD)
def test_a_shell_hands_over_any_path(name, tmp_path):
    line = shlex.join([sys.executable, str(ROOT / "tools/report.py"), f"run={name}"])
    done = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode == 2 and f": {name}/avatar.safetensors: no such file." in done.stderr


def test_the_home_folder_is_known_after_an_equals_sign(tmp_path):
    for line in (f"{ROOT}/tools/report.py run=~/1", f"{ROOT}/tools/pack.py ~/1 ~/2"):
        done = subprocess.run(
            ["bash", "-c", f"{sys.executable} {line}"],
            cwd=tmp_path,
            env=os.environ | {"HOME": "/no home"},
            capture_output=True,
            text=True,
            timeout=100,
        )
        assert done.returncode == 2 and "/no home/1" in done.stderr


def test_a_multirun_takes_an_existing_path_with_a_comma_for_one_value(tmp_path):
    (tmp_path / "a,b").mkdir()
    code, _, err = finish(begin(tmp_path, "report", "-m", "run=a,b,c d"))
    assert code == 2 and "2 failed" in err
    assert ": a,b/avatar.safetensors: no such file." in err and ": c d/avatar.safetensors: no such file." in err


@pytest.mark.slow
def test_plain_verbs_take_any_path_and_print_what_follows(folder):
    odd = Path("it's (1), ä $x")
    code, out, _ = finish(begin(folder, "pack", "data/open/tiny", str(odd / "packed" / "tiny")))
    (following,) = re.findall(r"^next: (.*)$", out, re.M)
    assert code == 0
    done = subprocess.run(f"{following} --cfg job", shell=True, cwd=folder, capture_output=True, text=True, check=True)
    assert yaml.safe_load(done.stdout)["data_root"] == str(odd)
    code, out, _ = finish(begin(folder, "make_motion", "walk", f"{odd}/1.npz", "--seconds=0.1"))
    assert code == 0 and (folder / odd / "1.npz").is_file()


def test_time_left_counts_what_ends_the_run_first(monkeypatch, caplog):
    clock, used = [0.0], [7.0]  # budgets may count the processor's time, log lines come by the wall clock
    monkeypatch.setattr("avatar.progress.time.monotonic", lambda: clock[0])
    progress = Progress("train", 1000, "step", done=100, budget=300, spent=60, clock=lambda: used[0])
    with caplog.at_level("INFO"), progress:
        for _ in range(10):
            clock[0] += 2
            used[0] += 1
            progress.advance()
        assert progress.seconds_left() == 300 - 60 - 10
        progress.show(loss="1.5")
        progress.budget = None
        assert progress.seconds_left() == 890
    assert caplog.messages[-1] == "train: step 110 of 1000, loss 1.5, 1 min 10 s, 3 min 50 s left"
    assert [m for m in caplog.messages if "loss" not in m] == ["train: step 106 of 1000, 1 min 6 s, 3 min 54 s left"]


def test_the_bar_on_a_terminal_ends_with_the_budget(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with Progress("train", 1_000_000, "step", budget=100, clock=lambda: clock[0]) as progress:
        for _ in range(20):
            clock[0] += 1
            progress.advance()
        assert progress.bar.total == 100


def test_after_a_demo_the_same_method_is_trained_longer_on_the_same_data(tmp_path):
    (tmp_path / "summary.json").write_text('{"made": {}}')
    chosen = {"method": SimpleNamespace(variant="layered"), "dataset": "open", "outfit": ("skirt",)}
    config = SimpleNamespace(**chosen, data_root=Path("other"))
    *_, line = find_ending("demo", config, tmp_path / "summary.json")[1]
    assert line.endswith("train.py method=layered dataset=open outfit=skirt data_root=other train.minutes=30")
