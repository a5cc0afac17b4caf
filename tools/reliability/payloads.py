"""`payloads`: forty malicious files that would run code, or write elsewhere, if they were trusted."""

from __future__ import annotations

import builtins
import hashlib
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.body.smpl import convert_body_model
from avatar.checks import AvatarError
from avatar.data.layouts import open_outfit_folder
from avatar.io.checkpoints import load_checkpoint, read_weights
from avatar.io.meshes import read_mesh
from avatar.io.motions import read_motion
from avatar.runs.training import load_avatar
from reliability.findings import Finding, all_of, none_of
from reliability.formats import FORMATS, smpl_arrays
from reliability.workers import run_worker

TOOLS = Path(__file__).parents[1]
Payload = Callable[[Path, str], Callable[[], Any]]  # writes a file that would run a command; returns its loader


class CallWhenUnpickled:
    """An object whose pickle calls a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any):
        self.call = (function, arguments)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple]:
        return self.call


class CallInState(CallWhenUnpickled):
    """The same in the state that an object is built with: its keys hold the call."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (dict, (), None, None, iter([("v_template", CallWhenUnpickled(*self.call[:1], *self.call[1]))]))


def malicious_objects(command: str) -> dict[str, Any]:
    """Objects that run a command when they are unpickled, by several functions and in several places."""
    words, code = ["/bin/sh", "-c", command], f"__import__('os').system({command!r})"
    shell = CallWhenUnpickled(os.system, command)
    nested = {**smpl_arrays(), "v_template": np.array([shell], dtype=object)}
    return {
        "os.system": shell,
        "os.popen": CallWhenUnpickled(os.popen, command),
        "os.execv": CallWhenUnpickled(os.execv, words[0], words),
        "os.spawnv": CallWhenUnpickled(os.spawnv, os.P_WAIT, words[0], words),
        "subprocess.call": CallWhenUnpickled(subprocess.call, words),
        "subprocess.Popen": CallWhenUnpickled(subprocess.Popen, words),
        "eval": CallWhenUnpickled(builtins.eval, code),
        "exec": CallWhenUnpickled(builtins.exec, code),
        "getattr": CallWhenUnpickled(map, os.system, (command,)),
        "in a state": CallInState(os.system, command),
        "among valid arrays": {**smpl_arrays(), "extra": shell},
        "in an object array": nested,
        "in a list": [[[shell]]],
        "as a key": {(1, shell): 2},
    }


def raw_pickles(command: str) -> dict[str, bytes]:
    """Pickles with opcodes that no pickler writes any more."""
    word = command.encode()
    return {
        "INST opcode": b"(S'" + word + b"'\nios\nsystem\n.",
        "OBJ opcode": b"(cos\nsystem\nS'" + word + b"'\no.",
        "stack global": b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c" + bytes([len(word)]) + word + b"\x85R.",
        "named as chumpy": b"cchumpy.ch\nCh\n0cos\nsystem\n(S'" + word + b"'\ntR.",
    }


def pickled(content: Any, protocol: int = 2) -> Payload:
    """A pickled body model, for the converter."""

    def write(folder: Path, command: str) -> Callable[[], Any]:
        path = folder / "model.pkl"
        path.write_bytes(content if isinstance(content, bytes) else pickle.dumps(content, protocol))
        return lambda: convert_body_model(path, folder / "model.npz")

    return write


def object_arrays(name: str, key: str) -> Payload:
    """A valid npz of one format, except for one array of objects."""

    def write(folder: Path, command: str) -> Callable[[], Any]:
        path = FORMATS[name].make(folder)
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
        np.savez(path, **(arrays | {key: np.array([CallWhenUnpickled(os.system, command)], dtype=object)}))
        return lambda: FORMATS[name].read(path)

    return write


def torch_files(pack: Callable[[Any, io.BytesIO], Any], key: str = "model") -> Payload:
    """A checkpoint named by its own hash."""

    def write(folder: Path, command: str) -> Callable[[], Any]:
        packed = io.BytesIO()
        pack({key: CallWhenUnpickled(os.system, command), "step": 1, "score": None}, packed)
        digest = hashlib.sha256(packed.getvalue()).hexdigest()
        (folder / f"step-00000001.{digest[:16]}.pt").write_bytes(packed.getvalue())
        return lambda: load_checkpoint(folder)

    return write


def shared_weights(folder: Path, command: str) -> Callable[[], Any]:
    """A pickle named as safetensors, with its valid hash beside it."""
    data = pickle.dumps(CallWhenUnpickled(os.system, command))
    (folder / "avatar.safetensors").write_bytes(data)
    (folder / "avatar.json").write_text(json.dumps({"sha256": hashlib.sha256(data).hexdigest()}))
    return lambda: read_weights(folder / "avatar")


def tagged_yaml(name: str, text: str, read: Callable[[Path], Any]) -> Payload:
    """YAML with a tag that constructs an object."""

    def write(folder: Path, command: str) -> Callable[[], Any]:
        (folder / name).write_text(text.replace("COMMAND", command))
        return lambda: read(folder)

    return write


def untrusted_config(name: str, text: str, *arguments: str) -> Payload:
    """An untrusted folder of configuration, for the real command line."""

    def write(folder: Path, command: str) -> Callable[[], Any]:
        path = folder / "conf" / name
        path.parent.mkdir(parents=True)
        path.write_text(text.replace("COMMAND", command))
        line = [sys.executable, str(TOOLS / "compare.py"), "--config-dir", str(folder / "conf"), *arguments]

        def load() -> None:
            done = subprocess.run(line, cwd=folder, capture_output=True, text=True, timeout=300)
            if done.returncode != 2:
                raise RuntimeError(f"exit code {done.returncode}: {done.stderr[-500:]}")
            raise AvatarError(done.stderr.strip())

        return load

    return write


def traversal_archive(name: str, read: Callable[[Path], Any]) -> Payload:
    """An npz whose members have paths outside the folder it would be unpacked to."""

    def write(folder: Path, command: str) -> Callable[[], Any]:
        path = folder / name
        with zipfile.ZipFile(path, "w") as archive:
            for member in (command.split()[-1], "../canary", "../../canary"):  # of `touch <canary>`
                archive.writestr(member, b"x")
        return lambda: read(path)

    return write


def external_buffer(folder: Path, command: str) -> Callable[[], Any]:
    """A GLB whose buffer is another file."""
    document = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": 36, "uri": "file:///etc/passwd"}]}
    document |= {"bufferViews": [{"buffer": 0, "byteLength": 36}], "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    document |= {"accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}]}
    document |= {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    header = b"glTF" + np.array([2, 20 + len(text), len(text)], "<u4").tobytes() + b"JSON"
    (folder / "mesh.glb").write_bytes(header + text)
    return lambda: read_mesh(folder / "mesh.glb")


def corpus(command: str) -> dict[str, Payload]:
    """Payloads by name; ``command`` is what they try to run."""
    callback = "hydra:\n  callbacks:\n    a:\n      _target_: posix.system\n      command: COMMAND\n"
    handler = "hydra:\n  job_logging:\n    version: 1\n    handlers:\n      a: {'()': os.system, command: COMMAND}\n"
    launcher = "hydra:\n  launcher:\n    _target_: hydra._internal.core_plugins.basic_launcher.BasicLauncher\n"
    launcher += "    extra: {_target_: os.system, command: COMMAND}\n"
    search = "hydra:\n  searchpath: ['file:///tmp']\n"
    top = "# @package _global_\n"
    leak = top + "table: ${oc.env:HOME}\n"
    code = ["!!python/object/apply:os.system ['COMMAND']", "!!python/object/new:os.system ['COMMAND']"]
    code += ["!!python/name:os.system ''", "a: !!python/module:os ''"]
    files: dict[str, Payload] = {
        f"pickle, {name}": pickled(content) for name, content in malicious_objects(command).items()
    }
    files |= {f"pickle, {name}": pickled(data) for name, data in raw_pickles(command).items()}
    return files | {
        "npz, body model": object_arrays("SMPL npz", "weights"),
        "npz, template": object_arrays("body npz", "vertices"),
        "npz, motion": object_arrays("motion npz", "poses"),
        "npz, frame": object_arrays("frame npz", "cloth_low"),
        "npz, canonical scan": object_arrays("canonical scan npz", "points"),
        "checkpoint, model": torch_files(torch.save),
        "checkpoint, optimiser": torch_files(torch.save, "optimiser"),
        "checkpoint, old format": torch_files(lambda v, f: torch.save(v, f, _use_new_zipfile_serialization=False)),
        "checkpoint, bare pickle": torch_files(pickle.dump),
        "weights, a pickle": shared_weights,
        "yaml, run": tagged_yaml("config.yaml", code[0], load_avatar),
        "yaml, outfit": tagged_yaml("outfit.yaml", code[1], open_outfit_folder),
        "yaml, outfit by name": tagged_yaml("outfit.yaml", code[2], open_outfit_folder),
        "yaml, run's module": tagged_yaml("config.yaml", code[3], load_avatar),
        "config, callback": untrusted_config("evil.yaml", top + callback, "+evil@_global_=null"),
        "config, log handler": untrusted_config("x/evil.yaml", top + handler, "+x=evil"),
        "config, launcher": untrusted_config("x/evil.yaml", top + launcher, "+x=evil"),
        "config, search path": untrusted_config("x/evil.yaml", top + search, "+x=evil"),
        "config, package": untrusted_config("x/evil.yaml", "# @package hydra\nverbose: true\n", "+x=evil"),
        "config, environment": untrusted_config("x/evil.yaml", leak, "+x=evil"),
        "archive, path traversal": traversal_archive("motion.npz", read_motion),
        "mesh, external buffer": external_buffer,
    }


def payload_trial(root: Path) -> list[Finding]:
    """Loads every payload by its reader, each in a process of its own, and looks for its canary file."""
    folder = root / "payloads"
    shutil.rmtree(folder, ignore_errors=True)
    names = list(corpus("true"))
    executed = refused = 0
    for number, name in enumerate(names):
        here, canary = folder / str(number), folder / str(number) / "canary"
        here.mkdir(parents=True)
        load = corpus(f"touch {canary}")[name](here, f"touch {canary}")
        outcome = run_worker(load)
        executed += canary.exists() or (folder / "canary").exists() or (root / "canary").exists()
        refused += bool(outcome.error)
    return [
        none_of("payloads", "payloads that ran or wrote elsewhere", executed, len(names)),
        all_of("payloads", "refused with one typed error", refused, len(names)),
    ]
