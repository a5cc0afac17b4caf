"""Runs all jobs of a table and makes it: python tools/experiment.py experiment=closet5"""

from avatar.config import command
from avatar.pipeline.experiments import experiment, tabulate_experiment

if __name__ == "__main__":
    command("experiment", experiment, tabulate_experiment)
