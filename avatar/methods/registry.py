"""Registry of the methods by name: every `Method` with a name in the files of this folder."""

from __future__ import annotations

import importlib
import inspect
import pkgutil

from avatar import methods
from avatar.checks import unknown_name
from avatar.methods.base import Method

METHODS: dict[str, Method] = {}  # in the order of their files
for found in pkgutil.iter_modules(methods.__path__, f"{methods.__name__}."):
    for kind in vars(importlib.import_module(found.name)).values() if found.name != __name__ else ():
        if inspect.isclass(kind) and issubclass(kind, Method) and hasattr(kind, "name"):
            METHODS.setdefault(kind.name, kind())


def find_method(name: str) -> Method:
    """The method of a name. Raises `AvatarError` listing the methods there are."""
    if name not in METHODS:
        raise unknown_name("method", name, METHODS)
    return METHODS[name]
