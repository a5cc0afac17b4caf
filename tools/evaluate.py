"""Scores predictions beside their floors: python tools/evaluate.py runs=[<run folder>]"""

from avatar.config import command
from avatar.pipeline.scores import evaluate

if __name__ == "__main__":
    command("evaluate", evaluate)
