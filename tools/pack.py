"""Writes an outfit of any layout as packed frames, which the programs of the POP line read as well (docs/data.md).

python tools/pack.py data/open/tee data/packed/tee
python tools/pack.py avatar/assets/sample/dress data/packed/dress
"""

import argparse
import sys
from pathlib import Path

from avatar.checks import AvatarError
from avatar.data.layouts import open_outfit_folder
from avatar.data.packed_layout import write_packed_outfit

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="the outfit's folder")
    parser.add_argument("target", type=Path, help="the folder to write")
    paths = parser.parse_args()
    try:
        packed = write_packed_outfit(open_outfit_folder(paths.source), paths.target)
    except AvatarError as error:
        sys.exit(f"pack: {error}")
    count = sum(len(packed.frames(split)) for split in ("train", "test") if packed.has_frames(split))
    print(
        f"{paths.target}: {count} frames. Train on them: python tools/train.py dataset={paths.target.parent.name} "
        f"outfit={paths.target.name} data_root={paths.target.parent.parent}"
    )
