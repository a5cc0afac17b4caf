"""The help of verbs with settings: the options that matter, the files to choose from, all options, and how to set them.

What an option means is said by the comment behind its field in the settings class, by `SHARED` where it means the same
in several verbs, and by the first sentence of the file where it chooses one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import is_dataclass
from enum import EnumType
from pathlib import Path
from typing import Any, get_args, get_type_hints

from avatar.arguments import known_options
from avatar.declared import comments, declared, method_settings
from avatar.invocation import command_line
from avatar.verbs import SHARED, Verb

WIDE = 44  # letters
OVERRIDING = """\
Options are written NAME=VALUE, without dashes: train.minutes=30. Lists: 'outfit=[tee,dress]'. None: null.
-m (--multirun) before the options runs a job for each value of outfit=tee,dress.
--cfg job prints the options as a command line sets them; --help after options shows them with what they choose.
Paths may have any letters. A comma separates values, but in the path of something that exists. What is in quotes of its
own inside the shell's, 'run="a,b"', is taken as it is.
"""


def help_text(name: str, verb: Verb, overrides: list[str], conf: Path) -> str:
    """What ``--help`` prints for a verb, with the values that its command line chooses.

    Args:
        name: the verb's name.
        verb: the verb, whose defaults are registered.
        overrides: the options beside ``--help``.
        conf: the folder of configurations.
    """
    options, choices = known_options(name, overrides, conf)
    known = meanings(declared(verb.settings), options)
    main = [(option, *main_option(option, options, choices, known, conf)) for option in verb.options.split()]
    files = []
    for group in choices:
        paths = sorted((conf / group.partition("@")[0]).glob("*.yaml"))
        files += [f"  {group}=", *(f"  {line}" for line in columns([(path.stem, description(path)) for path in paths]))]
    return "\n".join(
        [
            f"usage: {command_line(name)} [OPTION=VALUE ...]",
            f"{verb.does[0].upper()}{verb.does[1:]}.",
            *(["", *columns([(f"{option}={value}", meaning) for option, value, meaning in main])] if main else []),
            *(["", "Files to choose from:", *files] if files else []),
            "",
            "All options:",
            *tree(options, known),
            "",
            OVERRIDING,
        ]
    )


def main_option(
    name: str, options: dict[str, Any], choices: dict[str, str], known: dict[str, str], conf: Path
) -> tuple[str, str]:
    """The value and the meaning of an option, or of the choice of a file."""
    if name in choices:
        path = conf / name.partition("@")[0] / f"{choices[name]}.yaml"
        return choices[name], description(path) if path.is_file() else ""
    value: Any = options
    for part in name.split("."):
        value = value[part]
    return written(value), known[name]


def meanings(kind: type, options: dict[str, Any], prefix: str = "") -> dict[str, str]:
    """What each option of a settings class means, by its full name; those of the chosen method are among them."""
    hints, own, found = get_type_hints(kind), comments(kind), {}
    for name, value in options.items():
        parts = (hints.get(name), *get_args(hints.get(name)))
        hint = next(filter(is_dataclass, parts), None)
        if name == "settings" and (settings := method_settings().get(options.get("name", ""))):
            hint = declared(settings)
        summary = (hint.__doc__ or "").partition("\n")[0] if hint else ""
        shared = "" if prefix else SHARED.get(name)
        values = ", ".join(str(member.value) for kind in parts if isinstance(kind, EnumType) for member in kind)
        found[f"{prefix}{name}"] = "; ".join(filter(None, [own.get(name) or summary or shared, values]))
        if hint and isinstance(value, dict):
            found |= meanings(hint, value, f"{prefix}{name}.")
    return found


def description(path: Path) -> str:
    """The first sentence of a configuration file's comment, which may begin with the command that takes the file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    said = [line.lstrip("# ") for line in lines if line.startswith("# ") and not line.startswith(("# @", "# python"))]
    return re.split(r"\.(?:\s|$)", " ".join(said), maxsplit=1)[0]


def columns(rows: list[tuple[str, str]]) -> list[str]:
    """Lines of two columns; what is wide stands out."""
    width = max((len(left) for left, _ in rows if len(left) <= WIDE), default=0)
    return [f"  {left:{width}}  {right}".rstrip() for left, right in rows]


def tree(options: dict[str, Any], known: dict[str, str], prefix: str = "") -> Iterator[str]:
    """Nested options as YAML, each with its meaning behind it."""
    indent = "  " * (prefix.count(".") + 1)
    for name, value in options.items():
        meaning = known.get(f"{prefix}{name}", "")
        nested = isinstance(value, dict) and bool(value)
        line = f"{indent}{name}:" + ("" if nested else f" {written(value)}")
        yield line + (f"  # {meaning}" if meaning else "")
        if nested:
            yield from tree(value, known, f"{prefix}{name}.")


def written(value: Any) -> str:
    """A value as it is written on a command line."""
    if isinstance(value, list):
        return f"[{','.join(map(written, value))}]"
    return {"None": "null", "True": "true", "False": "false"}.get(str(value), str(value))
