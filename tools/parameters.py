"""Counts every method's parameters at both sizes: writes docs/results/parameters.csv and .md."""

from start import run

if __name__ == "__main__":
    run("parameters")
