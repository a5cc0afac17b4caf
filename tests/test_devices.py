"""Every method and every verb that computes, on a pretended accelerator: a fault of devices shows without one."""

import copy
import io
from dataclasses import replace

import numpy as np
import pretended
import pytest
import torch
from safetensors.torch import load_file
from tiny import DECODER, SETTINGS, canonical_truth, dressed_trunk, quick_training

from avatar.canonical.canonicalizer import CanonicalizerConfig
from avatar.canonical.fields import SkinningFieldConfig
from avatar.canonical.scans import DrawConfig
from avatar.checks import AvatarError
from avatar.data.scanner import ScanConfig
from avatar.data.splits import SplitConfig
from avatar.environment import choose_device
from avatar.evaluation.scores import read_scores
from avatar.evaluation.scoring import ScoreConfig
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.clothed_templates import write_clothed_template
from avatar.io.frames import write_canonical_scan
from avatar.io.motions import write_motion
from avatar.io.points import read_points
from avatar.methods.canonicalizer import CanonicalizeConfig, CanonicalizerTask, CycleConfig
from avatar.methods.settings import FitConfig, MethodChoice, RunConfig, Space
from avatar.pipeline.canonicalization import canonicalize
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, predict
from avatar.runs.training import fit_outfit, load_avatar
from avatar.runs.training import train as train_run
from avatar.simulate.angles import authored_motion

pytestmark = pytest.mark.pretended
UNET = {"levels": 3, "width": 4, "out_channels": 4}
POP = {
    "pose_encoder": UNET,
    "pose_decoder": DECODER,
    "garment_decoder": DECODER,
    "map_size": 16,
    "code_channels": 4,
}
SCALE = {
    "pose_encoder": UNET,
    "global_encoder": {"points": [8, 8], "body": [8]},
    "decoder": DECODER,
    "map_size": 16,
    "patches": 60,
}
QUERIES = {"near_points": 60, "box_points": 40, "boundary_points": 20}
SDF = {"widths": [32, 32], "skip": 1, "orders": 2}


def implicit(**switches) -> dict:
    return {"avatar": {"sdf": SDF, "texture": SDF, "gate_spacing": 0.2} | switches, "train": {"queries": QUERIES}}


METHODS = {
    "closet": ("closet", SETTINGS | {"pose_noise": 0.01}),
    "csf": ("closet", SETTINGS | {"template": False}),
    "static": ("closet", SETTINGS | {"pose": False}),
    "closet_local": ("closet", SETTINGS | {"pose_locality": "kinematic", "local_encoder": {"widths": [16, 8]}}),
    "closet_learned": ("closet", SETTINGS | {"skinning": "learned", "train_field": True}),
    "closet_canonical": ("closet", SETTINGS),
    "closet_pointmlp": ("closet", SETTINGS | {"encoder": "pointmlp"}),
    "closet_pointnext": ("closet", SETTINGS | {"encoder": "pointnext"}),
    "pop": ("pop", POP),
    "pop_etd": ("pop", POP | {"template": True}),
    "layered": ("layered", SETTINGS | {"handles": 40, "cloth": {"self_contact": 1.0, "temporal": 1.0}}),
    "layered_points": ("layered", SETTINGS | {"handles": 40, "head": "points"}),
    "scale": ("scale", SCALE),
    "scale_global": ("scale", SCALE | {"pose_feature": "global"}),
    "scanimate": ("scanimate", implicit()),
    "scanimate_field": ("scanimate", implicit(gate_spacing=0)),
    "scanimate_global": ("scanimate", implicit(pose="global")),
    "colored": ("scanimate", implicit(colored=True)),
}
RESUMED = (
    "closet",
    "closet_learned",
    "layered",
    "pop",
    "scanimate",
)  # stopped after a step: one for each kind of state
FIELD = SkinningFieldConfig(width=16, layers=2, skip=1, orders=2)
CYCLES = CycleConfig(
    first_steps=2,
    second_steps=2,
    batch=2,
    code_steps=2,
    save_every=1,
    draw=DrawConfig(scan=200, body=200, edges=100, pool=500),
)
CHEAP = ScoreConfig(scan_points=1000, metrics=["cd_point", "normal_l1"])


@pytest.fixture(scope="module", autouse=True)
def device():
    """The pretended accelerator, as what ``device=auto`` takes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("avatar.environment.accelerator_type", lambda: pretended.NAME)
        yield pretended.install()


@pytest.fixture(scope="module")
def runs(tiny_folder, tiny_outfit, tmp_path_factory, device) -> dict[str, RunConfig]:
    """A run's settings on the CPU and on the device, beside a canonicalizer that was made, stopped and resumed there.

    Its scans are then replaced by the true ones, in colour: so little training carries them nowhere.
    """
    where = {"dataset": "open", "data_root": tiny_folder.parents[1]}
    found = {}
    for kind in ("cpu", "auto"):
        where |= {"runs_root": tmp_path_factory.mktemp(kind), "device": kind}
        config = CanonicalizeConfig(
            outfit=tiny_folder.name,
            scan=ScanConfig(points=1500),
            canonicalizer=CanonicalizerConfig(FIELD, replace(FIELD, latent=4)),
            train=CYCLES,
            pictures=0,
            scored=1,
            **where,
        )
        if kind == "auto":
            with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
                patch.setattr("avatar.methods.canonicalizer.CanonicalizerTask.inputs_at", stopping_at(3))
                canonicalize(config)
        folder = canonicalize(config)
        for path in (folder / "scans" / "train").glob("*.npz"):
            scan = canonical_truth(tiny_outfit, "train", path.stem)
            upper = (scan.points[:, 1:2] > 0.3).astype(np.float32)
            colors = np.concatenate([upper, 1 - upper, 0 * upper], axis=1)
            write_canonical_scan(path, replace(scan, colors=colors))
        write_clothed_template(folder / "template" / "template.npz", dressed_trunk(tiny_outfit.template))
        found[kind] = RunConfig(
            outfit=(tiny_folder.name,),
            scan=ScanConfig(points=1500),
            split=SplitConfig(validation_share=0.2),
            train=quick_training(steps=2, points=500, scan_points=400, validate_every=2, save_every=1, mirror=True),
            **where,
        )
    return found


def stopping_at(last: int):
    """`CanonicalizerTask.inputs_at`, ending in Ctrl-C at a step."""
    draw = CanonicalizerTask.inputs_at

    def inputs_at(task, step: int):
        if step == last:
            raise KeyboardInterrupt
        return draw(task, step)

    return inputs_at


def weights_of(folder) -> dict:
    """The weights that a run left."""
    return load_file(next(folder.glob("*.safetensors")))


def assert_alike(mine: dict, others: dict) -> None:
    """The same weights but for rounding."""
    assert mine.keys() == others.keys()
    for name, value in mine.items():
        torch.testing.assert_close(value, others[name], atol=1e-4, rtol=1e-3, msg=lambda text, name=name: name + text)


def test_a_canonicalizer_made_and_resumed_on_the_device_is_the_cpus(runs):
    folders = [run.runs_root / "canonical" / "open" / run.outfit[0] / "default" for run in runs.values()]
    assert_alike(*map(weights_of, folders))
    tables = [read_scores(folder / "scores.csv").rows for folder in folders]
    for mine, theirs in zip(*tables, strict=True):
        assert (mine.method, mine.variant, mine.metric) == (theirs.method, theirs.variant, theirs.metric)
        assert mine.value == pytest.approx(theirs.value, rel=1e-2, abs=1e-4)


@pytest.mark.parametrize("name", METHODS)
def test_a_method_trained_and_predicted_on_the_device_is_the_cpus(runs, name):
    """Prediction loads what training left onto the device again."""
    method, settings = METHODS[name]
    space = Space.canonical if name == "closet_canonical" else Space.posed
    clouds = []
    for kind, run in runs.items():
        run = replace(run, method=MethodChoice(method, name, settings), space=space)
        pretended.used.clear()
        if kind == "auto" and name in RESUMED:
            train_run(replace(run, train=replace(run.train, steps=1)))
        folder = train_run(run)
        (points,) = predict(PredictConfig(run=folder, points=1000, device=kind, surface=ExtractionConfig(16, 8)))
        assert bool(pretended.used) == (kind == "auto") and not pretended.used & pretended.BY_CHANCE
        clouds.append([read_points(path) for path in sorted(points.glob("*.ply"))])
    assert_alike(*(weights_of(run.runs_root / name / "open" / run.outfit[0] / "default") for run in runs.values()))
    for mine, theirs in zip(*clouds, strict=True):
        np.testing.assert_allclose(mine.points, theirs.points, atol=1e-4)
        np.testing.assert_allclose(mine.normals, theirs.normals, atol=1e-3)


def test_an_outfit_fitted_posed_by_a_motion_and_scored_on_the_device_is_the_cpus(runs, tmp_path):
    found = []
    motion = tmp_path / "stroll.npz"
    write_motion(motion, authored_motion("walk", fps=4, seconds=0.5))
    for kind, run in runs.items():
        whole = train_run(replace(run, method=MethodChoice("closet", "whole", SETTINGS)))
        options = {"dataset": "open", "outfit": run.outfit[0], "runs_root": run.runs_root, "device": kind}
        fitted = fit_outfit(
            FitConfig(run=whole, data_root=run.data_root, steps=2, points=500, scan_points=400, **options)
        )
        (folder,) = predict(PredictConfig(run=fitted, motion=motion, fps=4, points=1000, device=kind))
        predict(PredictConfig(run=fitted, points=1000, device=kind))
        scores = evaluate(EvaluateConfig(runs=(fitted,), floors=False, score=CHEAP)).rows
        avatar = load_avatar(fitted, device=kind)
        rest = avatar.method.garment(avatar, run.outfit[0], 1000)
        clouds = [read_points(path).points for path in sorted(folder.glob("*.ply"))]
        found.append((np.concatenate([*clouds, rest.points]), [row.value for row in scores]))
    (mine, scores), (theirs, others) = found
    np.testing.assert_allclose(mine, theirs, atol=1e-4)
    assert scores == pytest.approx(others, rel=1e-2)


# The device itself: what the tests above find is worth what it refuses.


@pytest.mark.parametrize(
    "fault",
    [
        lambda there, here: there + here,
        lambda there, here: here * there,
        lambda there, here: there @ here.T,
        lambda there, here: torch.cat([there, here]),
        lambda there, here: there.gather(1, torch.zeros(2, 1, dtype=torch.long)),
        lambda there, here: torch.equal(there, here),
        lambda there, here: here.add_(there),
        lambda there, here: here.add_(there.sum()),
        lambda there, here: here[torch.arange(2, device=there.device)],
        lambda there, here: torch.nn.functional.linear(there, here),
        lambda there, here: there.numpy(),
        lambda there, here: np.asarray(there),
        lambda there, here: torch.rand(3, device=there.device, generator=torch.Generator()),
    ],
)
def test_what_cuda_refuses_is_refused(device, fault):
    here = torch.arange(6.0).reshape(2, 3)
    with pytest.raises((RuntimeError, TypeError), match=r"same device|Tensor\.cpu|generator"):
        fault(here.to(device), here.clone())


def test_what_cuda_allows_is_allowed(device):
    here = torch.arange(6.0).reshape(2, 3)
    there = here.to(device)
    assert there.device.type == pretended.NAME and torch.equal(there.cpu(), here)
    assert torch.equal((there + torch.tensor(1.0)).cpu(), here + 1)  # a number of the CPU
    assert torch.equal(there[:, torch.tensor([2, 0])].cpu(), here[:, [2, 0]])  # indices of the CPU
    assert (there.sum().item(), there.tolist()) == (15.0, here.tolist())
    assert there.new_tensor([1.0]).device == torch.zeros(1, device=device).device == there.device
    rows, ids = there.unique(return_inverse=True)
    assert rows.device == ids.device == there.device
    assert choose_device("auto") == there.device
    with pytest.raises(AvatarError, match="device"):
        choose_device("nonsense")


def test_networks_learn_on_it_as_on_the_cpu(device):
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4), torch.nn.Softplus())
    twin, inputs = copy.deepcopy(network).to(device), torch.randn(5, 3)
    for model, values in ((network, inputs), (twin, inputs.to(device))):
        optimiser = torch.optim.Adam(model.parameters(), 0.1, fused=True)
        for _ in range(3):
            optimiser.zero_grad()
            model(values).exp().mean().backward()
            optimiser.step()
    saved = io.BytesIO()
    torch.save(twin.state_dict(), saved)
    loaded = torch.load(io.BytesIO(saved.getvalue()), map_location="cpu", weights_only=True)
    assert all(torch.equal(value, loaded[name]) for name, value in network.state_dict().items())
