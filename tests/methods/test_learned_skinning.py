"""Point avatars joined to canonicalizers: skinned by their fields, taught in their space, refused without them."""

import shutil
from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from tiny import SETTINGS, canonical_truth, quick_training

from avatar.body.packed import write_template
from avatar.canonical.fields import SkinningField, SkinningFieldConfig, bounding_box
from avatar.checks import AvatarError, DataError
from avatar.config import compose_settings
from avatar.data.splits import SplitConfig
from avatar.geometry.surface import interpolate, sample_surface
from avatar.geometry.transforms import transform_points
from avatar.io.frames import write_canonical_scan
from avatar.methods.canonicalizer import canonical_outfits, canonicalizer_folder
from avatar.methods.closet import learned_skinning
from avatar.methods.losses import LossConfig
from avatar.methods.points import body_batch, predict
from avatar.methods.settings import MethodChoice, RunConfig, Schedule, Space
from avatar.runs.training import load_avatar
from avatar.runs.training import train as train_run

FIELD = SkinningFieldConfig(width=16, layers=2, skip=1, orders=1)
LEARNED = MethodChoice("closet", "closet_learned", SETTINGS | {"skinning": "learned"})


def field_of(template) -> SkinningField:
    """A small field that has roughly learned a body's weights."""
    torch.manual_seed(0)
    field = SkinningField(22, FIELD, bounding_box(template.vertices))
    optimiser = torch.optim.Adam(field.parameters(), 0.02)
    points, weights = template.vertices[None, ::16], template.weights[None, ::16]
    for _ in range(60):
        optimiser.zero_grad()
        (field(points) - weights).square().sum(dim=-1).mean().backward()
        optimiser.step()
    return field


@pytest.fixture(scope="module")
def settings(tiny_folder, tiny_outfit, tmp_path_factory) -> RunConfig:
    """A run to train beside the finished folder of a canonicalizer."""
    config = RunConfig(
        method=LEARNED,
        dataset=tiny_folder.parent.name,
        outfit=(tiny_folder.name,),
        data_root=tiny_folder.parents[1],
        runs_root=tmp_path_factory.mktemp("runs"),
        split=SplitConfig(validation_share=0.2),
        train=quick_training(steps=4, points=1000, scan_points=1000, validate_every=2, save_every=2),
        device="cpu",
    )
    folder = config.runs_root / "canonical" / config.dataset / config.outfit[0] / config.canonical
    for name in tiny_outfit.frames("train"):
        write_canonical_scan(folder / "scans" / "train" / f"{name}.npz", canonical_truth(tiny_outfit, "train", name))
    write_template(folder / "template.npz", tiny_outfit.template)
    (folder / "config.yaml").write_text(yaml.safe_dump({"dataset": config.dataset, "outfit": config.outfit[0]}))
    return config


@pytest.fixture
def loaded(monkeypatch, tiny_outfit):
    """The folders whose canonicalizers have been asked for; each has the field of the tiny outfit's body."""
    field, asked = field_of(tiny_outfit.template), []

    def load(folder, device):
        asked.append(folder)
        return SimpleNamespace(forward_field=deepcopy(field))

    monkeypatch.setattr("avatar.methods.closet.load_canonicalizer", load)
    return asked


def frame_batch(outfit):
    name = outfit.frames("test")[-1]
    return body_batch([outfit.load("test", name).body], 0, (name,))


def surface_of(template, count: int):
    return sample_surface(template.vertices, template.faces, count, torch.Generator().manual_seed(0))


@pytest.mark.slow
def test_a_run_skinned_by_a_field_comes_back_without_its_canonicalizer(settings, loaded, tiny_outfit, monkeypatch):
    run = train_run(replace(settings, name="skinned"))
    assert [folder.parent.name for folder in loaded] == ["tiny"]
    monkeypatch.delattr("avatar.methods.closet.load_canonicalizer")
    batch, taught = frame_batch(tiny_outfit), field_of(tiny_outfit.template).state_dict()
    for checkpoint in ("last", "best"):
        avatar = load_avatar(run, checkpoint, "cpu")
        samples = surface_of(avatar.template, 1000)
        found = avatar.model.skinning.fields[0].state_dict()
        assert all(torch.equal(found[name], value) for name, value in taught.items())  # frozen
        prediction = avatar.model(batch, samples)
        resting = interpolate(tiny_outfit.template.vertices, samples) + prediction.offsets
        transforms = avatar.model.skinning(resting, batch.joint_transforms, batch.outfit_ids)
        torch.testing.assert_close(prediction.points, transform_points(transforms, resting))


@pytest.mark.slow
def test_a_field_in_training_goes_on_where_it_stopped(settings, loaded, tiny_outfit, one_thread):
    """To the bit on one thread; with several, gradients through the field depend on their order."""
    method = replace(LEARNED, settings=LEARNED.settings | {"train_field": True})
    train = replace(settings.train, steps=4, schedule=Schedule.constant, loss=LossConfig(normal_start=0.0))
    whole, part = (replace(settings, name=name, method=method, train=train) for name in ("whole", "part"))
    train_run(replace(part, train=replace(train, steps=2)))
    fields = [load_avatar(train_run(config), device="cpu").model.skinning.fields[0] for config in (whole, part)]
    first = field_of(tiny_outfit.template).state_dict()
    for name, value in fields[0].state_dict().items():
        assert torch.equal(value, fields[1].state_dict()[name])
        assert torch.equal(value, first[name]) == (name == "box")


@pytest.fixture
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
def test_canonical_space_teaches_what_posed_space_shows(settings, tiny_outfit):
    """Trained on T-pose scans, it is near the posed scans of poses it never saw."""
    method = MethodChoice("closet", "closet_canonical", SETTINGS)
    train = quick_training(steps=100, points=1500, scan_points=1500, validate_every=50, save_every=100)
    run = train_run(replace(settings, method=method, space=Space.canonical, train=train))
    avatar, name = load_avatar(run, device="cpu"), tiny_outfit.frames("test")[-1]
    scan, batch = tiny_outfit.load("test", name).scan, frame_batch(tiny_outfit)
    cloud = predict(avatar.model, batch, surface_of(avatar.template, 4000))

    def apart(points: np.ndarray) -> float:
        from_scan = torch.cdist(torch.from_numpy(scan.points), torch.from_numpy(points)).amin(dim=1)
        return float(from_scan.square().mean())

    assert apart(cloud.points) < 0.6 * apart(batch.vertices[0].numpy())
    rows = (run / "metrics.csv").read_text().splitlines()
    assert sum(row.startswith("validation") for row in rows) == 2


@pytest.mark.parametrize("space", Space)
def test_batches_say_which_space_they_are_in(settings, tiny_outfit, monkeypatch, space):
    seen = []

    def look(trainer):
        seen.extend([trainer.task.batch_at(0), *trainer.task.validation()])

    monkeypatch.setattr("avatar.training.trainer.Trainer.fit", look)
    train_run(replace(settings, method=MethodChoice("closet", f"in_{space.value}", SETTINGS), space=space))
    at_rest = space is Space.canonical
    body = tiny_outfit.template.vertices
    assert len(seen) > 1 and all(batch.canonical == at_rest for batch in seen)
    assert all(torch.equal(batch.vertices[0], body) == at_rest for batch in seen)


def test_skinning_is_that_of_each_outfits_folder(settings, loaded, tiny_outfit):
    skinning = learned_skinning(settings.runs_root, [tiny_outfit, tiny_outfit], "default", True)
    assert loaded == [canonicalizer_folder(settings.runs_root, tiny_outfit, "default")] * 2
    assert all(parameter.requires_grad for parameter in skinning.parameters())
    torch.testing.assert_close(skinning.vertices[1], tiny_outfit.template.vertices)
    torch.testing.assert_close(skinning.binds[0], tiny_outfit.template.canonical_from_bind)


def test_a_canonicalizer_that_is_missing_or_anothers_is_refused(settings, tiny_outfit, tmp_path):
    command = r"\S*python tools/canonicalize\.py dataset=open outfit=tiny name=other"
    for config in (replace(settings, canonical="other"), replace(settings, canonical="other", space=Space.canonical)):
        with pytest.raises(DataError, match=rf"canonicalizer of tiny, there is none\. Make it: {command}"):
            train_run(config)
        assert not config.folder.exists()  # nothing is begun
    there = canonicalizer_folder(settings.runs_root, tiny_outfit, "default")
    folder = tmp_path / "canonical" / "open" / "tiny" / "default"
    shutil.copytree(there, folder)
    template = tiny_outfit.template
    write_template(folder / "template.npz", replace(template, vertices=template.vertices + 0.01))
    with pytest.raises(DataError, match=r"tiny's body at rest, its canonical body is up to 1\.7 cm elsewhere.*Delete"):
        canonical_outfits(tmp_path, [tiny_outfit], "default")
    write_template(folder / "template.npz", replace(template, faces=template.faces.flip(0)))
    with pytest.raises(DataError, match="its body is another mesh"):
        canonical_outfits(tmp_path, [tiny_outfit], "default")
    (folder / "config.yaml").write_text("{dataset: open, outfit: dress}")
    with pytest.raises(DataError, match="canonicalizer of tiny, it is one of dress"):
        canonical_outfits(tmp_path, [tiny_outfit], "default")
    shutil.copytree(there, folder, dirs_exist_ok=True)
    (folder / "scans" / "train" / f"{tiny_outfit.frames('train')[2]}.npz").unlink()
    with pytest.raises(DataError, match=r"1 of tiny's train frames have no canonical scan, rise\.00002"):
        canonical_outfits(tmp_path, [tiny_outfit], "default")
    with pytest.raises(AvatarError, match="canonical: expected a plain name"):
        replace(settings, canonical="../elsewhere")
    with pytest.raises(AvatarError, match=r"method\.variant: 'canonical' is where canonicalizers are"):
        replace(settings, method=replace(LEARNED, variant="canonical"))


@pytest.mark.parametrize("verb", ["train", "demo"])
def test_ready_made_variants_differ_from_closet_in_their_switch_alone(verb):
    plain, learned, canonical, local = (
        compose_run(verb, name) for name in ("closet", "closet_learned", "closet_canonical", "closet_local")
    )
    assert plain.space is Space.posed and canonical.space is Space.canonical
    assert canonical.method.settings == plain.method.settings
    assert learned.method.settings == plain.method.settings | {"skinning": "learned"}
    assert local.method.settings == plain.method.settings | {"pose_locality": "kinematic"}
    assert len({run.method.variant for run in (plain, learned, canonical, local)}) == 4


def compose_run(verb: str, method: str) -> RunConfig:
    return compose_settings(verb, f"method={method}")
