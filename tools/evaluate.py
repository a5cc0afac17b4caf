"""Scores predictions beside their floors: python tools/evaluate.py 'runs=[<run folder>]'"""

from start import run

if __name__ == "__main__":
    run("evaluate")
