"""Says how fast it is: python tools/bench.py only=[chamfer,step] repeats=5"""

from avatar.config import command
from avatar.pipeline.benchmarks.bench import bench

if __name__ == "__main__":
    command("bench", bench)
