"""Measures bodies fitted to scans against the true ones: python tools/fit_bodies.py 'outfits=[tee,dress]' frames=4"""

from start import run

if __name__ == "__main__":
    run("fit_bodies", "benchmarks:FIT_BODIES")
