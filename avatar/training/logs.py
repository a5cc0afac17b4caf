"""Training logs: ``metrics.csv`` of a run, and TensorBoard."""

from __future__ import annotations

import csv
import io
from contextlib import suppress
from pathlib import Path

from avatar.checks import AvatarError, DataError, require
from avatar.io.npz import write_whole


class TrainingLog:
    """Rows of ``metrics.csv``, and of TensorBoard where it is installed: split, step, epoch, seconds and every term."""

    def __init__(self, folder: Path, columns: list[str], from_step: int):
        """Begins the log of a run, or drops rows past the step a resumed run starts from; `DataError` if it cannot."""
        self.path = folder / "metrics.csv"
        self.columns = ["split", "step", "epoch", "seconds", *columns]
        kept = [row for row in read_log(self.path) if int(row["step"]) <= from_step] if self.path.is_file() else []
        header = dict(zip(self.columns, self.columns))
        write_whole(self.path, self.as_text(header, *kept).encode())
        self.board = None
        with suppress(AvatarError):
            require("tensorboard")
            self.board = require("torch.utils.tensorboard").SummaryWriter(folder / "tensorboard")

    def as_text(self, *rows: dict[str, str]) -> str:
        """Rows as lines of the file."""
        text = io.StringIO(newline="")
        csv.DictWriter(text, self.columns, restval="", extrasaction="ignore").writerows(rows)
        return text.getvalue()

    def write(self, split: str, step: int, epoch: int, seconds: float, values: dict[str, float]) -> None:
        """Writes one row, of values there are. Raises `DataError` when the disk refuses."""
        if not values:
            return
        row = {"split": split, "step": step, "epoch": epoch, "seconds": f"{seconds:.2f}"}
        try:
            with self.path.open("a", newline="") as file:
                file.write(self.as_text(row | {name: f"{value:.6g}" for name, value in values.items()}))
        except OSError as error:
            hint = "Free disk space and give the same command again."
            raise DataError(self.path, f"could not be written ({error.strerror}).", hint) from error
        for name, value in values.items() if self.board else ():
            self.board.add_scalar(f"{split}/{name}", value, step)


def read_log(path: Path) -> list[dict[str, str]]:
    """The whole rows of a training log; what a killed run left half-written is passed over."""
    text = path.read_text(errors="replace")
    rows = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1], newline=""))
    return [row for row in rows if str(row.get("step")).isdigit() and None not in (*row, *row.values())]
