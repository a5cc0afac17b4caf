"""What this machine has, what it lacks and the command that installs it, and how it is used well."""

from __future__ import annotations

import ctypes
import importlib.metadata
import logging
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import avatar
from avatar.invocation import CORE, DISTRIBUTIONS, install_line

if TYPE_CHECKING:
    import torch

FIRST_PROCESS = os.getpid()  # that this module was imported in; any other is a fork of it
report = logging.getLogger(__name__)

APT_PACKAGES = {"libusb-1.0": "libusb-1.0-0", "libGL.so": "libgl1", "libEGL.so": "libegl1", "libX11.so": "libx11-6"}
APT_PACKAGES |= {"libudev.so": "libudev1", "libidn2.so": "libidn2-0", "libgomp.so": "libgomp1"}
APT_PACKAGES |= {"libXrender.so": "libxrender1"}
OPTIONAL = {"open3d": "meshing", "pyvista": "pictures", "pygltflib": "rigged GLB export", "pxr": "USD export"}
OPTIONAL |= {"tensorboard": "training curves in TensorBoard", "newton": "simulating new outfits"}
OPTIONAL |= {"anny": "bodies of other shapes", "pyacvd": "clothed templates", "xatlas": "textures"}


@dataclass(frozen=True)
class Finding:
    """One thing looked at: ``name``, whether it is there, what was seen, and what to run when it is not."""

    name: str
    present: bool
    seen: str
    hint: str = ""
    needed: bool = True


def inspect_machine() -> list[Finding]:
    """Looks at Python, packages, system libraries and accelerators; imports each package in its own process."""
    browser, hint = shutil.which("chromium") or shutil.which("google-chrome"), "apt-get install -y chromium"
    return [
        Finding("python", sys.version_info >= (3, 11), platform.python_version(), "install Python 3.11 or newer"),
        *(inspect_package(name, "core", needed=True) for name in CORE),
        *(inspect_package(name, use, needed=False) for name, use in OPTIONAL.items()),
        Finding("chromium", bool(browser), browser or "not found", hint, needed=False),
    ]


def inspect_package(name: str, use: str, needed: bool) -> Finding:
    """Imports a package in a fresh process, so that a crash or a missing shared library is only a finding."""
    quick = f"import gc; gc.disable(); import {name}; gc.freeze()"  # torch in three fifths of the time
    probe = [sys.executable, "-c", quick]
    result = subprocess.run(probe, capture_output=True, text=True, timeout=120)
    if result.returncode:
        last = (result.stderr.strip().splitlines() or [f"the process died with code {result.returncode}"])[-1]
        return Finding(f"{name} ({use})", False, last, install_hint(name, last), needed)
    try:
        version = importlib.metadata.version(DISTRIBUTIONS.get(name, name))
    except importlib.metadata.PackageNotFoundError:
        version = "installed"
    return Finding(f"{name} ({use})", True, version, needed=needed)


def install_hint(package: str, message: str) -> str:
    """The command that repairs a failed import: a system library's package when one is named, else pip."""
    library = re.search(r"(lib[\w.+-]+\.so[\w.]*)", message)
    for stem, apt in APT_PACKAGES.items():
        if library and library.group(1).startswith(stem):
            return f"apt-get install -y {apt}"
    return install_line(package)


def accelerator_type() -> str:
    """The kind of device that torch trains on where nothing else is asked for: CUDA where there is one."""
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def choose_device(name: str) -> torch.device:
    """The device of a name, ``auto`` for `accelerator_type`; raises `AvatarError` for one that there is not."""
    import torch

    from avatar.checks import AvatarError

    name = accelerator_type() if name == "auto" else name
    try:
        return torch.zeros(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise AvatarError(f"device: expected auto, cpu or a CUDA device there is, got {name!r} ({reason}).") from error


@contextmanager
def prepared_process() -> Iterator[None]:
    """Prepares the process for work on the CPU, as a ``with`` block or as the decorator of every function that does it.

    Freed memory is kept from then on. Numbers below 1e-38 count as zero, in this thread and in the OpenMP threads that
    work for it, for the length of the block: processors are slow with such numbers, and the steep softplus of a signed
    distance is full of them (docs/performance.md). Afterwards the caller's arithmetic is as it was. Blocks may be
    nested. How idle threads wait is read when torch is imported, and a warning says when that was too early.
    """
    warn_once_of_early_torch()
    keep_freed_memory()
    before = sys.float_info.min / 2 == 0  # whether this thread takes such numbers for zero already
    flush_denormals(True)
    try:
        yield
    finally:
        if not before:
            flush_denormals(False)


def flush_denormals(on: bool) -> None:
    """Has this thread, and the OpenMP threads that work for it, take such numbers for zero, or count them in full.

    New threads take over this processor setting from the one that starts them, so OpenMP's idle threads are ended. A
    forked process has none of its parent's threads and must not wait for them.
    """
    import torch

    torch.set_flush_denormal(on)
    end = getattr(ctypes.CDLL(torch._C.__file__), "omp_pause_resource_all", None) if sys.platform == "linux" else None
    if end is not None and os.getpid() == FIRST_PROCESS:
        end(1)  # omp_pause_soft


@cache
def warn_once_of_early_torch() -> None:
    """Says that torch was imported before this package, which could then not choose how its idle threads wait."""
    if avatar.TOO_LATE:
        report.warning(
            "torch was imported before avatar, so its idle threads spin, which is slow where processes share cores. "
            "Hint: import avatar first, or start Python with OMP_WAIT_POLICY=PASSIVE GOMP_SPINCOUNT=10000."
        )


def keep_freed_memory() -> bool:
    """Has the C library keep what is freed for what is asked for next; says whether it could be set so.

    By default it gives arrays above 32 MiB back to the system at once, and every new one costs a page fault for each
    4 KiB: a third of a full-size decoder's time on the CPU. The price is a quarter more memory at the peak of a
    full-size training step, for pieces do not always fit.
    """
    most_maps, trim_above = -4, -1  # M_MMAP_MAX and M_TRIM_THRESHOLD of glibc's malloc.h
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    return mallopt is not None and bool(mallopt(most_maps, 0) and mallopt(trim_above, 2**31 - 1))
