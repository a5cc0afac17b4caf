"""Trains an avatar: python tools/train.py outfit=dress method=closet size=small"""

from avatar.config import command
from avatar.pipeline.methods import train

if __name__ == "__main__":
    command("train", train)
