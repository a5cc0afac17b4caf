"""Counts every method's parameters at both sizes: writes docs/results/parameters.csv and .md."""

from pathlib import Path

from avatar.body.open import open_body
from avatar.config import CONF, compose_settings
from avatar.pipeline.parameters import write_parameters

if __name__ == "__main__":
    methods = sorted(path.stem for path in (CONF / "method").glob("*.yaml"))
    choices = {
        (method, size): compose_settings("train", f"method={method}", f"size={size}").method
        for size in ("full", "small")
        for method in methods
    }
    print(write_parameters(Path("docs/results"), choices, open_body("female").template))
