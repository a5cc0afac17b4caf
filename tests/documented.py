"""Command lines that the documents print: found, completed, shortened, and run as processes on tiny data."""

from __future__ import annotations

import ast
import json
import os
import pickle
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from bodies import distinct, random_bind, random_model, write_unwrapped

from avatar.body.packed import write_body, write_template
from avatar.data.layouts import OpenOutfit, open_outfit_folder
from avatar.data.packed_layout import write_packed_outfit
from avatar.io.frames import write_manifest
from avatar.io.motions import write_motion
from avatar.io.points import write_points
from avatar.records import PointCloud
from avatar.simulate.angles import authored_motion
from avatar.verbs import GROUPS

ROOT = Path(__file__).parents[1]
PROGRAMS = "python|python3|torchrun|srun|sbatch|make|pip|apt-get|conda|docker|bash|sh"
COMMAND = re.compile(rf"(?:[A-Z_]+=\S+ )*(?:{PROGRAMS}) \S")
OUTFITS = ("tee", "dress", "shirt", "skirt", "jacket")
CLOSET5 = "runs/{}/sample/dress/closet5_2steps_1_seed0"
POP, CSF, CLOSET = (CLOSET5.format(name) for name in ("pop", "csf", "closet"))
FIRST = "runs/closet/sample/dress/default"
TABLE = [f"runs/{name}/sample/dress/table" for name in ("static", "closet")]

# What stands for a placeholder, the first that fits; several values make several commands.
FILLED = {
    "[<run>,<run>,<folder>]": [f"[{FIRST},{FIRST.replace('closet', 'static')},theirs]"],
    "[<run>]": [f"[{FIRST}]"],
    "[<run>,<run>]": [f"[{POP},{CLOSET}]"],
    "[<run of pop>,<run of closet>]": [f"[{POP},{CLOSET}]"],
    "[<pop>,<csf>,<closet>]": [f"[{POP},{CSF},{CLOSET}]"],
    "[<static run>,<closet run>]": [f"[{','.join(TABLE)}]"],
    "<coloured run>": ["runs/layered/sample/dress/flowers"],
    "<run of several outfits>": ["runs/closet/open/tee+shirt/default"],
    "<run folder of several outfits>": ["runs/closet/open/tee+shirt/default"],
    "<new>": ["skirt"],
    "<new outfit>": ["skirt"],
    "<run>": [FIRST],
    "<run folder>": [FIRST],
    "<motion>": ["walk"],
    "<folder>": ["theirs"],
    "<seed>": ["0"],
    "<name>": ["csf"],
    "<table>": ["closet5"],
    "run=...": [f"run={folder}" for folder in TABLE],
    ",...]": ["]"],
    "out=/tmp": ["out=elsewhere"],
}

# Less work for a verb, nothing else; they replace the values that are printed.
CANONICALIZER = (
    *("train.first_steps=200", "train.second_steps=2", "train.code_steps=1", "train.batch=1"),  # enough for valid scans
    *("train.draw.scan=256", "train.draw.body=256", "train.draw.edges=64", "train.draw.pool=3000"),
    *("pictures=1", "scan.edge=0.04"),
)
CLOTHED = ("clothed.spacing=0.02", "clothed.edge=0.06", "clothed.refine.steps=2")
TRAIN = (
    "train.steps=2",
    "train.batch=1",
    "train.points=500",
    "train.scan_points=500",
    "scan.points=2000",
    "size=small",
)
PREDICT = ("points=1000", "surface.resolution=32")
SHORT = {
    "train": TRAIN,
    "fit": ("steps=2", "points=500", "scan_points=500"),
    "predict": PREDICT,
    "evaluate": ("score.scan_points=1000",),
    "compare": ("pictures=1", "resamples=100"),
    "experiment": (
        *(*TRAIN, *PREDICT, "score.scan_points=1000", "compare.pictures=1", "compare.resamples=100"),
        *(f"canonicalizer.{option}" for option in CANONICALIZER),
        *CLOTHED,
    ),
    "seams": ("points=2000",),
    "texture": ("texel=0.01", "scored=1"),
    "mesh": ("frames=1", "poisson.depth=6"),
    "report": ("frames=1",),
    "canonicalize": CANONICALIZER,
    "template": ("pictures=1", *CLOTHED),
    "demo": (
        *(*TRAIN, "points=2000", "score.scan_points=1000", "meshes=1", "static_share=1.0"),
        *(f"canonicalizer.{option}" for option in CANONICALIZER),
        *CLOTHED,
    ),
    "bench": ("quick=true", "repeats=1", "memory=false"),
    "fit_bodies": ("outfits=[tee]", "frames=1", "fitting.headings=2"),
    "check_reliability": ("only=[fuzz]", "files=50"),
    "data_check": ("frames=2",),
    "data_fit": ("body.path=scans/coat/template.npz", "fitting.headings=1", "pictures=1"),
}

# And fewer jobs of an experiment, or of one with certain options: test_configs.py composes them all.
FEWER = {
    "closet1": ("method=pop,closet", "outfit=[tee,skirt]"),
    "closet3": ("method=pop,closet", "outfit=jacket"),
    "closet5 train.seed=0,1,2": ("method=pop,closet",),
    "closet4": ("method=scale_global,csf,closet_pointnext", "outfit=jacket"),
    "clothes": ("outfit=skirt", "method=layered", "train.seed=0"),
    "clothes_others": ("outfit=jacket", "method=layered"),
    "clothes_parts": ("outfit=skirt", "method=layered_handles"),
    "closet_pop": ("budget=steps", "outfit=skirt", "method=pop,closet", "train.seed=0"),
    "fractions": ("method=static", "split.train_fraction=1.0,0.5"),
    "loose": ("method=closet,closet_learned",),
    "normals": ("outfit=tee", "method=pop", "train.seed=0"),
    "scanimate1": ("outfit=tee", "canonicalizer.weights=learned,knn", "canonicalizer.scored=1"),
    "scanimate2": ("method=scanimate_global", "split.train_fraction=0.5", "canonicalizer.scored=1"),
}
LESS = {"scored": "scored=1"}  # in place of a value that is printed

# What a verb promises to leave, with its options filled in.
PROMISED = {
    "train": ["runs/{method}/{dataset}/{outfit}/{name}/avatar.safetensors"],
    "fit": ["runs/closet-fitted/open/{outfit}/fitted/avatar.safetensors"],
    "predict": ["{run}/predictions/{split}/*/*.ply"],
    "evaluate": ["{scored}/scores*.csv"],
    "experiment": ["**/{compare.table}.csv", "**/{compare.table}.md"],
    "compare": ["**/{table}*.csv", "**/{table}.md"],
    "seams": ["**/seams.csv", "**/seams.md"],
    "mesh": ["{run}/meshes/{split}/*/*.ply", "{run}/meshes/{split}/*/*.obj", "{run}/meshes/{split}/*/*.glb"],
    "texture": [f"{{run}}/texture/{name}" for name in ("texture.png", "texture.npz", "template.glb", "report.json")],
    "export": [f"{{run}}/export/{{predictions}}/*/{name}" for name in ("points.usdc", "body.glb", "preview.webp")],
    "report": ["{run}/report.html"],
    "canonicalize": ["runs/canonical/{dataset}/{outfit}/{name}/scans/t*/*.npz"],
    "template": ["runs/canonical/{dataset}/{outfit}/{canonical}/template/template.*"],
    "demo": ["runs/demo/summary.json", "runs/layered/sample/{outfit}/demo/report.html"],
    "simulate": ["data/open/*/manifest.json"],
    "bench": ["**/bench.csv", "**/bench.md"],
    "fit_bodies": ["**/fitting.csv", "**/fitting.md"],
    "check_reliability": ["**/reliability.csv"],
    "parameters": ["**/parameters.csv", "**/parameters.md"],
    "convert_body": ["{1}"],
    "make_body": ["{0}"],
    "make_motion": ["{1}"],
    "pack": ["{1}/train/*.npz"],
    "doctor": [],
    "data_info": [],
    "data_check": [],
    "data_convert": ["data/{dataset}/{own}/train/*.npz", "data/{dataset}/{own}/manifest.json"],
    "data_fit": ["data/{dataset}/{own}/train/*.npz", "data/{dataset}/{own}/fits/fits.csv"],
}
USUAL = {
    "dataset": "sample",
    "outfit": "dress",
    "name": "default",
    "canonical": "default",
    "method": "closet",
    "split": "test",
    "table": "main",
}


@dataclass(frozen=True)
class Printed:
    """A command line as a document prints it; ``block`` is the fenced block or the line that it stands in."""

    text: str
    block: str


@dataclass
class Outcome:
    """How a command ended: exit code, output, processor and wall time, and promised files that are not there."""

    code: int
    output: str
    seconds: float
    missing: list[str] = field(default_factory=list)


def printed_commands() -> list[Printed]:
    """Every command line of README.md, docs/, the first comments of configuration files, and the tools' own help."""
    found = []
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        found += commands_of_document(path.read_text(), str(path.relative_to(ROOT)))
    for path in sorted([*(ROOT / "conf").rglob("*.yaml"), *(ROOT / "tools").rglob("*.yaml")]):
        comments = [line[2:] for line in path.read_text().splitlines()[:2] if line.startswith("# ")]
        found += [Printed(line, str(path.relative_to(ROOT))) for line in comments if COMMAND.match(line)]
    for path in sorted((ROOT / "tools").glob("*.py")):
        lines = re.findall(r"python tools/.*", ast.get_docstring(ast.parse(path.read_text())) or "")
        found += [Printed(line, str(path.relative_to(ROOT))) for line in lines]
    return [Printed(text, line.block) for line in found for text in variants(line.text)]


def commands_of_document(text: str, name: str) -> list[Printed]:
    """The commands of a Markdown document: lines of fenced blocks and inline code, in the order of the text.

    In a row of a table, options that stand behind a command (`motion=walk.npz`, `--uv body.obj`) make commands of
    their own with it.
    """
    found = []
    for number, part in enumerate(re.split(r"^```.*$", text, flags=re.MULTILINE)):
        if number % 2:
            lines = (re.sub(r"\s+#.*", "", line).strip() for line in part.replace("\\\n", " ").splitlines())
            found += [Printed(line, f"{name}, block {number // 2 + 1}") for line in lines if COMMAND.match(line)]
            continue
        rows = [[line] for line in part.splitlines() if line.startswith("|")]
        prose = re.split(r"\n\s*\n", "\n".join(line for line in part.splitlines() if not line.startswith("|")))
        for count, lines in enumerate([*rows, *([text] for text in prose)]):
            spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", lines[0])]
            commands = [span for span in spans if COMMAND.match(span)]
            if lines in rows and len(commands) == 1:
                options = [span for span in spans if re.fullmatch(r"[a-z_.]+=\S+|--\w+ \S+", span)]
                commands += [f"{commands[0]} {option}" for option in options]
            found += [Printed(command, f"{name}, text {number // 2 + 1}.{count + 1}") for command in commands]
    return found


def variants(text: str) -> list[str]:
    """A line with its optional parts (``[seed=7]``), once for each alternative (``preset=quick|full``)."""
    text = text.removeprefix("srun ")
    text = re.sub(r"(?<=\s)\[(\w[\w.]*=(?:\[[^\]]*\]|[^\[\]\s]*))\]", r"\1", text)
    words = [[word] for word in text.split(" ")]
    for number, (word,) in enumerate(words):
        key, _, values = word.rpartition("=")
        if "|" in values:
            words[number] = [f"{key}={value}" for value in values.split("|")]
    return [" ".join(choice) for choice in product(*words)]


def filled(text: str) -> list[str]:
    """The commands to run for a printed line: placeholders filled in, work shortened."""
    texts = [text]
    for placeholder, values in FILLED.items():
        texts = [
            one.replace(placeholder, value)
            for one in texts
            for value in (values if placeholder in one else [placeholder])
        ]
    return [shortened(one) for one in texts]


def verb_of(text: str) -> str:
    """The verb of a command: ``train`` of ``python tools/train.py ...``, the line itself where there is none."""
    named = re.search(r"tools/(\w+)\.py(?: (\w+)(?= |$))?", text)
    if not named:
        return text
    return f"{named[1]}_{named[2]}" if named[1] in GROUPS and named[2] else named[1]


def shortened(text: str) -> str:
    """A command with the options of its verb that make less work, in place of those printed."""
    options = list(SHORT.get(verb_of(text), ()))
    for name, fewer in FEWER.items():
        options += fewer if f" experiment={name} " in f"{text} " else ()
    if text.startswith("torchrun"):  # a whole number of frames a process, and so another run than that of one process
        options = [*(option for option in options if option != "train.batch=1"), "train.batch=4", "name=team"]
    keys = {option.partition("=")[0] for option in options}
    kept = [LESS.get(word.partition("=")[0], word) for word in shlex.split(text) if word.partition("=")[0] not in keys]
    return shlex.join([*kept, *options])


def unfilled(text: str) -> list[str]:
    """What still stands for something else in a command."""
    return re.findall(r"<[^>]*>|\.\.\.|\$\w+", text)


def promised_files(text: str) -> list[str]:
    """Globs of what a command leaves behind, below the folder it is started in."""
    words = shlex.split(text)
    options = dict(word.split("=", 1) for word in words if re.match(r"[a-z_.]+=", word))
    swept = {key: value.split(",") for key, value in options.items() if not value.startswith("[")}
    globs = []
    for values in product(*swept.values()):
        given = USUAL | options | dict(zip(swept, values))
        given["outfit"] = "+".join(given["outfit"].strip("[]").split(","))
        given["split"] = Path(given.get("motion", given.get("predictions", given["split"]))).stem
        given["scored"] = given.get("predictions") or options.get("runs", "").strip("[]").split(",")[0]
        if "experiment" in given:
            given.setdefault("compare.table", given["experiment"])
        given |= {str(i): word for i, word in enumerate(words[2:])}
        given["own"] = given["name"] if options.get("name") else Path(given.get("source", "scans")).name
        globs += [
            re.sub(r"{([\w.]+)}", lambda name, given=given: given[name.group(1)], g) for g in PROMISED[verb_of(text)]
        ]
    return list(dict.fromkeys(globs))


def run_command(
    text: str, folder: Path, program: Path, starter: Starter | None = None, timeout: float = 600
) -> Outcome:
    """Runs a command in a folder, with the program elsewhere and no terminal; by a `Starter` it is begun faster."""
    words = shlex.split(text)
    settings = [words.pop(0) for _ in range(len(words)) if re.match(r"[A-Z_]+=", words[0])]
    words = [str(program / word) if word.startswith("tools/") else word for word in words]
    started = time.monotonic()
    descriptor, name = tempfile.mkstemp()
    os.close(descriptor)
    output = Path(name)
    if starter and words[0] == "python" and not settings:
        code = starter.run(words[1:], folder, output, timeout)
    else:
        words[0] = str(Path(sys.executable).with_name(words[0]))
        environment = environment_of(program) | dict(setting.split("=", 1) for setting in settings)
        with output.open("w") as target:
            pipes = {"stdin": subprocess.DEVNULL, "stdout": target, "stderr": subprocess.STDOUT}
            try:
                code = subprocess.run(
                    words, cwd=folder, env=environment, check=False, timeout=timeout, **pipes
                ).returncode
            except subprocess.TimeoutExpired:
                code = -1
    missing = [glob for glob in promised_files(text) if not any(path.stat().st_size for path in folder.glob(glob))]
    outcome = Outcome(code, output.read_text(errors="replace"), time.monotonic() - started, missing)
    output.unlink()
    return outcome


def environment_of(program: Path) -> dict[str, str]:
    """The environment of a command: one thread, this copy of the program, nothing of the test runner's."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTEST", "COV"))}
    return kept | {"PYTHONPATH": str(program), "OMP_NUM_THREADS": "1"}


class Starter:
    """A process that has imported the program and starts commands as processes of their own (`starter.py`)."""

    def __init__(self, program: Path):
        command = [sys.executable, str(Path(__file__).with_name("starter.py"))]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.process = subprocess.Popen(command, env=environment_of(program), text=True, **pipes)

    def run(self, words: list[str], folder: Path, output: Path, timeout: float) -> int:
        """The exit code of a command whose output goes to a file."""
        request = {"words": words, "folder": str(folder), "output": str(output), "timeout": timeout}
        print(json.dumps(request), file=self.process.stdin, flush=True)
        return int(self.process.stdout.readline())

    def close(self) -> None:
        """Ends the process."""
        self.process.stdin.close()
        self.process.wait(10)


def copy_program(folder: Path) -> Path:
    """A copy of the program whose embedded sample has six train frames an outfit and two of each other split."""
    for name in ("avatar", "conf", "tools"):
        shutil.copytree(ROOT / name, folder / name)
    shutil.copy2(ROOT / "setup.cfg", folder)  # by which a checkout is known
    for outfit in (folder / "avatar/assets/sample").iterdir():
        for split, count in (("train", 6), ("test", 2), ("interpolation", 2)):
            paths = sorted((outfit / split).glob("*.npz"))
            for path in paths[count:]:
                path.unlink()
        write_manifest(outfit)
    return folder


def write_scans(outfit: OpenOutfit, folder: Path) -> None:
    """Four scans of an outfit with a body and parameters beside them, ``coat``, and six in mm, ``unfitted``."""
    write_body(folder / "coat/template.npz", outfit.body)
    for number, name in enumerate(outfit.frames("train")[:6]):
        frame = outfit.load("train", name)
        points, normals = frame.scan.points[::10], frame.scan.normals[::10]
        write_points(folder / f"unfitted/{number}.ply", PointCloud(1000 * points, normals))
        if number < 4:
            write_points(folder / f"coat/scan_{number}.ply", PointCloud(points, normals))
            fit = {"poses": frame.body.pose.reshape(1, -1), "trans": frame.body.translation[None]}
            np.savez(folder / f"coat/scan_{number}.npz", **fit)


def prepare_workspace(folder: Path, program: Path) -> Path:
    """A folder with what a reader of the documents brings: data, a body, a motion, predictions of another program."""
    sample = program / "avatar/assets/sample"
    for name in OUTFITS:
        shutil.copytree(sample / ("tee" if name == "tee" else "dress"), folder / "data/open" / name)
    write_motion(folder / "walk.npz", authored_motion("walk", fps=30, seconds=0.1))
    model, places = distinct(vars(random_model("smplx", components=20))), np.random.default_rng(3).random((90, 2))
    np.savez(folder / "SMPLX_NEUTRAL.npz", **model)
    (folder / "SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(distinct(vars(random_model("smpl")))))
    template = replace(random_bind(), faces=torch.from_numpy(model["f"].astype(np.int64)))
    write_template(folder / "data/theirs/coat/template.npz", template)
    write_packed_outfit(open_outfit_folder(folder / "data/open/dress"), folder / "data/mine/coat")
    write_scans(open_outfit_folder(folder / "data/open/dress"), folder / "scans")
    for name in ("body.obj", "smpl_uv.obj"):
        write_unwrapped(folder / name, model, places)
    return folder
