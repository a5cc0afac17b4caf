"""Writes one of the open dataset's motions as a file for tools/predict.py motion=...

python tools/make_motion.py walk walk.npz
python tools/make_motion.py dance data/motions/dance.npz --seconds 10 --fps 60
"""

import argparse
import sys
from pathlib import Path

from avatar.checks import AvatarError
from avatar.io.motions import write_motion
from avatar.simulate.sequences import authored_motion

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", help="walk, squat, twist, reach, kick, bend or dance")
    parser.add_argument("target", type=Path, help="the .npz to write")
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--fps", type=float, default=30.0)
    options = parser.parse_args()
    try:
        motion = authored_motion(options.name, options.fps, options.seconds)
        write_motion(options.target, motion)
    except AvatarError as error:
        sys.exit(f"make_motion: {error}")
    print(f"{options.target}: {len(motion.poses)} frames, {options.fps:g} a second")
