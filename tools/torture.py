"""Kills, corrupts, poisons and races the program, and counts losses: python tools/torture.py 'only=[kill,flips]'"""

from start import run

if __name__ == "__main__":
    run("torture")
