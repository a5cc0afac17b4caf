"""Predicts posed point clouds: python tools/predict.py run=<run folder>"""

from start import run

if __name__ == "__main__":
    run("predict")
