"""Makes a body of any shape with anny, for tools/simulate.py 'shapes=[...]'; each parameter lies in [0, 1].

python tools/make_body.py data/bodies/tall.npz --height 0.9 --weight 0.7
"""

from start import run

if __name__ == "__main__":
    run("make_body")
