"""Benchmarks of speed and memory: the main job beside reference implementations and other libraries."""

from pathlib import Path

from avatar.verbs import Verb

BENCH = Verb(
    "measures speed and memory",
    "benchmarks.bench:bench",
    "benchmarks.bench:BenchConfig",
    conf=Path(__file__).with_name("bench.yaml"),
)
