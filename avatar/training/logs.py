"""The training log: one CSV row a logged step with every named term, and TensorBoard where it is installed."""

from __future__ import annotations

import csv
from pathlib import Path

from avatar.checks import AvatarError, require


class TrainingLog:
    """Appends rows to ``metrics.csv``; columns are fixed by the first row, so a resumed run goes on in its file.

    Rows hold ``split`` (train or validation), ``step``, ``epoch``, ``seconds`` and one column for every term.
    """

    def __init__(self, folder: Path, columns: list[str], from_step: int, tensorboard: bool = True):
        """Opens the log of a run and drops rows past the step a resumed run starts from."""
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / "metrics.csv"
        self.columns = ["split", "step", "epoch", "seconds", *columns]
        kept = [row for row in read_log(self.path) if int(row["step"]) <= from_step] if self.path.is_file() else []
        self.file = self.path.open("w", newline="")
        self.writer = csv.DictWriter(self.file, self.columns, restval="", extrasaction="ignore")
        self.writer.writeheader()
        self.writer.writerows(kept)
        self.board = None
        if tensorboard:
            try:
                require("tensorboard")
            except AvatarError:
                return
            self.board = require("torch.utils.tensorboard").SummaryWriter(folder / "tensorboard")

    def write(self, split: str, step: int, epoch: int, seconds: float, values: dict[str, float]) -> None:
        """Writes one row and flushes it."""
        row = {"split": split, "step": step, "epoch": epoch, "seconds": f"{seconds:.2f}"}
        self.writer.writerow(row | {name: f"{value:.6g}" for name, value in values.items()})
        self.file.flush()
        if self.board:
            for name, value in values.items():
                self.board.add_scalar(f"{split}/{name}", value, step)

    def close(self) -> None:
        """Closes the file and the board."""
        self.file.close()
        if self.board:
            self.board.close()


def read_log(path: Path) -> list[dict[str, str]]:
    """The rows of a training log."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
