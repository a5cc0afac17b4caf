"""Makes the open dataset: python tools/simulate.py preset=quick"""

from avatar.config import command
from avatar.simulate.recording import simulate

if __name__ == "__main__":
    command("simulate", simulate)
