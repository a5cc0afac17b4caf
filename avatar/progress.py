"""Progress of loops, a bar on a terminal and logged lines elsewhere; and a count of what this process has done."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Self, TypeVar

from tqdm import tqdm

Item = TypeVar("Item")
LINE_S = 10.0  # seconds between lines of a loop that does not say when to print one
WORK: Counter[str] = Counter()  # of this process: `step`s trained, pieces `made` and those `found` finished already
report = logging.getLogger(__name__)


@dataclass
class Progress:
    """A loop of ``total`` pieces of work that a budget may end before; a context manager."""

    what: str
    total: int
    unit: str = "frame"
    done: int = 0  # pieces finished earlier
    budget: float | None = None  # seconds of work after which it ends as well
    spent: float = 0.0  # seconds of it that were spent earlier
    silent: bool = False  # for processes other than the main one
    clock: Callable[[], float] = time.monotonic  # whose seconds the budget counts

    def __post_init__(self):
        self.before, self.values, self.logged_count = self.done, "", -1
        self.started, self.logged = self.clock(), time.monotonic()
        watched = not self.silent and sys.stderr.isatty()
        self.bar = tqdm(total=self.total, initial=self.done, desc=self.what, unit=self.unit) if watched else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Ends the bar, or says how far it came."""
        if self.bar is not None:
            self.bar.close()
        else:
            self.say()

    @property
    def seconds(self) -> float:
        """Seconds since it began."""
        return self.clock() - self.started

    def seconds_left(self) -> float:
        """Seconds until all is done or the budget is spent, whichever comes first; infinite while nothing is known."""
        new = self.done - self.before
        by_work = self.seconds / new * (self.total - self.done) if new else math.inf
        by_clock = self.budget - self.spent - self.seconds if self.budget is not None else math.inf
        return max(0.0, min(by_work, by_clock))

    def advance(self) -> None:
        """One more piece is done."""
        self.done += 1
        WORK["step"] += self.unit == "step"
        if self.bar is not None:
            left = self.seconds_left()
            pace = (self.done - self.before) / max(self.seconds, 1e-9)
            if self.budget is not None and math.isfinite(left):  # the end that the bar's own estimate leads to
                self.bar.total = min(self.total, self.done + max(1, round(left * pace)))
            self.bar.update()
        elif time.monotonic() - self.logged > LINE_S:
            self.say()

    def show(self, **values: str) -> None:
        """Values beside the bar, or a line with them."""
        self.values = "".join(f", {name} {value}" for name, value in values.items())
        if self.bar is not None:
            self.bar.set_postfix_str(self.values.removeprefix(", "))
        else:
            self.say()

    def say(self) -> None:
        """A line, unless it would say the same again."""
        if self.silent or self.logged_count == self.done:
            return
        self.logged, self.logged_count = time.monotonic(), self.done
        left = self.seconds_left() if self.done < self.total else 0.0
        ahead = f", {in_words(left)} left" if 0 < left < math.inf else ""
        clock = in_words(self.spent + self.seconds)
        report.info("%s: %s %d of %d%s, %s%s", self.what, self.unit, self.done, self.total, self.values, clock, ahead)


def tracked(
    items: Iterable[Item], what: str, unit: str = "frame", total: int | None = None, silent: bool = False
) -> Iterator[Item]:
    """The items, each done when the next one is asked for, under a `Progress`; ``total`` where they have no length."""
    with Progress(what, len(items) if total is None else total, unit, silent=silent) as progress:
        for item in items:
            yield item
            progress.advance()


def in_words(seconds: float) -> str:
    """A time for people: ``35 s``, ``12 min 5 s``, ``3 h 20 min``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    parts = [(hours, "h"), (minutes, "min"), (rest if not hours else 0, "s")]
    return " ".join(f"{count} {unit}" for count, unit in parts if count) or "0 s"
