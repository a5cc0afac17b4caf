"""Command lines as they are printed: how packages are installed, an environment is activated and verbs are run here.

The standard library alone, for what it prints is needed most where nothing else is installed.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from avatar.verbs import typed_words

DISTRIBUTION = "clothed-avatar"  # on a package index; `avatar` belongs to somebody else there
STOPPED = os.EX_TEMPFAIL  # exit code 75: stopped by a signal, nothing is wrong, the same command goes on
PIPE_CLOSED = 128 + 13  # as a shell reports a process that SIGPIPE ended: the reader of the output has left
PACKAGE = Path(__file__).resolve().parent
CORE = ("torch", "numpy", "scipy", "trimesh", "roma", "hydra", "tqdm", "safetensors", "matplotlib", "skimage")
EXTRAS = {"open3d": "mesh", "pyvista": "pictures", "pygltflib": "export", "pxr": "export", "tensorboard": "log"}
EXTRAS |= {"newton": "simulate", "warp": "simulate", "anny": "anny", "pyacvd": "mesh", "hydra_plugins": "cluster"}
EXTRAS |= {"xatlas": "export"}
# Where a distribution is named otherwise than what is imported
DISTRIBUTIONS = {"hydra": "hydra-core", "skimage": "scikit-image", "pxr": "usd-core", "warp": "warp-lang"}
DISTRIBUTIONS |= {"open3d": "open3d-cpu"}
SYSTEM_LIBRARIES = {  # Debian's packages with the libraries that a package loads
    "open3d": "libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0",
    "pyvista": "libgl1 libegl1",
}
PLAIN = re.compile(r"(?!(?:null|true|false|nan|inf)$)(?:[a-z_/]|\.{1,2}/)[\w./-]*", re.ASCII | re.IGNORECASE)


def checkout() -> Path | None:
    """The folder of the source checkout that this program runs from; None where it was installed from a wheel."""
    root = PACKAGE.parent
    return root if (root / "setup.cfg").is_file() and (root / "tools").is_dir() else None


CONF = (checkout() or PACKAGE) / "conf"  # a wheel has it in the package


def install_line(package: str) -> str:
    """The shell command that installs an imported package for this interpreter, with what goes with it.

    In a checkout it installs the extra that the package belongs to. From a wheel it names the extra's own
    requirements, as the distribution's metadata lists them: they are on the index whether or not this program is.
    """
    root, extra, name = checkout(), EXTRAS.get(package, ""), DISTRIBUTIONS.get(package, package)
    if root and (extra or package in CORE):
        wanted = ["-e", f"{root}[{extra}]" if extra else str(root)]
    else:
        listed = requirements(extra)
        wanted = listed if extra else [line for line in listed if re.match(rf"{re.escape(name)}\b", line)]
    line = shlex.join([interpreter(), "-m", "pip", "install", *(wanted or [name])])
    libraries = SYSTEM_LIBRARIES.get(package)
    return line + (f" and, on Debian or Ubuntu, apt-get install -y {libraries}" if libraries else "")


def requirements(extra: str = "") -> list[str]:
    """What the installed distribution requires for one of its extras, or for none of them; empty if not installed."""
    from importlib.metadata import PackageNotFoundError, requires  # slow to import, and rarely needed

    try:
        lines = requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        return []
    marker = re.compile(r"""\s*(?:;|\band\b)\s*extra\s*==\s*["']([\w-]+)["']""")
    found = [(marker.search(line), line) for line in lines]
    return [marker.sub("", line) for match, line in found if (match[1] if match else "") == extra]


def interpreter() -> str:
    """This interpreter as it is typed: ``python`` where that is the one, else its path."""
    here, found = Path(sys.executable), shutil.which("python")
    if found and Path(found).absolute() == here.absolute():
        return "python"
    return shorten(here)


def shorten(path: Path) -> str:
    """A path as it is typed from the current folder: relative below it, absolute elsewhere."""
    try:  # links are not followed: the interpreter of a virtual environment is one
        return str(path.absolute().relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)


def command_line(verb: str, *arguments: str) -> str:
    """The shell command that runs a verb from the current folder with this interpreter."""
    root = checkout()
    first, *rest = typed_words(verb)
    start = [shorten(root / "tools" / f"{first}.py")] if root else ["-m", "avatar", first]
    return shlex.join([interpreter(), *start, *rest, *arguments])


def activation_line() -> str:
    """The shell command after which ``python`` has all that is needed: the checkout's environment, or its set-up."""
    root = checkout()
    if root is None:
        return ""
    activate = f". {shlex.quote(shorten(root / '.venv/bin/activate'))}"
    if (root / ".venv" / "bin" / "python").exists():
        return activate
    set_up = ["make", "setup"] if Path.cwd() == root else ["make", "-C", str(root), "setup"]
    return f"{shlex.join(set_up)} && {activate}"


def quote(text: str) -> str:
    """A text as one value for Hydra, in quotes unless it is read as it is without them."""
    if PLAIN.fullmatch(text):
        return text
    text = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)  # no interpolation
    mark = "'" if '"' in text and "'" not in text else '"'
    return mark + re.sub(rf"(\\*)({mark}|\Z)", lambda m: m[1] * 2 + (f"\\{mark}" if m[2] else ""), text) + mark


def option(name: str, value: str | Path | Iterable[str | Path]) -> str:
    """An option and its value as one argument of a command line, which is read back as it is."""
    single = isinstance(value, (str, Path))
    return f"{name}={quote(str(value))}" if single else f"{name}=[{','.join(quote(str(item)) for item in value)}]"


def expand(text: str) -> str:
    """A path with the home folder in the place of its ``~``, which shells leave as it is after ``=``."""
    with suppress(RuntimeError):  # of a user that there is not: a name that begins so
        return str(Path(text).expanduser()) if text.startswith("~") else text
    return text
