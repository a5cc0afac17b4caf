"""Benchmarks: speed and memory beside reference implementations and other libraries; errors of fitted bodies."""

from pathlib import Path

from avatar.verbs import Verb

BENCH = Verb(
    "measures speed and memory",
    "benchmarks.bench:bench",
    "benchmarks.bench:BenchConfig",
    conf=Path(__file__).with_name("bench.yaml"),
)
FIT_BODIES = Verb(
    "measures bodies fitted to scans against the true ones",
    "benchmarks.fitting:fit_bodies",
    "FitBodiesConfig",
    conf=Path(__file__).with_name("fit_bodies.yaml"),
)
