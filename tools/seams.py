"""Measures predictions at the seams of the UV atlas: python tools/seams.py runs=[<run of pop>,<run of closet>]"""

from avatar.config import command
from avatar.pipeline.seams import seams

if __name__ == "__main__":
    command("seams", seams)
