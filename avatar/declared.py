"""Settings classes as their source declares them: fields, types, defaults and comments, without the rest of a module.

Importing a settings class imports the network or the solver that it configures, and torch, which takes seconds. Help,
composition and the reading of a command line need the fields alone: here the statements that define a class, and those
that they name, are executed alone. Functions and methods are left out, and with the latter the checks of ranges.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

from avatar.verbs import resolve

PACKAGE = Path(__file__).resolve().parent
COMMENTS: dict[type, dict[str, str]] = {}  # behind the fields of all classes made here


def declared(name: str) -> type:
    """The dataclass that ``module:Class`` names, with those in it; modules of this package are not imported for it."""
    module, _, attribute = name.partition(":")
    return source(module).find(attribute) if module.partition(".")[0] == PACKAGE.name else resolve(name)


def comments(kind: type) -> dict[str, str]:
    """What the comments behind the fields of a declared dataclass say; empty for a field without one."""
    known = {name: text for base in reversed(kind.__mro__) for name, text in COMMENTS.get(base, {}).items()}
    return {field.name: known.get(field.name, "") for field in fields(kind)}


def method_settings() -> dict[str, str]:
    """``module:Class`` of the settings of each method, by its name: the ``name`` and ``Settings`` of a class there."""
    found = {}
    for path in sorted((PACKAGE / "methods").glob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            parts = node.body if isinstance(node, ast.ClassDef) else []
            given = {name: part.value for part in parts for name in defined_names(part) if hasattr(part, "value")}
            if isinstance(given.get("name"), ast.Constant) and isinstance(given.get("Settings"), ast.Name):
                found[given["name"].value] = f"avatar.methods.{path.stem}:{given['Settings'].id}"
    return found


@cache
def source(module: str) -> Source:
    """The source of a module of this package."""
    path = PACKAGE.joinpath(*module.split(".")[1:])
    return Source(path / "__init__.py" if path.is_dir() else path.with_suffix(".py"))


class Source:
    """The top level of a module's source, whose names get their values one by one, when they are asked for."""

    def __init__(self, path: Path):
        text = path.read_text(encoding="utf-8")
        self.path, self.lines = str(path), text.encode().splitlines()
        self.statements = {name: node for node in ast.parse(text).body for name in defined_names(node)}
        self.values: dict[str, Any] = {"__name__": __name__, "__file__": self.path}

    def find(self, name: str) -> Any:
        """The value of a name of the module; that of a function is None."""
        if name not in self.values:
            self.define(name, self.statements[name])
        return self.values[name]

    def define(self, name: str, node: ast.stmt) -> None:
        """Executes the statement that defines a name, after those that it needs."""
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == PACKAGE.name:
            original = next(alias.name for alias in node.names if name in (alias.name, alias.asname))
            self.values[name] = source(node.module or "").find(original)
        elif isinstance(node, ast.FunctionDef):
            self.values[name] = None
        else:
            if isinstance(node, ast.ClassDef):
                node.body = [part for part in node.body if not isinstance(part, ast.FunctionDef)] or [ast.Pass()]
            elif isinstance(node, ast.AnnAssign):
                node = ast.Assign([node.target], node.value)
            for part in ast.walk(node):
                if isinstance(part, ast.Name) and part.id in self.statements and isinstance(part.ctx, ast.Load):
                    self.find(part.id)
            tree = ast.fix_missing_locations(ast.Module([node], []))
            exec(compile(tree, self.path, "exec", dont_inherit=True), self.values)
        if isinstance(node, ast.ClassDef):
            COMMENTS[self.values[name]] = dict(self.field_comments(node))

    def field_comments(self, node: ast.ClassDef) -> Iterator[tuple[str, str]]:
        """The fields of a class, each with the comment behind it."""
        for part in node.body:
            if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                rest = self.lines[(part.end_lineno or 0) - 1][part.end_col_offset :].decode()
                yield part.target.id, rest.strip().lstrip("# ")


def defined_names(node: ast.stmt) -> list[str]:
    """The names that a statement gives a value to."""
    if isinstance(node, (ast.Import, ast.ImportFrom)):
        return [alias.asname or alias.name.partition(".")[0] for alias in node.names]
    if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
