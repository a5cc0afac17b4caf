"""The main job on the embedded sample: python tools/demo.py"""

from avatar.config import command
from avatar.pipeline.demo import demo

if __name__ == "__main__":
    command("demo", demo)
