"""Verbs: what each does, the function that does it, and the class of its settings, by name.

Names only, so that starting one verb imports nothing of the others.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass
class Verb:
    """One verb: a sentence for the user, then ``module:attribute`` of its function and of its settings class.

    A settings class without a module is in the function's. A verb without one reads its own arguments; ``then`` is
    called with the settings of a multirun's finished jobs. ``conf`` is the verb's configuration file where that is not
    ``conf/<verb>.yaml``, as for the verbs of ``tools/`` that are not in the package and so not in `VERBS`.
    """

    does: str
    run: str
    settings: str = ""
    then: str = ""
    conf: Path | None = None

    def __post_init__(self):
        if self.settings and ":" not in self.settings:
            self.settings = f"{self.run.partition(':')[0]}:{self.settings}"


VERBS = {
    "simulate": Verb("makes outfits of the open dataset", "avatar.simulate.recording:simulate", "SimulateConfig"),
    "canonicalize": Verb(
        "learns an outfit's skinning field and brings its scans to the T-pose",
        "avatar.pipeline.canonicalization:canonicalize",
        "avatar.methods.canonicalizer:CanonicalizeConfig",
    ),
    "template": Verb(
        "makes an outfit's clothed template from its canonical scans",
        "avatar.pipeline.templating:template",
        "avatar.runs.templating:TemplateConfig",
    ),
    "train": Verb(
        "trains an avatar, or goes on with it", "avatar.runs.training:train", "avatar.methods.settings:RunConfig"
    ),
    "fit": Verb(
        "fits an unseen outfit from one scan", "avatar.runs.training:fit_outfit", "avatar.methods.settings:FitConfig"
    ),
    "predict": Verb("predicts posed point clouds", "avatar.pipeline.scores:predict", "PredictConfig"),
    "evaluate": Verb("scores predictions beside their floors", "avatar.pipeline.scores:evaluate", "EvaluateConfig"),
    "experiment": Verb(
        "runs every job of a table, then makes it",
        "avatar.pipeline.experiments:experiment",
        "ExperimentConfig",
        "avatar.pipeline.experiments:tabulate_experiment",
    ),
    "compare": Verb("makes one table of many runs' scores", "avatar.pipeline.reporting:compare", "CompareConfig"),
    "seams": Verb("measures predictions at the seams of the UV atlas", "avatar.pipeline.seams:seams", "SeamsConfig"),
    "texture": Verb(
        "bakes the colours of scans onto a run's mesh",
        "avatar.pipeline.texturing:texture",
        "avatar.runs.texturing:TextureConfig",
    ),
    "mesh": Verb("meshes predictions", "avatar.pipeline.surfaces:mesh", "MeshConfig"),
    "export": Verb("writes animation files of a predicted motion", "avatar.pipeline.surfaces:export", "ExportConfig"),
    "report": Verb("writes a run's page", "avatar.pipeline.reporting:report", "ReportConfig"),
    "demo": Verb("does the main job on the embedded sample", "avatar.pipeline.experiments:demo", "DemoConfig"),
    "parameters": Verb(
        "counts every method's parameters",
        "avatar.cli:parameters",
        "avatar.pipeline.parameters:ParametersConfig",
    ),
    "convert_body": Verb("converts an SMPL, SMPL-H or SMPL-X file", "avatar.cli:convert_body"),
    "make_body": Verb("makes a body of any shape", "avatar.cli:make_body"),
    "make_motion": Verb("writes one of the open dataset's motions as a file", "avatar.cli:make_motion"),
    "pack": Verb("writes an outfit as packed frames, as POP's line stores them", "avatar.cli:pack"),
    "data_info": Verb(
        "says what a folder of scans or a data set holds", "avatar.pipeline.intake:data_info", "InfoConfig"
    ),
    "data_check": Verb(
        "measures the frames of a data set, an outfit or a folder of scans",
        "avatar.pipeline.intake:data_check",
        "CheckConfig",
    ),
    "data_convert": Verb(
        "converts a data set or a folder of scans to outfits",
        "avatar.pipeline.intake:data_convert",
        "avatar.sources.conversion:ConvertConfig",
    ),
    "data_fit": Verb(
        "fits a body to scans that have none, and converts them with it",
        "avatar.pipeline.intake:data_fit",
        "avatar.sources.registered:FitScansConfig",
    ),
    "doctor": Verb("lists what is installed and what is missing", "avatar.cli:doctor"),
}

GROUPS = ("data",)  # whose verbs are typed as two words: `avatar data check`

OPTIONS = {  # that a verb's help begins with, a dozen at most
    "simulate": "preset outfits shapes root train test train_motions test_motions fps seconds workers seed",
    "canonicalize": "dataset outfit canonicalizer_size name weights scored pictures train.first_steps "
    "train.second_steps data_root runs_root device",
    "template": "dataset outfit canonical clothed.edge clothed.weights clothed.mirror clothed.refine.steps pictures "
    "data_root runs_root",
    "train": "dataset outfit method size name train.minutes train.steps train.batch canonical data_root runs_root "
    "device",
    "fit": "run dataset outfit frame name steps points data_root runs_root device",
    "predict": "run split motion fps up units joints points checkpoint data_root device",
    "evaluate": "runs split floors predictions label dataset outfit data_root out",
    "experiment": "experiment budget dataset outfit method size train.minutes train.steps split.train_fraction "
    "compare.out data_root runs_root",
    "compare": "table runs runs_root dataset name methods metrics baseline pictures splits data_root out",
    "seams": "runs baseline table split points frames data_root out",
    "texture": "run texel reach frames scored pictures data_root device",
    "mesh": "run predictions frames formats poisson.depth poisson.max_hole",
    "export": "run predictions fps motion up data_root",
    "report": "run against split frames data_root",
    "demo": "dataset outfit size train.minutes static_share points meshes data_root runs_root device",
    "parameters": "out",
    "data_info": "source layout outfits",
    "data_check": "source layout outfits frames units up body.path body.betas fits out",
    "data_convert": "source dataset name layout outfits units up body.path body.betas fits test data_root",
    "data_fit": "source dataset name layout units up body.path minimal fitting.headings fitting.clothing pictures "
    "data_root",
}

SHARED = {  # what options mean in several verbs
    "run": "folder of a trained run",
    "runs": "folders of trained runs",
    "dataset": "folder of outfits below data_root; sample comes along",
    "outfit": "folder of an outfit's frames",
    "data_root": "folder of data sets",
    "runs_root": "folder that runs are written to",
    "name": "of the run: the last part of its folder",
    "split": "frames of which split: test, interpolation, train or validation",
    "seed": "of all that is drawn at random",
    "device": "auto takes CUDA where there is one",
}


def typed_words(verb: str) -> list[str]:
    """The words by which a verb is called: ``data check`` for one of a group, else its name."""
    group, _, rest = verb.partition("_")
    return [group, rest] if group in GROUPS else [verb]


def resolve(name: str) -> Any:
    """What a ``module:attribute`` names, imported now."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
