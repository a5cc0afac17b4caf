"""Bakes scans' colours onto a run's mesh as a texture: python tools/texture.py run=<coloured run>"""

from start import run

if __name__ == "__main__":
    run("texture")
