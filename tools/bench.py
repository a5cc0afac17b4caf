"""Measures speed and memory: python tools/bench.py 'only=[chamfer,step]' repeats=5"""

from start import run

if __name__ == "__main__":
    run("bench", "benchmarks:BENCH")
