"""The main job on the embedded sample: python tools/demo.py"""

from start import run

if __name__ == "__main__":
    run("demo")
