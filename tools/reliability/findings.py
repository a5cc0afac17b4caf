"""Findings of the trials: values and goals, as tidy rows and as the table of docs/reliability.md."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from avatar.evaluation.scores import Score


@dataclass(frozen=True)
class Finding:
    """A value measured by a trial over ``cases`` cases, and its goal: from ``low`` to ``high``, None where open."""

    trial: str
    what: str
    value: float
    unit: str
    cases: int
    low: float | None = None
    high: float | None = None

    @property
    def met(self) -> bool:
        """Whether the goal is met."""
        low, high = -math.inf if self.low is None else self.low, math.inf if self.high is None else self.high
        return low <= self.value <= high

    @property
    def goal(self) -> str:
        """The goal in words."""
        if self.low == self.high:
            return "" if self.low is None else f"{self.low:g}"
        return f"at most {self.high:g}" if self.low is None else f"at least {self.low:g}"


def all_of(trial: str, what: str, count: int, cases: int) -> Finding:
    """A count whose goal is all cases."""
    return Finding(trial, what, count, f"of {cases}", cases, cases, cases)


def none_of(trial: str, what: str, count: int, cases: int) -> Finding:
    """A count whose goal is zero."""
    return Finding(trial, what, count, f"of {cases}", cases, 0, 0)


def to_score(finding: Finding, seed: int, seconds: float, commit: str) -> Score:
    """A finding as a row of reliability.csv; ``method`` is the trial, ``frames`` its cases."""
    return Score(
        table="reliability",
        outfit="",
        method=finding.trial,
        variant="",
        metric=finding.what,
        value=finding.value,
        unit=finding.unit,
        frames=finding.cases,
        seed=seed,
        steps=0,
        seconds=round(seconds, 1),
        points=0,
        commit=commit,
    )


def to_table(findings: Sequence[Finding]) -> str:
    """The findings as Markdown, missed goals in bold."""
    lines = ["| trial | figure | found | goal |", "|---|---|---:|---:|"]
    for finding in findings:
        found = f"{finding.value:g} {finding.unit}"
        lines.append(
            f"| `{finding.trial}` | {finding.what} | {found if finding.met else f'**{found}**'} | {finding.goal} |"
        )
    return "\n".join(lines) + "\n"
