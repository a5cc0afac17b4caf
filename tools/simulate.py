"""Makes the open dataset: python tools/simulate.py preset=quick"""

from start import run

if __name__ == "__main__":
    run("simulate")
