"""Its place puts this folder on the path, so that tests import the slow truths as ``reference``."""

import gc
import os
import shutil
from collections import Counter

import pretended
import pytest
from smpl_person import BETAS, person_model, write_model, write_person
from tiny import write_tiny_outfit

from avatar.body.smpl import convert_body_model
from avatar.data.layouts import OpenOutfit
from avatar.data.scanner import ScanConfig
from avatar.io import ledger

ON_PRETENDED = "AVATAR_PRETENDED" in os.environ  # set by tests/test_pretended.py
if ON_PRETENDED:
    pretended.install()  # before any backward pass: torch counts its devices once, at the first
CHROMIUM_FLAGS = (
    "--no-sandbox --disable-gpu --disable-background-networking --disable-component-update --disable-sync "
    "--disable-quic --no-first-run"
)


gc.disable()  # until all tests are collected: looking for garbage among modules is a tenth of the tests' time


def pytest_collection_finish():
    """What is imported by now is not looked at for garbage again."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items):
    """Tests on the pretended accelerator run in a process of their own, and nothing else runs there.

    With a device, torch keeps threads for backward passes, and a forked process (the reliability tests fork) may then
    run none.
    """
    items[:] = [item for item in items if bool(item.get_closest_marker("pretended")) == ON_PRETENDED]
    if "PYTEST_XDIST_WORKER" in os.environ:  # long files first, so that all workers end at the same time
        slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
        items.sort(key=lambda item: -slow[item.path])  # documented commands before all others


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory):
    """The folder of the tiny outfit (`tiny.write_tiny_outfit`); read only."""
    return write_tiny_outfit(tmp_path_factory.mktemp("data") / "open" / "tiny")


@pytest.fixture(scope="session")
def tiny_outfit(tiny_folder):
    """The tiny outfit, 4,000 scan points a frame: 6 train and 3 test frames of cloth that follows from the pose."""
    return OpenOutfit(tiny_folder, "open", ScanConfig(points=4000))


@pytest.fixture(scope="session")
def person():
    """The arrays of someone else's SMPL file (`smpl_person`); read only."""
    return person_model()


@pytest.fixture(scope="session")
def person_folder(person, tmp_path_factory):
    """A packed outfit of that person, the converted file in it and named in ``outfit.yaml``; read only."""
    folder = tmp_path_factory.mktemp("mine") / "coat"
    convert_body_model(write_model(folder.parent / "SMPL.pkl", person), folder / "template.npz")
    return write_person(folder, person, f"body: {{path: template.npz, betas: {list(BETAS)}}}")


@pytest.fixture(scope="session")
def browser():
    """A headless Chromium, the one of the system."""
    from playwright.sync_api import sync_playwright

    executable = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if executable is None:
        pytest.fail("Chromium is needed to see reports as readers do. Run: apt-get install -y chromium")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=executable, args=CHROMIUM_FLAGS.split())
        yield chromium
        chromium.close()


@pytest.fixture
def change_source(monkeypatch):
    """Lets the ledger take the code of a module for another version of it, for the length of a test."""

    def change(module: str) -> None:
        monkeypatch.setitem(ledger.SOURCES, module, ledger.SOURCES[module] + b"\nCHANGED = True\n")
        forget()

    def forget() -> None:
        ledger.source_digest.cache_clear()
        ledger.module_digest.cache_clear()

    yield change
    monkeypatch.undo()
    forget()
