"""Trains an avatar: python tools/train.py outfit=dress method=closet size=small"""

from avatar.config import command
from avatar.training.runs import train_run

if __name__ == "__main__":
    command("train", train_run)
