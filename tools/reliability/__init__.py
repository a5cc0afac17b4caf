"""Reliability tests: killed, corrupted, NaN-injected and concurrent runs of the program, and counts of its failures."""

from pathlib import Path

from avatar.verbs import Verb

CHECK_RELIABILITY = Verb(
    "measures reliability under kills, corruption and concurrency",
    "reliability.trials:check_reliability",
    "reliability.trials:ReliabilityConfig",
    conf=Path(__file__).with_name("check_reliability.yaml"),
)
