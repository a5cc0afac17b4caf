"""Converts a downloaded SMPL, SMPL-H or SMPL-X file (.npz or .pkl) to a plain .npz, running nothing that is in it.

python tools/convert_body.py SMPLX_NEUTRAL.npz data/bodies/smplx_neutral.npz
python tools/convert_body.py SMPL_NEUTRAL.pkl data/bodies/smpl_neutral.npz --uv smpl_uv.obj
python tools/convert_body.py data/mine/coat/template.npz with_uv.npz --uv body.obj
"""

import argparse
import sys
from pathlib import Path

from avatar.body.convert import convert_body_model
from avatar.checks import AvatarError

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="the downloaded model, .npz or .pkl")
    parser.add_argument("target", type=Path, help="the .npz to write")
    parser.add_argument("--uv", type=Path, help="an OBJ of the same mesh whose texture coordinates POP is to use")
    paths = parser.parse_args()
    try:
        kind = convert_body_model(paths.source, paths.target, paths.uv)
    except AvatarError as error:
        sys.exit(f"convert_body: {error}")
    print(f"{paths.target}: {kind} body, {paths.target.stat().st_size / 1e6:.1f} MB")
    print(f"Name it in the outfit.yaml of packed data (docs/data.md), as body: {{path: {paths.target.resolve()}}}")
