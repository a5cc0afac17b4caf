"""Units of length, and those in which a height may be a person's."""

from __future__ import annotations

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}  # one of each unit
PERSON = (0.5, 2.5)  # metres: heights of people
USUAL = 1.7  # metres


def possible_units(height: float) -> tuple[str, ...]:
    """Units in which a person of 0.5 to 2.5 m is so tall, the likelier first; none for other heights.

    From 50 to 98.4 both inches (of an adult) and centimetres (of a child) are possible.
    """
    low, high = PERSON
    found = [unit for unit, metres in METRES.items() if low <= height * metres <= high]
    return tuple(sorted(found, key=lambda unit: abs(height * METRES[unit] - USUAL)))


def guess_unit(height: float) -> str | None:
    """The likeliest unit of a person's height: m, cm, mm or in; None for no person's."""
    return next(iter(possible_units(height)), None)
