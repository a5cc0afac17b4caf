"""Values of options as text: paths and names that reach a verb as they were typed, whatever letters they have.

Hydra's lexer takes blanks, commas, brackets, quotes, ``$``, numbers and words like ``true`` for parts of its grammar.
So values of options that hold text are quoted before it sees them. The standard library alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

FileName = Annotated[str, "a name, or the path of a file"]
PLAIN = re.compile(r"(?!(?:null|true|false|nan|inf)$)(?:[a-z_/]|\.{1,2}/)[\w./-]*", re.ASCII | re.IGNORECASE)
QUOTED = re.compile(r"""'(?:\\'|[^'])*'|"(?:\\"|[^"])*\"""")
LISTS = re.compile(r"\[[^\[\]]*\](?:,\[[^\[\]]*\])+")  # several lists, one a job of a multirun


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
        if item is Path or item is FileName or item is str:
            found[f"{prefix}{name}"] = TextOption(item is not str, several, optional)
        elif is_dataclass(item):
            found |= text_options(item, f"{prefix}{name}.")
    return found


def quote(text: str) -> str:
    """A text as one value for Hydra, in quotes unless it is read as it is without them."""
    if PLAIN.fullmatch(text):
        return text
    text = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)  # no interpolation
    mark = "'" if '"' in text and "'" not in text else '"'
    return mark + re.sub(rf"(\\*)({mark}|\Z)", lambda m: m[1] * 2 + (f"\\{mark}" if m[2] else ""), text) + mark


def option(name: str, value: str | Path | Iterable[str | Path]) -> str:
    """An option and its value as a word of a command line, which is read back as it is."""
    single = isinstance(value, (str, Path))
    return f"{name}={quote(str(value))}" if single else f"{name}=[{','.join(quote(str(item)) for item in value)}]"


def tidy_option(word: str, options: dict[str, TextOption], sweeps: bool) -> str:
    """A word of the command line with its value in quotes where it needs them; other options stay as they are.

    What is in quotes already stays as well. A comma separates values (of a list, or of a multirun), but where the text
    around it is the path of something that exists.

    Args:
        word: ``NAME=VALUE``.
        options: those that hold text.
        sweeps: whether several values are several jobs.
    """
    name, _, value = word.partition("=")
    known = options.get(name.lstrip("+"))
    if known is None or not value:
        return word
    if known.several and not (known.path and exists(value)):
        lists = re.findall(r"\[[^\[\]]*\]", value) if sweeps and LISTS.fullmatch(value) else [value]
        if all(text[0] == "[" and text[-1] == "]" for text in lists):
            return f"{name}={','.join(f'[{tidy_values(split_values(text[1:-1], known), known)}]' for text in lists)}"
    values = split_values(value, known)
    apart = known.several or sweeps or all(exists(part) or QUOTED.fullmatch(part) for part in values)
    if known.path and (exists(value) or not apart):
        values = [value]
    return f"{name}={tidy_values(values, known)}"


def tidy_values(values: Iterable[str], known: TextOption) -> str:
    """Values of an option that holds text, with commas between them and in quotes where they need them."""
    return ",".join(tidy_value(value, known) for value in values)


def tidy_value(text: str, known: TextOption) -> str:
    """One value of an option that holds text; the home folder takes the place of a path's ``~``."""
    if known.path and exists(text):
        return quote(expand(text))
    if not text or QUOTED.fullmatch(text) or (known.optional and text.lower() == "null"):
        return text
    if known.path:
        return quote(expand(text))
    return quote(text) if re.fullmatch(r"[\w.+-]+", text) else text


def split_values(text: str, known: TextOption) -> list[str]:
    """The values between commas, but for commas in quotes and in the longest paths of things that exist."""
    pieces, values = text.split(","), []
    while pieces:
        whole = {count: ",".join(pieces[:count]).strip() for count in range(len(pieces), 0, -1)}
        ends = (n for n, value in whole.items() if QUOTED.fullmatch(value) or (known.path and exists(value)))
        count = next(ends, 1)
        values.append(whole[count])
        del pieces[:count]
    return values


def exists(text: str) -> bool:
    """Whether a text is the path of something that exists, the home folder's ``~`` included."""
    with suppress(OSError, ValueError):  # too long for a name, or with a null byte
        return bool(text) and Path(expand(text)).exists()
    return False


def expand(text: str) -> str:
    """A path with the home folder in the place of its ``~``, which shells leave as it is after ``=``."""
    with suppress(RuntimeError):  # of a user that there is not: a name that begins so
        return str(Path(text).expanduser()) if text.startswith("~") else text
    return text
