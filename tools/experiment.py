"""Runs all jobs of a table and makes it: python tools/experiment.py experiment=closet5"""

from start import run

if __name__ == "__main__":
    run("experiment")
