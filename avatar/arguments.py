"""Command lines as they are read: texts in quotes, refusals with the nearest name there is, and the help of verbs.

Hydra's lexer takes blanks, commas, brackets, quotes, ``$``, numbers and words like ``true`` for parts of its grammar;
values of options that hold text are therefore quoted before it sees them. What an option means is said by the comment
behind its field in the settings class, by `SHARED` where it means the same in several verbs, and by the first sentence
of the file where it chooses one.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, is_dataclass
from enum import EnumType
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ValueType
from hydra.errors import HydraException, MissingConfigException
from omegaconf import OmegaConf

from avatar.checks import AvatarError, DataError, did_you_mean, sentences, unknown_name
from avatar.declared import comments, declared, method_settings
from avatar.invocation import CONF, command_line, expand, install_line, quote
from avatar.io.documents import check_events, read_yaml
from avatar.settings import FileName
from avatar.verbs import OPTIONS, SHARED, Verb

FOLLOWING = ("method_size", "encoder")  # groups whose files follow from the method and the size
PLUGINS = ("joblib", "submitit_slurm", "submitit_local")  # launchers of the extra `cluster`
QUOTED = re.compile(r"""'(?:\\'|[^'])*'|"(?:\\"|[^"])*\"""")
LISTS = re.compile(r"\[[^\[\]]*\](?:,\[[^\[\]]*\])+")  # several lists, one a job of a multirun
WIDE = 44  # letters
OVERRIDING = """\
Options are written NAME=VALUE, without dashes: train.minutes=30. Lists: 'outfit=[tee,dress]'. None: null.
-m (--multirun) before the options runs a job for each value of outfit=tee,dress.
--cfg job prints the options as a command line sets them; --help after options shows them with what they choose.
Paths may have any letters. A comma separates values, but in the path of something that exists. What is in quotes of its
own inside the shell's, 'run="a,b"', is taken as it is.
"""


@dataclass(frozen=True)
class TextOption:
    """An option that holds text: a ``path`` or a name, ``several`` in a list, ``optional`` if null stands for none."""

    path: bool = True
    several: bool = False
    optional: bool = False


def text_options(kind: type, prefix: str = "") -> dict[str, TextOption]:
    """The options of a settings class that hold text, by their full names; those in dictionaries are not among them."""
    found: dict[str, TextOption] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        inner = [part for part in get_args(hint) if part is not type(None)]
        optional = type(None) in get_args(hint)
        hint = inner[0] if optional else hint
        several = get_origin(hint) in (tuple, list)
        item = get_args(hint)[0] if several else hint
        if item in (Path, FileName, str):
            found[f"{prefix}{name}"] = TextOption(item is not str, several, optional)
        elif is_dataclass(item):
            found |= text_options(item, f"{prefix}{name}.")
    return found


def tidy_arguments(arguments: list[str], texts: Mapping[str, TextOption], sweeps: bool = False) -> list[str]:
    """Arguments as Hydra takes them: flags first, lists that a shell split at a blank joined again, texts in quotes.

    ``texts`` are the verb's options that hold text; ``sweeps`` says whether it is a multirun without being asked for
    one. Raises `AvatarError` for unknown flags and words that are no option, with the form to write instead.
    """

    def refuse(message: str) -> None:
        raise AvatarError(message[:1].lower() + message[1:] + ".")

    parser = get_args_parser()
    parser.error = refuse
    known, unknown = parser.parse_known_intermixed_args(arguments)
    if unknown:
        flag, _, value = unknown[0].partition("=")
        after = arguments[arguments.index(unknown[0]) + 1 :][:1]
        value = value or (after[0] if after and after[0] in known.overrides else "...")
        raise AvatarError(f"{unknown[0]}: no such flag. Options are written without dashes: {flag.lstrip('-')}={value}")
    if known.resolve and not known.cfg:
        raise AvatarError("--resolve: goes with --cfg, as in --cfg job --resolve.")
    if sum(map(bool, (known.run, known.multirun, known.cfg, known.shell_completion, known.info))) > 1:
        raise AvatarError("expected one of --run, --multirun, --cfg, --info and --shell-completion.")
    flags = list(arguments)
    for word in known.overrides:
        flags.remove(word)
    several = known.multirun or sweeps
    options = [tidy_option(word, texts, several) for word in _joined(known.overrides, texts)]
    for option in options:
        _check_option(option, several)
    return [*flags, *options]


def _joined(words: list[str], texts: Mapping[str, TextOption]) -> Iterator[str]:
    """Options, each with the words after it up to the bracket that closes its list.

    A path may have brackets of its own: its list ends with a bracket before the next option at the latest.
    """
    waiting: list[str] = []
    for word, following in zip(words, [*words[1:], "="]):
        waiting.append(word)
        text = " ".join(waiting)
        name, _, value = text.partition("=")
        known = texts.get(name.lstrip("+"), TextOption(path=False))
        bare = QUOTED.sub("", value)
        closed = bare.count("[") <= bare.count("]") and bare.count("{") <= bare.count("}")
        ended = not known.several or value[:1] != "[" or (value[-1] == "]" and "=" in following)
        if closed or (known.path and ended):
            yield text
            waiting = []
    if waiting:
        raise AvatarError(f"{waiting[0]}: a list without its end. Write it in quotes, as in 'runs=[a,b]'.")


def tidy_option(word: str, options: Mapping[str, TextOption], sweeps: bool) -> str:
    """A word ``NAME=VALUE`` with its value in quotes where an option that holds text needs them.

    What is in quotes already stays. A comma separates values (of a list or, with ``sweeps``, of a multirun), but where
    the text around it is the path of something that exists.
    """
    name, _, value = word.partition("=")
    known = options.get(name.lstrip("+"))
    if known is None or not value:
        return word
    if known.several and not (known.path and _exists(value)):
        lists = re.findall(r"\[[^\[\]]*\]", value) if sweeps and LISTS.fullmatch(value) else [value]
        if all(text[0] == "[" and text[-1] == "]" for text in lists):
            return f"{name}={','.join(f'[{_tidy_values(_split_values(text[1:-1], known), known)}]' for text in lists)}"
    values = _split_values(value, known)
    apart = known.several or sweeps or all(_exists(part) or QUOTED.fullmatch(part) for part in values)
    if known.path and (_exists(value) or not apart):
        values = [value]
    return f"{name}={_tidy_values(values, known)}"


def _tidy_values(values: Iterable[str], known: TextOption) -> str:
    """Values of an option that holds text, with commas between them and in quotes where they need them."""
    tidied = []
    for text in values:
        as_it_is = not text or QUOTED.fullmatch(text) or (known.optional and text.lower() == "null")
        if known.path and (_exists(text) or not as_it_is):
            tidied.append(quote(expand(text)))
        else:
            tidied.append(text if as_it_is or not re.fullmatch(r"[\w.+-]+", text) else quote(text))
    return ",".join(tidied)


def _split_values(text: str, known: TextOption) -> list[str]:
    """The values between commas, but for commas in quotes and in the longest paths of things that exist."""
    pieces, values = text.split(","), []
    while pieces:
        whole = {count: ",".join(pieces[:count]).strip() for count in range(len(pieces), 0, -1)}
        ends = (n for n, value in whole.items() if QUOTED.fullmatch(value) or (known.path and _exists(value)))
        count = next(ends, 1)
        values.append(whole[count])
        del pieces[:count]
    return values


def _exists(text: str) -> bool:
    """Whether a text is the path of something that exists, the home folder's ``~`` included."""
    with suppress(OSError, ValueError):  # too long for a name, or with a null byte
        return bool(text) and Path(expand(text)).exists()
    return False


def _check_option(option: str, several: bool) -> None:
    """Refuses a word that cannot be read as an option, or as one of several values outside a multirun."""
    name, equal, value = option.partition("=")
    try:
        override = OverridesParser.create().parse_override(option)
    except HydraException as error:
        if not equal:
            raise AvatarError(f"{option}: expected an option, written NAME=VALUE.") from error
        form = shlex.quote(f'{name}="{value}"')
        raise AvatarError(f"{option}: expected NAME=VALUE. Write a value with special letters as {form}.") from error
    if override.value_type is ValueType.SIMPLE_CHOICE_SWEEP and not several and option.count("hydra.") == 0:
        listed = shlex.quote(f"{name}=[{value}]")
        raise AvatarError(f"{option}: for a list write {listed}; for one job each put -m before the options.")


def refuse_code(arguments: list[str]) -> None:
    """Refuses command lines by which a file could become code; what is typed on them is trusted, files are not.

    Hydra makes objects of what its own options name (callbacks, launchers, log handlers). A folder of configuration
    from elsewhere (``--config-dir``) may therefore set options of verbs and nothing of Hydra's, nor read the
    environment, and the two options by which Hydra looks in further places are not taken. Raises `AvatarError` naming
    the option; `DataError` naming the file and the word in it.
    """
    for argument in arguments:
        if argument.lstrip("+~").startswith("hydra.searchpath") or argument.startswith("--experimental-rerun"):
            raise AvatarError(f"{argument.partition('=')[0]}: not taken here; use --config-dir with a folder of YAML.")
    parser = argparse.ArgumentParser(add_help=False, exit_on_error=False)
    for names in (("--config-dir", "-cd"), ("--config-path", "-cp")):
        parser.add_argument(*names, dest="folders", action="append", default=[], type=Path)
    for folder in parser.parse_known_args(arguments)[0].folders:
        for path in sorted(folder.rglob("*.y*ml")):
            read_yaml(path)
            text = path.read_text(encoding="utf-8")
            headers = [line for line in text.splitlines() if "@package" in line]
            for word in (*check_events(path, text), *headers, str(path.relative_to(folder))):
                if any(sign in word for sign in ("hydra", "_target_", "()")) or re.search(r"\$\{[^}]*:", word):
                    hint = "Options of verbs are all that a configuration from elsewhere may set."
                    raise DataError(path, f"{word!r:.100} could run code or read the environment: not read.", hint)


def known_options(verb: str, overrides: list[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """A verb's options as a command line sets them, nested, and the files it chooses by their groups.

    Raises `HydraException` for a command line that cannot be composed.
    """
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        config = hydra.compose(verb, overrides, return_hydra_config=True)
    chosen = {str(name): choice for name, choice in config.hydra.runtime.choices.items()}
    choices = {name: choice for name, choice in chosen.items() if name.partition("/")[0] not in ("hydra", *FOLLOWING)}
    plain: Any = OmegaConf.to_container(config, resolve=False)
    return {name: value for name, value in plain.items() if name != "hydra"}, choices


def explain(error: Exception, verb: str, arguments: list[str]) -> str:
    """What is wrong with a verb's command line in one sentence, from Hydra's or OmegaConf's error."""
    text = str(error).partition("\n")[0]
    if isinstance(error, MissingConfigException) and "/" in (error.missing_cfg_file or ""):
        group, _, choice = error.missing_cfg_file.rpartition("/")
        if choice in PLUGINS:
            return f"{group}: {choice} is not installed. Run: {install_line('hydra_plugins')}"
        choices = error.options or sorted(path.stem for path in (CONF / group).glob("*.yaml"))
        known = [name for name in choices if not name.endswith("_defaults")]
        return str(unknown_name(group, choice, known)) if known else f"{group}: no option {choice!r}."
    named = re.match(r"Could not (?:override|delete from config\.) '([^']+)'", text)
    if not named:
        return f"{error.full_key}: {text}" if getattr(error, "full_key", None) else text
    name = named[1].partition("@")[0]
    groups = [str(path.relative_to(CONF)) for path in CONF.glob("*/")]
    chosen = [word for word in arguments if word.partition("=")[0] in groups and not name.startswith(word)]
    try:
        options, choices = known_options(verb, chosen)
    except HydraException:
        options, choices = known_options(verb, [])
    options = dict.fromkeys(group for group in choices if "@" not in group) | options
    dotted = [option for option, _ in _dotted(options)]
    leaf = [other for other in dotted if other.rpartition(".")[2] == name]
    hint = f"Did you mean {leaf[0]!r}?" if leaf else did_you_mean(name, dotted)
    beside: Any = options
    for part in name.split(".")[:-1]:
        beside = beside[part] if isinstance(beside, dict) and isinstance(beside.get(part), dict) else options
    return sentences(f"{name}: no such option.", hint, f"There are: {', '.join(beside)}.")


def _dotted(options: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every option's full name and value, those that hold others included."""
    for name, value in options.items():
        yield f"{prefix}{name}", value
        if isinstance(value, dict):
            yield from _dotted(value, f"{prefix}{name}.")


def help_text(name: str, verb: Verb, overrides: list[str]) -> str:
    """What ``--help`` prints for a verb whose defaults are registered: the options that matter, files, all options."""
    options, choices = known_options(name, overrides)
    known = meanings(declared(verb.settings), options)
    main = [(option, *main_option(option, options, choices, known)) for option in OPTIONS.get(name, "").split()]
    lines = [f"usage: {command_line(name)} [OPTION=VALUE ...]", f"{verb.does[0].upper()}{verb.does[1:]}."]
    lines += ["", *_columns([(f"{option}={value}", meaning) for option, value, meaning in main])] if main else []
    lines += ["", "Files to choose from:"] if choices else []
    for group in choices:
        paths = sorted((CONF / group.partition("@")[0]).glob("*.yaml"))
        lines += [f"  {group}=", *(f"  {line}" for line in _columns([(path.stem, _about(path)) for path in paths]))]
    lines += ["", "All options:"]
    for option, value in _dotted(options):
        line = f"{'  ' * (option.count('.') + 1)}{option.rpartition('.')[2]}:"
        line += "" if isinstance(value, dict) and value else f" {_written(value)}"
        lines.append(line + (f"  # {known[option]}" if known.get(option) else ""))
    return "\n".join([*lines, "", OVERRIDING])


def main_option(name: str, options: dict[str, Any], choices: dict[str, str], known: dict[str, str]) -> tuple[str, str]:
    """The value and the meaning of an option, or of the choice of a file."""
    if name in choices:
        path = CONF / name.partition("@")[0] / f"{choices[name]}.yaml"
        return choices[name], _about(path) if path.is_file() else ""
    return _written(dict(_dotted(options))[name]), known[name]


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


def _about(path: Path) -> str:
    """The first sentence of a configuration file's comment, which may begin with the command that takes the file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    said = [line.lstrip("# ") for line in lines if line.startswith("# ") and not line.startswith(("# @", "# python"))]
    return re.split(r"\.(?:\s|$)", " ".join(said), maxsplit=1)[0]


def _columns(rows: list[tuple[str, str]]) -> list[str]:
    """Lines of two columns; what is wide stands out."""
    width = max((len(left) for left, _ in rows if len(left) <= WIDE), default=0)
    return [f"  {left:{width}}  {right}".rstrip() for left, right in rows]


def _written(value: Any) -> str:
    """A value as it is written on a command line."""
    if isinstance(value, list):
        return f"[{','.join(map(_written, value))}]"
    return {"None": "null", "True": "true", "False": "false"}.get(str(value), str(value))
