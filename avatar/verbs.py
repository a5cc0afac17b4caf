"""The verbs: what each does, the function that does it, and the class of its settings, by name; and those of methods.

Names only, so that starting one verb imports nothing of the others.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Verb:
    """One verb: a sentence for the user, then ``module:attribute`` of its function and of its settings class.

    A verb without a settings class reads its own arguments; ``then`` is called with the settings of a multirun's
    finished jobs.
    """

    does: str
    run: str
    settings: str = ""
    then: str = ""


VERBS = {
    "simulate": Verb(
        "makes outfits of the open dataset",
        "avatar.simulate.recording:simulate",
        "avatar.simulate.recording:SimulateConfig",
    ),
    "canonicalize": Verb(
        "learns an outfit's skinning field and brings its scans to the T-pose",
        "avatar.pipeline.canonicalization:canonicalize",
        "avatar.training.canonicalizing:CanonicalizeConfig",
    ),
    "train": Verb(
        "trains an avatar, or goes on with it",
        "avatar.pipeline.methods:train",
        "avatar.training.runs:RunConfig",
    ),
    "fit": Verb(
        "fits an unseen outfit from one scan",
        "avatar.training.fitting:fit_outfit",
        "avatar.training.fitting:FitConfig",
    ),
    "predict": Verb(
        "predicts posed point clouds",
        "avatar.pipeline.scores:predict",
        "avatar.pipeline.scores:PredictConfig",
    ),
    "evaluate": Verb(
        "scores predictions beside their floors",
        "avatar.pipeline.scores:evaluate",
        "avatar.pipeline.scores:EvaluateConfig",
    ),
    "experiment": Verb(
        "runs every job of a table, then makes it",
        "avatar.pipeline.experiments:experiment",
        "avatar.pipeline.experiments:ExperimentConfig",
        "avatar.pipeline.experiments:tabulate_experiment",
    ),
    "compare": Verb(
        "makes one table of many runs' scores",
        "avatar.pipeline.comparison:compare",
        "avatar.pipeline.comparison:CompareConfig",
    ),
    "seams": Verb(
        "measures predictions at the seams of the UV atlas",
        "avatar.pipeline.seams:seams",
        "avatar.pipeline.seams:SeamsConfig",
    ),
    "mesh": Verb("meshes predictions", "avatar.pipeline.surfaces:mesh", "avatar.pipeline.surfaces:MeshConfig"),
    "export": Verb(
        "writes animation files of a predicted motion",
        "avatar.pipeline.surfaces:export",
        "avatar.pipeline.surfaces:ExportConfig",
    ),
    "report": Verb("writes a run's page", "avatar.pipeline.reporting:report", "avatar.pipeline.reporting:ReportConfig"),
    "demo": Verb(
        "does the main job on the embedded sample", "avatar.pipeline.demo:demo", "avatar.pipeline.demo:DemoConfig"
    ),
    "bench": Verb(
        "measures speed and memory",
        "avatar.pipeline.benchmarks.bench:bench",
        "avatar.pipeline.benchmarks.bench:BenchConfig",
    ),
    "torture": Verb(
        "measures reliability under kills, damage and races",
        "avatar.pipeline.torture.trials:torture",
        "avatar.pipeline.torture.trials:TortureConfig",
    ),
    "parameters": Verb(
        "counts every method's parameters",
        "avatar.plain_verbs:parameters",
        "avatar.pipeline.parameters:ParametersConfig",
    ),
    "convert_body": Verb("converts an SMPL, SMPL-H or SMPL-X file", "avatar.plain_verbs:convert_body"),
    "make_body": Verb("makes a body of any shape", "avatar.plain_verbs:make_body"),
    "make_motion": Verb("writes one of the open dataset's motions as a file", "avatar.plain_verbs:make_motion"),
    "pack": Verb("writes an outfit as packed frames, as POP's line stores them", "avatar.plain_verbs:pack"),
    "doctor": Verb("lists what is installed and what is missing", "avatar.plain_verbs:doctor"),
}

METHOD_SETTINGS = {
    "closet": "avatar.nn.closet:ClosetConfig",
    "pop": "avatar.nn.baselines.pop:PopConfig",
    "scale": "avatar.nn.baselines.scale:ScaleConfig",
    "scanimate": "avatar.training.implicit_runs:ScanimateConfig",
}


def resolve(name: str) -> Any:
    """What a ``module:attribute`` names, imported now."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
