"""Makes a body of any shape with anny, for tools/simulate.py shapes=[...]; each parameter lies in [0, 1].

python tools/make_body.py data/bodies/tall.npz --height 0.9 --weight 0.7
"""

import argparse
import sys
from dataclasses import fields
from pathlib import Path

from avatar.body.anny import Phenotype, anny_body
from avatar.body.packed import write_body
from avatar.checks import AvatarError

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", type=Path, help="the .npz to write")
    for parameter in fields(Phenotype):
        parser.add_argument(f"--{parameter.name}", type=float, default=parameter.default)
    options = vars(parser.parse_args())
    target = options.pop("target")
    try:
        body = anny_body(Phenotype(**options))
        write_body(target, body)
    except AvatarError as error:
        sys.exit(f"make_body: {error}")
    height = float(body.template.vertices[:, 1].max() - body.template.vertices[:, 1].min())
    print(f"{target}: {len(body.template.vertices):,} vertices, {height:.2f} m tall")
