"""Kills, corrupts, poisons and races the program and counts what it lost: python tools/torture.py only=[kill,flips]"""

from avatar.config import command
from avatar.pipeline.torture.trials import torture

if __name__ == "__main__":
    command("torture", torture)
