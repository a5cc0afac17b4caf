"""Its place puts this folder on the path, so that tests import the slow truths as ``reference``."""

import pytest
from tiny import write_tiny_outfit

from avatar.data.open_layout import OpenOutfit
from avatar.data.scanner import ScanConfig


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory):
    """The folder of the tiny outfit (`tiny.write_tiny_outfit`); read only."""
    return write_tiny_outfit(tmp_path_factory.mktemp("data") / "open" / "tiny")


@pytest.fixture(scope="session")
def tiny_outfit(tiny_folder):
    """The tiny outfit, 4,000 scan points a frame: 6 train and 3 test frames of cloth that follows from the pose."""
    return OpenOutfit(tiny_folder, "open", ScanConfig(points=4000))
