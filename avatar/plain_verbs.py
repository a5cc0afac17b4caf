"""Small verbs: those that read a few arguments of their own instead of settings, and the count of parameters."""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avatar.declared import declared
from avatar.invocation import command_line, expand, option

if TYPE_CHECKING:
    from avatar.pipeline.parameters import ParametersConfig


def parse(verb: Callable[[], None], **arguments: dict[str, Any]) -> argparse.Namespace:
    """What a verb's command line gives for its arguments, by their names; help describes the verb by its docstring."""
    text = inspect.cleandoc(verb.__doc__ or "")
    parser = argparse.ArgumentParser(verb.__name__, description=text, formatter_class=argparse.RawTextHelpFormatter)
    for name, described in arguments.items():
        parser.add_argument(f"--{name}" if "default" in described else name, **described)
    return parser.parse_args()


def path(text: str) -> Path:
    """A path as an argument names it, its ``~`` included."""
    return Path(expand(text))


TARGET = {"type": path, "help": "the .npz to write"}


def doctor() -> None:
    """Prints what is installed, what is missing and the command that installs it; exits with 1 if a needed part is."""
    from avatar.environment import accelerator_type, inspect_machine

    parse(doctor)
    findings = inspect_machine()
    for finding in findings:
        mark = "ok " if finding.present else ("MISSING" if finding.needed else "absent ")
        print(f"{mark:8}{finding.name:42}{finding.seen}" + ("" if finding.present else f"\n{'':8}-> {finding.hint}"))
    lacking = [finding.name for finding in findings if finding.needed and not finding.present]
    if not lacking:
        import torch

        cuda = accelerator_type() == "cuda" and f"CUDA {torch.version.cuda}: {torch.cuda.get_device_name()}"
        print(f"training would run on: {cuda or f'CPU with {torch.get_num_threads()} threads'}")
    sys.exit(bool(lacking))


def convert_body() -> None:
    """Converts a downloaded SMPL, SMPL-H or SMPL-X file (.npz or .pkl) to a plain .npz, running nothing that is in it.

    convert_body SMPLX_NEUTRAL.npz data/bodies/smplx_neutral.npz
    convert_body SMPL_NEUTRAL.pkl data/bodies/smpl_neutral.npz --uv smpl_uv.obj
    convert_body data/theirs/coat/template.npz with_uv.npz --uv body.obj
    """
    paths = parse(
        convert_body,
        source={"type": path, "help": "the downloaded model, .npz or .pkl"},
        target=TARGET,
        uv={"type": path, "default": None, "help": "an OBJ of the same mesh whose texture coordinates POP is to use"},
    )
    from avatar.body.smpl import convert_body_model

    kind = convert_body_model(paths.source, paths.target, paths.uv)
    print(f"{paths.target}: {kind} body, {paths.target.stat().st_size / 1e6:.1f} MB")
    name = json.dumps(str(paths.target.resolve()), ensure_ascii=False)
    print(f"Name it in the outfit.yaml of packed data (docs/data.md), as body: {{path: {name}}}")


def make_body() -> None:
    """Makes a body of any shape with anny, for simulate shapes=[...]; each parameter lies in [0, 1].

    make_body data/bodies/tall.npz --height 0.9 --weight 0.7
    """
    parameters = fields(declared("avatar.body.anny:Phenotype"))
    shape = {parameter.name: {"type": float, "default": parameter.default} for parameter in parameters}
    options = vars(parse(make_body, target=TARGET, **shape))
    target = options.pop("target")
    from avatar.body.anny import Phenotype, anny_body
    from avatar.body.packed import write_body

    body = anny_body(Phenotype(**options))
    write_body(target, body)
    height = float(body.template.vertices[:, 1].max() - body.template.vertices[:, 1].min())
    print(f"{target}: {len(body.template.vertices):,} vertices, {height:.2f} m tall")


def make_motion() -> None:
    """Writes one of the open dataset's motions as a file for predict motion=...

    make_motion walk walk.npz
    make_motion dance data/motions/dance.npz --seconds 10 --fps 60
    """
    name = {"help": "walk, squat, twist, reach, kick, bend or dance"}
    seconds, fps = ({"type": float, "default": value} for value in (6.0, 30.0))
    options = parse(make_motion, name=name, target=TARGET, seconds=seconds, fps=fps)
    from avatar.io.motions import write_motion
    from avatar.simulate.sequences import authored_motion

    motion = authored_motion(options.name, options.fps, options.seconds)
    write_motion(options.target, motion)
    print(f"{options.target}: {len(motion.poses)} frames, {options.fps:g} a second")


def pack() -> None:
    """Writes an outfit of any layout as packed frames, which the programs of the POP line read as well (docs/data.md).

    pack data/open/tee data/packed/tee
    """
    source, target = ({"type": path, "help": text} for text in ("the outfit's folder", "the folder to write"))
    paths = parse(pack, source=source, target=target)
    from avatar.data.folders import SPLITS
    from avatar.data.layouts import open_outfit_folder
    from avatar.data.packed_layout import write_packed_outfit

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

    methods = sorted(file.stem for file in (CONF / "method").glob("*.yaml"))
    choices = {
        (method, size): compose_settings("train", f"method={method}", f"size={size}").method
        for size in ("full", "small")
        for method in methods
    }
    print(write_parameters(config.out, choices, open_body("female").template))
    return [config.out / f"parameters.{kind}" for kind in ("csv", "md")]
