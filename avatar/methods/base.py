"""Interface of a method of any kind, one file in this folder each; the rest of the program knows no method by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor, nn

from avatar.checks import AvatarError
from avatar.implicit.extraction import ExtractionConfig
from avatar.methods.settings import FitConfig, RunConfig
from avatar.records import Batch, BodyFit, ClothedTemplate, LossTerms, PointCloud, SurfaceSamples, Template

Inputs = tuple[Any, ...]  # dataclasses of tensors; the first has the ``names`` of its frames
SEED_STRIDE = 1_000_003  # between the seeds of a run's ranks and tasks, so that a step's draw is that of no other run
CANONICALIZER = "canonicalizer"  # a method's need: a trained canonicalizer for each outfit
CLOTHED_TEMPLATE = "clothed template"  # a need: the template of each outfit, in its canonicalizer's run


@dataclass(frozen=True)
class Stage:
    """Part of training, a ``share`` of the budget, that begins with a fresh optimiser state.

    It has ``rates``, one for each parameter group of the task, with a ``factor(step of the run, share of the stage)``.
    """

    share: float
    rates: tuple[float, ...]
    factor: Callable[[int, float], float]


@dataclass(frozen=True)
class Position:
    """Position in training: the ``stage``'s index and the share of it that is done, in [0, 1]."""

    stage: int
    progress: float


class Task(ABC):
    """What a `Trainer` trains: a network, the inputs of each step, and their loss. It keeps no state between steps.

    ``model`` on its device; ``terms`` the raw loss terms, for the log; ``groups`` the parameter groups; ``stages``;
    ``frames`` the number of training frames; ``batch`` frames a step; ``criterion``, the logged value that the best
    checkpoint has the least of; ``label`` of the progress bar; ``replicated``, the names of submodules that every rank
    runs on the same inputs, so that their normalisations need no synchronisation.
    """

    model: nn.Module
    terms: tuple[str, ...]
    groups: tuple[list[nn.Parameter], ...]
    stages: tuple[Stage, ...]
    frames: int
    batch: int
    criterion: str = ""
    label: str = "train"
    replicated: Collection[str] = ()

    @abstractmethod
    def inputs_at(self, step: int) -> Inputs:
        """The inputs of a step on the CPU, this rank's shard; they follow from the step and the seed alone."""

    @abstractmethod
    def loss(self, inputs: Inputs, position: Position) -> LossTerms:
        """Loss terms of inputs that are on the model's device."""

    def held_back(self) -> Iterable[Inputs]:
        """Inputs of the validation frames, always the same; none by default."""
        return ()

    def settle(self) -> None:  # noqa: B027 (nothing to settle by default)
        """Brings what follows from the weights, but is not trained, up to date; before each validation and the end."""

    def log_values(self, terms: LossTerms) -> dict[str, float]:
        """The objective and every raw term, as the log shows them."""
        raw = {name: float(value.detach()) for name, value in terms.raw.items()}
        return {"loss": float(terms.total.detach())} | raw

    def shown(self, values: dict[str, float]) -> dict[str, str]:
        """What the progress bar shows of logged values, as text."""
        return {"loss": f"{values['loss']:.3f}"}

    def frame_names(self, inputs: Inputs) -> tuple[str, ...]:
        """The names of the frames in a step's inputs."""
        return inputs[0].names


@dataclass(frozen=True)
class TrainedAvatar:
    """A trained network with its method, settings, the ``template`` it is built on, and ``steps`` and ``seconds``."""

    method: Method
    settings: Any
    model: nn.Module
    template: Template
    config: RunConfig
    steps: int
    seconds: float

    def outfit_index(self, name: str) -> int:
        """Index of an outfit among those the avatar was trained on; raises `AvatarError` for any other."""
        if name not in self.config.outfit:
            raise AvatarError(f"outfit: this avatar was trained on {', '.join(self.config.outfit)}, not on {name!r}.")
        return self.config.outfit.index(name)


class Method(ABC):
    """One method: a name, a settings class, and everything that depends on the kind of avatar it trains.

    ``makes_meshes`` is True for a method with a surface of its own, which prediction writes beside the points;
    ``on_body`` for one that predicts at chosen places of the body (`predict_at`); ``static`` are the settings of its
    ablation without pose, the ``static`` floor, or None.
    """

    name: ClassVar[str]
    Settings: ClassVar[type]
    makes_meshes: ClassVar[bool] = False
    on_body: ClassVar[bool] = False
    static: ClassVar[Mapping[str, Any] | None] = None

    @property
    def sources(self) -> tuple[str, ...]:
        """Modules of this package whose code makes the method's predictions, for `io.ledger`."""
        return (type(self).__module__,)

    def check(self, run: RunConfig, settings: Any) -> None:  # noqa: B027 (nothing to check by default)
        """Raises `AvatarError`, before data are read, for a run that the method cannot train."""

    def needs(self, run: RunConfig, settings: Any) -> frozenset[str]:
        """What must be made of the outfits before training: any of {`CANONICALIZER`, `CLOTHED_TEMPLATE`}."""
        return frozenset()

    @abstractmethod
    def prepare(self, run: RunConfig, settings: Any, template: Template) -> Task:
        """An untrained network with its data and loss, on the run's device; `DataError` where something is missing."""

    @abstractmethod
    def untrained(self, settings: Any, template: Template) -> nn.Module:
        """A network for one outfit, without data: to count its parameters."""

    def describe(self, model: nn.Module) -> dict[str, Any]:
        """Plain values, beside settings and template, that `rebuild` needs; they are written beside the weights."""
        return {}

    @abstractmethod
    def rebuild(self, settings: Any, template: Template, outfits: int, facts: dict, weights: dict) -> nn.Module:
        """The network of a finished run, its weights still to be loaded."""

    @abstractmethod
    def predictor(self, avatar: TrainedAvatar, outfit: str, points: int, surface: ExtractionConfig) -> Callable:
        """A function from a `BodyFit` to its dressed `Surface` in an outfit, of 1,000 to 400,000 ``points``.

        ``surface`` is the resolution of an implicit surface.
        """

    def prediction_settings(self, points: int, surface: ExtractionConfig) -> dict[str, Any]:
        """The options of `predictor` that this method's predictions depend on, as plain values."""
        return {"points": points}

    def predict_at(self, avatar: TrainedAvatar, outfit: str, body: BodyFit, samples: SurfaceSamples) -> PointCloud:
        """The dressed surface at chosen places of the body; `AvatarError` for a method that has no points there."""
        raise AvatarError(f"method: expected one with points at chosen places of the body, got {self.name}.")

    def garment(
        self, avatar: TrainedAvatar, outfit: str, points: int, body: BodyFit | None = None
    ) -> PointCloud | None:
        """The explicit garment template, skinned to a body or in the canonical pose; None for a method without one."""
        return None

    def mesh_template(self, avatar: TrainedAvatar) -> ClothedTemplate | None:
        """The clothed template whose faces an avatar's meshes have; None without meshes of constant topology."""
        return None

    def fit_code(self, avatar: TrainedAvatar, batch: Batch, options: FitConfig) -> Tensor:
        """The garment code of an unseen outfit from one scan; `AvatarError` for a method without codes."""
        problem = f"run: expected a method with a garment code for each outfit, got {self.name}."
        raise AvatarError(f"{problem} Hint: train the new outfit by itself.")
