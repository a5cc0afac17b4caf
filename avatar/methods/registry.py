"""Registry of the methods by name."""

from __future__ import annotations

from avatar.checks import unknown_name
from avatar.methods.base import Method
from avatar.methods.closet import Closet
from avatar.methods.pop import Pop
from avatar.methods.scale import Scale
from avatar.methods.scanimate import Scanimate

METHODS: dict[str, Method] = {method.name: method for method in (Closet(), Pop(), Scale(), Scanimate())}
SETTINGS = {name: method.Settings for name, method in METHODS.items()}


def find_method(name: str) -> Method:
    """The method of a name.

    Raises:
        AvatarError: listing the methods there are.
    """
    if name not in METHODS:
        raise unknown_name("method", name, METHODS)
    return METHODS[name]
