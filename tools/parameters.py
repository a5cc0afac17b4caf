"""Counts every method's parameters at both sizes: python tools/parameters.py [out=docs/results]"""

from start import run

if __name__ == "__main__":
    run("parameters")
