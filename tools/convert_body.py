"""Converts a downloaded SMPL, SMPL-H or SMPL-X file (.npz or .pkl) to a plain .npz, running nothing that is in it.

python tools/convert_body.py SMPLX_NEUTRAL.npz data/bodies/smplx_neutral.npz
python tools/convert_body.py SMPL_NEUTRAL.pkl data/bodies/smpl_neutral.npz --uv smpl_uv.obj
python tools/convert_body.py data/theirs/coat/template.npz with_uv.npz --uv body.obj
"""

from start import run

if __name__ == "__main__":
    run("convert_body")
