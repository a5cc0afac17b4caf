"""The training log: one CSV row a logged step with every named term, and TensorBoard where it is installed."""

from __future__ import annotations

import csv
import io
from contextlib import suppress
from pathlib import Path

from avatar.checks import AvatarError, DataError, require
from avatar.io.npz import write_whole


class TrainingLog:
    """Appends rows to ``metrics.csv``; a resumed run goes on in its file.

    Rows hold ``split`` (train or validation), ``step``, ``epoch``, ``seconds`` and one column for every term.
    """

    def __init__(self, folder: Path, columns: list[str], from_step: int):
        """Opens the log of a run and drops rows past the step a resumed run starts from.

        Raises `DataError` when the log cannot be written; the one there is stays as it is.
        """
        self.path = folder / "metrics.csv"
        self.columns = ["split", "step", "epoch", "seconds", *columns]
        kept = [row for row in read_log(self.path) if int(row["step"]) <= from_step] if self.path.is_file() else []
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self.columns, restval="", extrasaction="ignore")
        writer.writeheader()
        writer.writerows(kept)
        write_whole(self.path, text.getvalue().encode())
        try:
            self.file = self.path.open("a", newline="")
        except OSError as error:
            raise self._not_written(error) from error
        self.writer = csv.DictWriter(self.file, self.columns, restval="", extrasaction="ignore")
        self.board = None
        with suppress(AvatarError):
            require("tensorboard")
            self.board = require("torch.utils.tensorboard").SummaryWriter(folder / "tensorboard")

    def _not_written(self, error: OSError) -> DataError:
        hint = "Make room and give the same command again."
        return DataError(self.path, f"could not be written ({error.strerror}).", hint)

    def write(self, split: str, step: int, epoch: int, seconds: float, values: dict[str, float]) -> None:
        """Writes one row and flushes it. Raises `DataError` when the disk refuses."""
        row = {"split": split, "step": step, "epoch": epoch, "seconds": f"{seconds:.2f}"}
        try:
            self.writer.writerow(row | {name: f"{value:.6g}" for name, value in values.items()})
            self.file.flush()
        except OSError as error:
            raise self._not_written(error) from error
        if self.board:
            for name, value in values.items():
                self.board.add_scalar(f"{split}/{name}", value, step)

    def close(self) -> None:
        """Closes the file and the board."""
        try:
            self.file.close()
        except OSError as error:
            raise self._not_written(error) from error
        if self.board:
            self.board.close()


def read_log(path: Path) -> list[dict[str, str]]:
    """The whole rows of a training log; what a killed run left half-written is passed over."""
    text = path.read_text(errors="replace")
    rows = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1], newline=""))
    return [row for row in rows if str(row.get("step")).isdigit() and None not in (*row, *row.values())]
