"""Writes one of the open dataset's motions as a file for tools/predict.py motion=...

python tools/make_motion.py walk walk.npz
python tools/make_motion.py dance data/motions/dance.npz --seconds 10 --fps 60
"""

from start import run

if __name__ == "__main__":
    run("make_motion")
