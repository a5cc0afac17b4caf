"""Counts every method's parameters at both sizes: python tools/parameters.py [out=docs/results]"""

from avatar.body.open import open_body
from avatar.config import CONF, command, compose_settings
from avatar.pipeline.parameters import ParametersConfig, write_parameters


def parameters(config: ParametersConfig) -> None:
    """Writes ``<out>/parameters.csv`` and ``parameters.md``, and prints the latter."""
    methods = sorted(path.stem for path in (CONF / "method").glob("*.yaml"))
    choices = {
        (method, size): compose_settings("train", f"method={method}", f"size={size}").method
        for size in ("full", "small")
        for method in methods
    }
    text = write_parameters(config.out, choices, open_body("female").template)
    print(f"{text}\nwritten: {config.out / 'parameters'}.*")


if __name__ == "__main__":
    command("parameters", parameters)
