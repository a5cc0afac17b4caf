"""Fits an unseen outfit from one scan: python tools/fit.py run=<run folder of several outfits> outfit=<new outfit>"""

from start import run

if __name__ == "__main__":
    run("fit")
