"""Writes animation files of a predicted motion: python tools/export.py run=<run folder> predictions=walk"""

from start import run

if __name__ == "__main__":
    run("export")
