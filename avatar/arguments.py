"""Command lines: the forms that shells and habits give them, code they may not bring along, and their errors."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ValueType
from hydra.errors import HydraException, MissingConfigException
from omegaconf import OmegaConf

from avatar.checks import AvatarError, DataError, did_you_mean, sentences, unknown_name
from avatar.invocation import install_line
from avatar.io.documents import check_events, read_yaml
from avatar.values import QUOTED, TextOption, tidy_option

FOLLOWING = ("method_size", "encoder")  # groups whose files follow from the method and the size
PLUGINS = ("joblib", "submitit_slurm", "submitit_local")  # launchers of the extra `cluster`


def tidy_arguments(
    arguments: list[str], sweeps: bool = False, texts: Mapping[str, TextOption] = MappingProxyType({})
) -> list[str]:
    """Arguments as Hydra takes them: flags first, lists that a shell split at a blank joined again, texts in quotes.

    Args:
        arguments: those of the command line.
        sweeps: whether the verb is a multirun without being asked for one.
        texts: the verb's options that hold text.

    Raises:
        AvatarError: for flags there are not and words that are no option, with the form to write instead.
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


def _check_option(option: str, several: bool) -> None:
    """Refuses a word that cannot be read as an option, or as one of several values outside a multirun."""
    try:
        override = OverridesParser.create().parse_override(option)
    except HydraException as error:
        name, equal, value = option.partition("=")
        if not equal:
            raise AvatarError(f"{option}: expected an option, written NAME=VALUE.") from error
        form = shlex.quote(f'{name}="{value}"')
        raise AvatarError(f"{option}: expected NAME=VALUE. Write a value with special letters as {form}.") from error
    if override.value_type is ValueType.SIMPLE_CHOICE_SWEEP and not several and option.count("hydra.") == 0:
        name, _, value = option.partition("=")
        listed = shlex.quote(f"{name}=[{value}]")
        raise AvatarError(f"{option}: for a list write {listed}; for one job each put -m before the options.")


def explain(error: Exception, verb: str, arguments: list[str], conf: Path) -> str:
    """What is wrong with a command line in one sentence, with the nearest name there is.

    Args:
        error: Hydra's or OmegaConf's.
        verb: whose command line it is.
        arguments: the command line's.
        conf: the folder of configurations.
    """
    text = str(error).partition("\n")[0]
    if isinstance(error, MissingConfigException) and "/" in (error.missing_cfg_file or ""):
        group, _, choice = error.missing_cfg_file.rpartition("/")
        if choice in PLUGINS:
            return f"{group}: {choice} is not installed. Run: {install_line('hydra_plugins')}"
        choices = error.options or sorted(path.stem for path in (conf / group).glob("*.yaml"))
        known = [name for name in choices if not name.endswith("_defaults")]
        return str(unknown_name(group, choice, known)) if known else f"{group}: no option {choice!r}."
    named = re.match(r"Could not (?:override|delete from config\.) '([^']+)'", text)
    if named:
        name = named[1].partition("@")[0]
        groups = [str(path.relative_to(conf)) for path in conf.glob("*/")]
        chosen = [word for word in arguments if word.partition("=")[0] in groups and not name.startswith(word)]
        try:
            options, choices = known_options(verb, chosen, conf)
        except HydraException:
            options, choices = known_options(verb, [], conf)
        return unknown_option(name, dict.fromkeys(group for group in choices if "@" not in group) | options)
    return f"{error.full_key}: {text}" if getattr(error, "full_key", None) else text


def known_options(verb: str, overrides: list[str], conf: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """A verb's options as a command line sets them, nested, and the files it chooses by their groups.

    Raises:
        HydraException: for a command line that cannot be composed.
    """
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(conf), version_base="1.3"):
        config = hydra.compose(verb, overrides, return_hydra_config=True)
    chosen = {str(name): choice for name, choice in config.hydra.runtime.choices.items()}
    choices = {name: choice for name, choice in chosen.items() if name.partition("/")[0] not in ("hydra", *FOLLOWING)}
    plain: Any = OmegaConf.to_container(config, resolve=False)
    return {name: value for name, value in plain.items() if name != "hydra"}, choices


def unknown_option(name: str, options: dict[str, Any]) -> str:
    """The sentence on an option that there is not: the nearest one by its name, or the options beside it."""
    dotted = list(_dotted(options))
    leaf = [other for other in dotted if other.rpartition(".")[2] == name]
    hint = f"Did you mean {leaf[0]!r}?" if leaf else did_you_mean(name, dotted)
    beside: Any = options
    for part in name.split(".")[:-1]:
        beside = beside[part] if isinstance(beside, dict) and isinstance(beside.get(part), dict) else options
    return sentences(f"{name}: no such option.", hint, f"There are: {', '.join(beside)}.")


def _dotted(options: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Every option's full name, those that hold others included."""
    for name, value in options.items():
        yield f"{prefix}{name}"
        if isinstance(value, dict):
            yield from _dotted(value, f"{prefix}{name}.")


def refuse_code(arguments: list[str]) -> None:
    """Refuses command lines by which a file could become code; what is typed on them is trusted, files are not.

    Hydra makes objects of what its own options name (callbacks, launchers, log handlers). A folder of configuration
    from elsewhere (``--config-dir``) may therefore set options of verbs and nothing of Hydra's, nor read the
    environment, and the two options by which Hydra looks in further places are not taken.

    Raises:
        AvatarError: naming the option.
        DataError: naming the file and the word in it.
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
