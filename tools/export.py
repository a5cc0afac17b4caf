"""Writes animation files of a predicted motion: python tools/export.py run=<run folder> predictions=walk"""

from avatar.config import command
from avatar.pipeline.surfaces import export

if __name__ == "__main__":
    command("export", export)
