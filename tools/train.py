"""Trains an avatar: python tools/train.py outfit=dress method=closet size=small"""

from start import run

if __name__ == "__main__":
    run("train")
