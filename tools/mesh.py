"""Meshes predictions: python tools/mesh.py run=<run folder>"""

from avatar.config import command
from avatar.pipeline.surfaces import mesh

if __name__ == "__main__":
    command("mesh", mesh)
