"""The start of every verb, ``avatar train outfit=dress`` or ``python tools/train.py``, and the small verbs themselves.

The standard library alone until the verb is known, so that a missing package, a signal during imports, and a reader
that has left (``| head``) each end in one line or none, and not in a traceback. Small are those that read a few
arguments of their own instead of settings, and the count of parameters.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import gc
import inspect
import json
import os
import select
import signal
import sys
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from avatar import invocation
from avatar.declared import declared
from avatar.verbs import GROUPS, VERBS, Verb, resolve, typed_words

if TYPE_CHECKING:
    from avatar.pipeline.parameters import ParametersConfig

OLDEST = (3, 11)


def main() -> NoReturn:
    """The console command: its first argument is the verb, or the group of a verb that is the second one."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if [name] in map(typed_words, VERBS) or name in GROUPS:
        del sys.argv[1]
        run(name)
    list_verbs("avatar", [] if name in ("-h", "--help") else [name], VERBS)


def list_verbs(program: str, unknown: list[str], verbs: Iterable[str]) -> NoReturn:
    """Prints the verbs that a program has and leaves; with code 2 and the nearest one after an unknown word."""
    words = {" ".join(typed_words(verb)): VERBS[verb].does for verb in verbs}
    if unknown:
        near = difflib.get_close_matches(unknown[0], words, n=1)
        hint = f"Did you mean {near[0]}? " if near else ""
        text, stream, code = f"{program}: no verb {unknown[0]!r}. {hint}There are: {', '.join(words)}.", sys.stderr, 2
    else:
        lines = [f"  {word:13} {does}" for word, does in words.items()]
        text, stream, code = "\n".join([f"usage: {program} VERB [OPTION=VALUE ...]", "", *lines]), sys.stdout, 0
    with contextlib.suppress(BrokenPipeError):
        print(text, file=stream, flush=True)
    silence_closed_streams()
    sys.exit(code)


def verb_of_group(group: str) -> str:
    """The verb of a group that the next argument names; without one the group's verbs are listed, and the end."""
    verbs = {verb: " ".join(typed_words(verb)[1:]) for verb in VERBS if typed_words(verb)[0] == group}
    word = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if word not in verbs.values():
        list_verbs("avatar", [] if word in ("-h", "--help") else [f"{group} {word}"], verbs)
    del sys.argv[1]
    return f"{group}_{word}"


def run(name: str, verb: Verb | None = None) -> NoReturn:
    """Runs a verb, given where it is not in `VERBS`, with the arguments of the command line; leaves with its exit code.

    The name of a group stands for the verb that the first argument names.

    The code is 0, 2 for bad input or a missing package, 75 after a signal, or 141 where the reader of its output has
    left; faults of the program end in a traceback.
    """
    name = verb_of_group(name) if name in GROUPS else name
    for number in signal.SIGINT, signal.SIGTERM:  # until the verb listens itself
        signal.signal(number, leave_at_once(name))
    gc.disable()  # until `collect_garbage`
    code: int | str | None = 0
    try:
        try:
            start(name, verb or VERBS[name])
        except SystemExit as leaving:
            code = leaving.code
        sys.stdout.flush()
    except BrokenPipeError:
        if not silence_closed_streams():
            raise
        code = invocation.PIPE_CLOSED
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done
    gc.freeze()  # the interpreter's end looks at every object for garbage, which takes a second with torch's
    sys.exit(code)


def collect_garbage() -> None:
    """Turns garbage collection on, which `run` turns off while a verb is imported, once the verb's work begins.

    Modules are no garbage, and looking at all of torch's objects again and again takes a quarter of the time of its
    import. What has been imported is not looked at later either.
    """
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


def leave_at_once(verb: str) -> Callable[[int, FrameType | None], NoReturn]:
    """What listens to signals while a verb is imported, amid which no exception may be raised."""

    def leave(number: int, frame: FrameType | None) -> NoReturn:
        os.write(2, f"{verb}: stopped by {signal.Signals(number).name} before it began.\n".encode())
        os._exit(invocation.STOPPED)

    return leave


def start(name: str, verb: Verb) -> None:
    """Imports what a verb needs and calls it."""
    try:
        if sys.version_info < OLDEST:
            version = ".".join(map(str, sys.version_info[:2]))
            sys.exit(refuse(name, f"expected Python 3.11 or newer, got {version}.{environment_hint()}"))
        if verb.settings:
            from avatar.config import command

            command(name, verb=verb)
        else:
            work = resolve(verb.run)
            collect_garbage()
            work()
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if package not in invocation.CORE:
            raise
        message = f"{package} cannot be imported ({error}). Run: {invocation.command_line('doctor')}"
        if isinstance(error, ModuleNotFoundError):
            hint = environment_hint() or f" Run: {invocation.install_line(package)}"
            message = f"{package} is not installed for {sys.executable}.{hint}"
        sys.exit(refuse(name, message))
    except ValueError as error:
        from avatar.checks import AvatarError

        if not isinstance(error, AvatarError):
            raise
        sys.exit(refuse(name, error))


def refuse(name: str, message: object) -> int:
    """Prints why a verb does not do what it was asked to; gives the exit code for it."""
    print(f"{' '.join(typed_words(name))}: {message}", file=sys.stderr)
    return 2


def environment_hint() -> str:
    """The line that leads to the checkout's own environment; nothing in it, or where there is no checkout."""
    root = invocation.checkout()
    if root is None or ((root / ".venv").is_dir() and Path(sys.prefix).samefile(root / ".venv")):
        return ""
    return f" Run: {invocation.activation_line()}"


def silence_closed_streams() -> bool:
    """Turns streams whose reader has left to nowhere, so that the interpreter's last flush is quiet; were there any?"""
    found = False
    for stream in (sys.stdout, sys.stderr):
        poll = select.poll()
        poll.register(stream.fileno(), 0)  # errors and hang-ups are always reported
        if any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0)):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            found = True
    return found


def parse(verb: Callable[[], None], **arguments: dict[str, Any]) -> argparse.Namespace:
    """What a verb's command line gives for its arguments, by their names; help describes the verb by its docstring."""
    text = inspect.cleandoc(verb.__doc__ or "")
    parser = argparse.ArgumentParser(verb.__name__, description=text, formatter_class=argparse.RawTextHelpFormatter)
    for name, described in arguments.items():
        parser.add_argument(f"--{name}" if "default" in described else name, **described)
    return parser.parse_args()


def path(text: str) -> Path:
    """A path as an argument names it, its ``~`` included."""
    return Path(invocation.expand(text))


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
    """Converts a downloaded SMPL, SMPL-H or SMPL-X file (.npz or .pkl), or a rigged GLB, to a plain .npz.

    Nothing that is in the file is run.

    convert_body SMPLX_NEUTRAL.npz data/bodies/smplx_neutral.npz
    convert_body SMPL_NEUTRAL.pkl data/bodies/smpl_neutral.npz --uv smpl_uv.obj
    convert_body person.glb data/bodies/person.npz
    convert_body data/theirs/coat/template.npz with_uv.npz --uv body.obj
    """
    paths = parse(
        convert_body,
        source={"type": path, "help": "the downloaded model, .npz, .pkl or a rigged .glb or .gltf"},
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
    parameters = fields(declared("avatar.body.open:Phenotype"))
    shape = {parameter.name: {"type": float, "default": parameter.default} for parameter in parameters}
    options = vars(parse(make_body, target=TARGET, **shape))
    target = options.pop("target")
    from avatar.body.open import Phenotype, anny_body
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
    from avatar.simulate.angles import authored_motion

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
    words = [invocation.option(name, value) for name, value in where.items()]
    print(f"next: {invocation.command_line('train', *words)}")


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
