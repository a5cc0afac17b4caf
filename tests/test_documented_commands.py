"""Every command line of README.md, docs/, conf/ and tools/, as a process of its own, as printed, on tiny data.

From another folder, without a terminal, with the flags that commands set. Placeholders are filled in and work is made
less (`documented.FILLED`, `documented.SHORT`); nothing else is changed. What is not run is named in `NOT_RUN`, or is a
line that is run with some options less.
"""

import re
import shlex
import shutil
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from documented import (
    FIRST,
    PROMISED,
    ROOT,
    Outcome,
    Starter,
    commands_of_document,
    copy_program,
    filled,
    prepare_workspace,
    printed_commands,
    promised_files,
    run_command,
    shortened,
    unfilled,
    variants,
    verb_of,
)

NOT_RUN = {  # a line that matches: why no test runs it
    r"make (demo|test)": "make test is what runs this file; the demo's chain is run by the line of tools/demo.py",
    r"python -m pip install .*": "installs packages",
    r"python3 -m venv .*": "sets up an environment",
    r"torchrun --nnodes 2 .*": "needs two machines; the line with --standalone is run",
    r".* hydra/launcher=slurm .*": "needs SLURM; test_multirun runs the same launcher's local form",
    r"python tools/simulate.py .*": "the cloth solver takes minutes; tests/simulate runs it on a small piece",
    r"python tools/export_body.py .*": "maintainer's tool that writes into the program",
    r"python tools/bench.py( out=docs/results)?": "all topics take minutes: the lines with only=... are run",
    r".*only=\[simulation\].*": "the cloth solver takes minutes",
}
PREPARED = (  # two series that run side by side before all else: runs, predictions and scores that other lines name
    (
        "python tools/train.py -m method=static,closet outfit=dress,tee",
        f"python tools/predict.py run={FIRST}",
        f"python tools/predict.py run={FIRST.replace('dress', 'tee')}",
        "python tools/predict.py run=runs/static/sample/dress/default",
        "python tools/evaluate.py runs=[runs/static/sample/dress/default,runs/closet/sample/dress/default]",
        f"python tools/predict.py run={FIRST} motion=walk.npz",
        "python tools/train.py outfit=dress method=pop",
        "python tools/canonicalize.py dataset=sample outfit=dress",
        "python tools/template.py outfit=dress",
        "python tools/train.py method=layered outfit=dress name=flowers scan.pattern=flowers train.steps=300 "
        "method.settings.pose=false",
        "python tools/data.py fit source=scans/unfitted dataset=own name=jacket",
        "python tools/canonicalize.py dataset=own outfit=jacket",
        "python tools/template.py dataset=own outfit=jacket",
        "python tools/train.py dataset=own outfit=jacket method=layered train.minutes=15",
        "python tools/predict.py run=runs/layered/own/jacket/default motion=walk.npz",
        "python tools/mesh.py run=runs/layered/own/jacket/default predictions=walk",
    ),
    (
        "python tools/experiment.py experiment=closet5",
        "python tools/train.py dataset=open outfit=[tee,shirt]",
        "python tools/demo.py",
    ),
)
SLOW = {
    "experiment": 25,
    "bench": 20,
    "fit_bodies": 25,
    "check_reliability": 10,
    "demo": 25,
    "doctor": 30,
}  # seconds; 6 for other verbs
PRINTED = printed_commands()


def why_not(text: str) -> str | None:
    """Why a printed line is not run; None for one that is."""
    return next((why for pattern, why in NOT_RUN.items() if re.fullmatch(pattern, text)), None)


def uncovered(commands: list[str]) -> list[str]:
    """The commands without those that another one is with some options more; of two alike the first."""
    words = {command: frozenset(shlex.split(command)) for command in commands}
    return [command for command in words if not any(words[command] < other for other in words.values())]


FOUND = list(dict.fromkeys(command for line in PRINTED if why_not(line.text) is None for command in filled(line.text)))
RUN = [command for command in FOUND if command in {*uncovered(FOUND), *(shortened(c) for s in PREPARED for c in s)}]


@pytest.fixture(scope="session")
def outcomes(request, tmp_path_factory) -> dict[str, Outcome]:
    """How each of the chosen commands ended. Two series run side by side, each in a folder of its own."""
    chosen = {
        item.callspec.params["command"]
        for item in request.session.items
        if hasattr(item, "callspec") and "command" in item.callspec.params
    }
    base = tmp_path_factory.mktemp("documented")
    program = copy_program(base / "program")
    before = {path: path.read_bytes() for path in program.rglob("*") if path.is_file() and path.suffix != ".pyc"}
    first = prepare_workspace(base / "first", program)
    found: dict[str, Outcome] = {}
    begun: set[str] = set()

    def run_all(series: Iterable[str], folder: Path, starter: Starter) -> None:
        """Runs commands one after the other: the first of a verb by a new interpreter, the others by the starter."""
        for command in series:
            if command not in found:
                fresh = verb_of(command) not in begun
                begun.add(verb_of(command))
                found[command] = run_command(command, folder, program, None if fresh else starter)

    starters = [Starter(program) for _ in range(2)]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(run_all, [map(shortened, series) for series in PREPARED], (first, first), starters))
        for path in (first / FIRST.replace("dress", "tee") / "predictions/test/tee").glob("*.ply"):
            (first / "theirs").mkdir(exist_ok=True)
            shutil.copy2(path, first / "theirs")
        shutil.copytree(first, base / "second")
        list(pool.map(run_all, halves(chosen, found), (first, base / "second"), starters))
    for starter in starters:
        starter.close()
    after = {path: path.read_bytes() for path in program.rglob("*") if path.is_file() and path.suffix != ".pyc"}
    found["program"] = Outcome(int(before != after), f"written into the program: {set(after) ^ set(before)}", 0)
    return found


def halves(chosen: set[str], done: dict[str, Outcome]) -> tuple[list[str], list[str]]:
    """The chosen commands that are still to be run, in two series of about the same length; blocks stay together."""
    blocks: dict[str, list[str]] = {}
    seen = set(done)
    for line in PRINTED:
        for command in filled(line.text) if why_not(line.text) is None else ():
            if command in chosen and command not in seen:
                seen.add(command)
                blocks.setdefault(line.block, []).append(command)
    series, seconds = ([], []), [0, 0]
    for block in sorted(blocks.values(), key=lambda block: -sum(SLOW.get(verb_of(text), 6) for text in block)):
        shorter = seconds.index(min(seconds))
        series[shorter].extend(block)
        seconds[shorter] += sum(SLOW.get(verb_of(text), 6) for text in block)
    return series


@pytest.mark.slow
@pytest.mark.parametrize("command", RUN, ids=lambda command: command[:90])
def test_the_command_does_what_it_says(command, outcomes):
    outcome = outcomes[command]
    assert outcome.code == 0, f"{command}\nended with {outcome.code}:\n{outcome.output[-4000:]}"
    assert outcome.missing == [], f"{command}\nleft nothing at {outcome.missing}:\n{outcome.output[-2000:]}"
    assert "Traceback" not in outcome.output and "Warning" not in outcome.output, outcome.output[-2000:]


@pytest.mark.slow
def test_nothing_is_written_beside_the_program(outcomes):
    assert outcomes["program"].code == 0, outcomes["program"].output


def test_every_line_is_run_or_named_with_its_reason():
    texts = {line.text for line in PRINTED}
    stale = [pattern for pattern in NOT_RUN if not any(re.fullmatch(pattern, text) for text in texts)]
    assert stale == [], "no line is printed that matches"
    assert {verb_of(command) for command in RUN} <= set(PROMISED), "say in documented.PROMISED what they leave"
    left = {command: unfilled(command) for command in RUN if unfilled(command)}
    assert left == {}, "give these a value in documented.FILLED, or name the line in NOT_RUN"
    verbs = {path.stem for path in (ROOT / "tools").glob("*.py")} - {"start"}
    started = set(re.findall(r"tools/(\w+)\.py", " ".join(texts)))
    assert started >= verbs, "a tool that no document tells how to start"


def test_every_mention_of_a_tool_with_options_is_found():
    """No line with ``tools/<verb>.py`` and options hides from `commands_of_document` behind an unknown program."""
    for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        text = re.sub(r"\s*\\\n\s*|\s+", " ", path.read_text())
        found = " ".join(line.text for line in commands_of_document(path.read_text(), path.name))
        for mention in re.findall(r"(?<!\w/)\w+\.py \S+=\S+", text):
            name, option = mention.split(" ")
            assert f"{name} {option.strip('`.,;:)')}" in found.replace("  ", " "), f"{path.name}: {mention}"


def test_lines_are_found_in_blocks_tables_and_prose():
    text = """Run `python tools/a.py x=1` first, never `train`.

| command | does |
|---|---|
| `python tools/b.py run=<run>` | makes it; `motion=walk.npz` for a motion, `--uv body.obj` |

```
A=1 python tools/c.py one=1 \\
    two=2          # why
5 jobs: 4 finished
srun python tools/d.py size=full
```
"""
    found = [variant for line in commands_of_document(text, "page") for variant in variants(line.text)]
    assert sorted(" ".join(line.split()) for line in found) == [
        "A=1 python tools/c.py one=1 two=2",
        "python tools/a.py x=1",
        "python tools/b.py run=<run>",
        "python tools/b.py run=<run> --uv body.obj",
        "python tools/b.py run=<run> motion=walk.npz",
        "python tools/d.py size=full",
    ]
    assert variants("tool [only=[a,b]] preset=x|y") == ["tool only=[a,b] preset=x", "tool only=[a,b] preset=y"]
    assert filled("python tools/report.py run=<run>") == [f"python tools/report.py run={FIRST} frames=1"]
    assert filled("python tools/new.py run=<else>") == ["python tools/new.py 'run=<else>'"]
    assert unfilled("python tools/new.py 'run=<else>'") == ["<else>"]
    swept = "python tools/train.py -m method=static,closet outfit=[dress,tee]"
    assert promised_files(swept) == [
        f"runs/{method}/sample/dress+tee/default/avatar.safetensors" for method in ("static", "closet")
    ]


def test_a_line_is_left_out_for_one_with_more_options_alone():
    lines = ["tool a=1", "tool a=1 b=2", "tool a=2", "other a=1", "tool b=2 a=1 c=3"]
    assert uncovered(lines) == ["tool a=2", "other a=1", "tool b=2 a=1 c=3"]
    assert {verb_of(command) for command in RUN} == {verb_of(command) for command in FOUND}


def test_a_command_that_fails_or_leaves_nothing_is_seen(tmp_path):
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools/report.py").write_text("print('done')")
    assert run_command("python tools/report.py run=x", tmp_path, tmp_path).missing == ["x/report.html"]
    (tmp_path / "tools/report.py").write_text("raise SystemExit(2)")
    assert run_command("python tools/report.py run=x", tmp_path, tmp_path).code == 2
