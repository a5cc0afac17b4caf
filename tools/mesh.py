"""Meshes predictions: python tools/mesh.py run=<run folder>"""

from start import run

if __name__ == "__main__":
    run("mesh")
