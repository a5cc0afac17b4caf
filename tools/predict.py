"""Predicts posed point clouds: python tools/predict.py run=<run folder>"""

from avatar.config import command
from avatar.pipeline.scores import predict

if __name__ == "__main__":
    command("predict", predict)
