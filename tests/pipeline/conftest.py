"""A miniature run for all tests of verbs that need one."""

from pathlib import Path

import pytest

from reliability.small_jobs import prepare, train_job


@pytest.fixture(scope="session")
def run(tmp_path_factory) -> Path:
    """The folder of a trained CloSET run on frames bend.00010 and bend.00111 of the embedded tee (test split)."""
    root = tmp_path_factory.mktemp("miniature")
    prepare(root)
    return train_job("closet", root)
