"""Measures predictions at the seams of the UV atlas: python tools/seams.py 'runs=[<run of pop>,<run of closet>]'"""

from start import run

if __name__ == "__main__":
    run("seams")
