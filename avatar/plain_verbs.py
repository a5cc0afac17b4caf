"""Small verbs: those that read a few arguments of their own instead of settings, and the count of parameters."""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from avatar.cli import refuse
from avatar.declared import declared
from avatar.invocation import command_line
from avatar.values import expand, option

if TYPE_CHECKING:
    from avatar.pipeline.parameters import ParametersConfig


def parser_of(verb: Callable[[], None]) -> argparse.ArgumentParser:
    """A parser of a verb's arguments that describes it by its docstring."""
    text = inspect.cleandoc(verb.__doc__ or "")
    return argparse.ArgumentParser(verb.__name__, description=text, formatter_class=argparse.RawTextHelpFormatter)


@contextmanager
def refusals(name: str) -> Iterator[None]:
    """Ends the program with one line where the arguments of a verb are refused."""
    from avatar.checks import AvatarError

    try:
        yield
    except AvatarError as error:
        sys.exit(refuse(name, error))


def path(text: str) -> Path:
    """A path as an argument names it, its ``~`` included."""
    return Path(expand(text))


def doctor() -> None:
    """Prints what is installed, what is missing and the command that installs it; exits with 1 if a needed part is."""
    from avatar.environment import accelerator, inspect_machine

    parser_of(doctor).parse_args()
    findings = inspect_machine()
    for finding in findings:
        mark = "ok " if finding.present else ("MISSING" if finding.needed else "absent ")
        print(f"{mark:8}{finding.name:42}{finding.seen}" + ("" if finding.present else f"\n{'':8}-> {finding.hint}"))
    lacking = [finding.name for finding in findings if finding.needed and not finding.present]
    if not lacking:
        print(f"training would run on: {accelerator()}")
    sys.exit(bool(lacking))


def convert_body() -> None:
    """Converts a downloaded SMPL, SMPL-H or SMPL-X file (.npz or .pkl) to a plain .npz, running nothing that is in it.

    convert_body SMPLX_NEUTRAL.npz data/bodies/smplx_neutral.npz
    convert_body SMPL_NEUTRAL.pkl data/bodies/smpl_neutral.npz --uv smpl_uv.obj
    convert_body data/theirs/coat/template.npz with_uv.npz --uv body.obj
    """
    parser = parser_of(convert_body)
    parser.add_argument("source", type=path, help="the downloaded model, .npz or .pkl")
    parser.add_argument("target", type=path, help="the .npz to write")
    parser.add_argument("--uv", type=path, help="an OBJ of the same mesh whose texture coordinates POP is to use")
    paths = parser.parse_args()

    from avatar.body.smpl import convert_body_model

    with refusals("convert_body"):
        kind = convert_body_model(paths.source, paths.target, paths.uv)
    print(f"{paths.target}: {kind} body, {paths.target.stat().st_size / 1e6:.1f} MB")
    name = json.dumps(str(paths.target.resolve()), ensure_ascii=False)
    print(f"Name it in the outfit.yaml of packed data (docs/data.md), as body: {{path: {name}}}")


def make_body() -> None:
    """Makes a body of any shape with anny, for simulate shapes=[...]; each parameter lies in [0, 1].

    make_body data/bodies/tall.npz --height 0.9 --weight 0.7
    """
    parser = parser_of(make_body)
    parser.add_argument("target", type=path, help="the .npz to write")
    for parameter in fields(declared("avatar.body.open:Phenotype")):
        parser.add_argument(f"--{parameter.name}", type=float, default=parameter.default)
    options = vars(parser.parse_args())
    target = options.pop("target")

    from avatar.body.open import Phenotype, anny_body
    from avatar.body.packed import write_body

    with refusals("make_body"):
        body = anny_body(Phenotype(**options))
        write_body(target, body)
    height = float(body.template.vertices[:, 1].max() - body.template.vertices[:, 1].min())
    print(f"{target}: {len(body.template.vertices):,} vertices, {height:.2f} m tall")


def make_motion() -> None:
    """Writes one of the open dataset's motions as a file for predict motion=...

    make_motion walk walk.npz
    make_motion dance data/motions/dance.npz --seconds 10 --fps 60
    """
    parser = parser_of(make_motion)
    parser.add_argument("name", help="walk, squat, twist, reach, kick, bend or dance")
    parser.add_argument("target", type=path, help="the .npz to write")
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--fps", type=float, default=30.0)
    options = parser.parse_args()

    from avatar.io.motions import write_motion
    from avatar.simulate.angles import authored_motion

    with refusals("make_motion"):
        motion = authored_motion(options.name, options.fps, options.seconds)
        write_motion(options.target, motion)
    print(f"{options.target}: {len(motion.poses)} frames, {options.fps:g} a second")


def pack() -> None:
    """Writes an outfit of any layout as packed frames, which the programs of the POP line read as well (docs/data.md).

    pack data/open/tee data/packed/tee
    """
    parser = parser_of(pack)
    parser.add_argument("source", type=path, help="the outfit's folder")
    parser.add_argument("target", type=path, help="the folder to write")
    paths = parser.parse_args()

    from avatar.data.layouts import open_outfit_folder
    from avatar.data.outfits import SPLITS
    from avatar.data.packed_layout import write_packed_outfit

    with refusals("pack"):
        packed = write_packed_outfit(open_outfit_folder(paths.source), paths.target)
    count = sum(len(packed.frames(split)) for split in SPLITS if packed.has_frames(split))
    where = {"dataset": paths.target.parent.name, "outfit": paths.target.name, "data_root": paths.target.parent.parent}
    print(f"{paths.target}: {count} frames")
    print(f"next: {command_line('train', *(option(name, value) for name, value in where.items()))}")


def parameters(config: ParametersConfig) -> list[Path]:
    """Counts every method's parameters at both sizes: writes ``<out>/parameters.csv`` and ``parameters.md``."""
    from avatar.body.open import open_body
    from avatar.config import CONF, compose_settings
    from avatar.pipeline.parameters import write_parameters

    methods = sorted(path.stem for path in (CONF / "method").glob("*.yaml"))
    choices = {
        (method, size): compose_settings("train", f"method={method}", f"size={size}").method
        for size in ("full", "small")
        for method in methods
    }
    print(write_parameters(config.out, choices, open_body("female").template))
    return [config.out / f"parameters.{kind}" for kind in ("csv", "md")]
