"""`seams`: how runs predict near the cuts of the body's UV atlas, where POP's features jump and a surface's do not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from avatar.checks import AvatarError, check_name
from avatar.data.outfits import Outfit
from avatar.environment import prepared_process
from avatar.evaluation.aggregate import grouped
from avatar.evaluation.scoring import Label
from avatar.evaluation.seams import (
    SeamPlaces,
    SeamTest,
    check_baseline,
    measure_seams,
    name_of,
    seam_differences,
    seam_places,
    seam_table,
    seams_csv,
)
from avatar.evaluation.tables import Table, to_markdown
from avatar.io.npz import write_whole
from avatar.methods.base import TrainedAvatar
from avatar.pipeline.scores import current_commit, run_outfits, variant_of
from avatar.pipeline.surfaces import spaced_frames
from avatar.progress import tracked
from avatar.runs.training import load_avatar


@dataclass
class SeamsConfig:
    """The seam test of some runs; point methods only, for what is asked is at chosen places of the body."""

    runs: tuple[Path, ...] = ()
    table: str = "seams"  # the name of the table's files
    baseline: str = ""  # the run, as the table names it, that others are set against; empty for none
    split: str = "test"
    points: int = 20000  # places on the body, the same for all runs of an outfit
    frames: int | None = None  # this many of the split, evenly spaced; all of them if null
    seed: int = 0
    data_root: Path | None = None  # where the data are now; where they were at training if null
    out: Path = Path("runs/tables")  # where the table's files go

    def __post_init__(self):
        check_name("table", self.table)
        if self.points < 1 or (self.frames is not None and self.frames < 1):
            raise AvatarError(f"points, frames: expected at least 1, got {self.points} and {self.frames}.")


@prepared_process()
def seams(config: SeamsConfig) -> Path:
    """Writes ``<out>/<table>.csv`` and ``<table>.md``, which it prints; gives the path of the latter.

    Raises:
        AvatarError: before anything is measured: without runs, for implicit ones, for a baseline that is none of them.
            For bodies without UV coordinates.
    """
    asked = runs_by_outfit(config)
    for mine in asked if config.baseline else ():
        check_baseline([name_of(label_of(config, avatar)) for avatar, _ in mine], config.baseline)
    every: list[SeamTest] = []
    tables: list[Table] = []
    for mine in asked:
        places = seam_places(mine[0][1].template, config.points, config.seed)
        tests = [probe_seams(config, avatar, outfit, places) for avatar, outfit in mine]
        tables.append(seam_table(tests))
        tables += [seam_differences(tests, config.baseline)] if config.baseline else []
        every += tests
    write_whole(config.out / f"{config.table}.csv", seams_csv(every).encode())
    text = "\n".join(map(to_markdown, tables))
    write_whole(config.out / f"{config.table}.md", text.encode())
    print(f"{text}\nwritten: {config.out / config.table}.*")
    return config.out / f"{config.table}.md"


def runs_by_outfit(config: SeamsConfig) -> list[list[tuple[TrainedAvatar, Outfit]]]:
    """The runs, loaded, of each outfit that they were trained on."""
    if not config.runs:
        raise AvatarError("runs: expected the folders of trained runs, got none.")
    found = []
    for run in config.runs:
        avatar = load_avatar(run)
        if not avatar.method.on_body:
            raise AvatarError(
                f"{run}: expected a method with points at chosen places of the body, got {avatar.method.name}. "
                "Hint: leave it out."
            )
        found += [(avatar, outfit) for outfit in run_outfits(avatar, config.data_root)]
    return list(grouped(found, lambda pair: (pair[1].dataset, pair[1].name)).values())


def label_of(config: SeamsConfig, avatar: TrainedAvatar) -> Label:
    """A run in the table."""
    return Label(
        avatar.config.method.variant,
        table=config.table,
        variant=variant_of(avatar.config),
        seed=avatar.config.train.seed,
        steps=avatar.steps,
        commit=current_commit(),
    )


def probe_seams(config: SeamsConfig, avatar: TrainedAvatar, outfit: Outfit, places: SeamPlaces) -> SeamTest:
    """A run asked at places of an outfit's body, for the frames of a split."""
    names = spaced_frames(list(outfit.frames(config.split)), config.frames)
    frames = []
    for name in tracked(names, f"seams of {avatar.config.method.variant} on {outfit.name}"):
        frame = outfit.load(config.split, name)
        cloud = avatar.method.predict_at(avatar, outfit.name, frame.body, places.samples)
        frames.append(measure_seams(cloud, frame.scan, places))
    return SeamTest(label_of(config, avatar), outfit.dataset, outfit.name, tuple(frames))
