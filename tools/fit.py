"""Fits an unseen outfit from one scan: python tools/fit.py run=<run folder of several outfits> outfit=<new outfit>"""

from avatar.config import command
from avatar.training.fitting import fit_outfit

if __name__ == "__main__":
    command("fit", fit_outfit)
