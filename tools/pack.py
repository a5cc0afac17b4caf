"""Writes an outfit of any layout as packed frames, which the programs of the POP line read as well (docs/data.md).

python tools/pack.py data/open/tee data/packed/tee
"""

from start import run

if __name__ == "__main__":
    run("pack")
