"""Fits of subjects: known poses are found from turned scans, cloth changes no shape, and nothing wrong goes unnamed."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar.body.families import fixed_family, smpl_family
from avatar.body.open import open_body
from avatar.checks import AvatarError
from avatar.fitting.matching import Registration, prepare_samples
from avatar.fitting.posing import Fit, PosedFamily
from avatar.fitting.settings import FittingConfig, StageConfig
from avatar.fitting.subjects import fit_subject
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.io.ledger import Ledger
from avatar.records import PointCloud
from avatar.simulate.angles import authored_motion

TURN = Rotation.from_euler("y", 222, degrees=True)
PLACE = np.array([0.4, 0.1, -2.0])
CLOTH = 0.02  # metres


def quick_config(**options):
    """Two headings, of which neither is the scan's, and few points."""
    coarse = StageConfig(points=200, steps=8, kept=2, reach=0.3, cloth=0.3, sigma=0.05)
    fine = StageConfig(points=600, steps=8, kept=1, reach=0.05, cloth=0.03, sigma=0.02)
    return FittingConfig(headings=4, stages=[coarse, fine], **options)


@pytest.fixture(scope="module")
def family():
    return fixed_family(open_body("female"))


@pytest.fixture(scope="module")
def walker(family):
    """A step of a walk, turned and moved: its scan of 4,000 points, its vertices and its rest pose."""
    pose = authored_motion("walk", seconds=1.5).poses[10]
    return scan_of(family.body(torch.zeros(0)), pose)


def scan_of(body, pose, count=4000, cloth=None):
    """Points on a posed body, turned and moved; ``cloth (V,)`` pushes vertices out along their normals, metres."""
    vertices = body(torch.from_numpy(pose)[None]).vertices[0].detach()
    skin = (TURN.apply(vertices.numpy()) + PLACE).astype(np.float32)
    if cloth is not None:
        vertices = vertices + cloth[:, None] * vertex_normals(vertices, body.faces)
    samples = sample_surface(vertices, body.faces, count, torch.Generator().manual_seed(0))
    normals = torch.nn.functional.normalize(interpolate(vertex_normals(vertices, body.faces), samples), dim=-1)
    points = TURN.apply(interpolate(vertices, samples).numpy()) + PLACE
    return PointCloud(points.astype(np.float32), TURN.apply(normals.numpy()).astype(np.float32)), skin


@pytest.fixture(scope="module")
def fitted(family, walker, tmp_path_factory):
    """The fit of two scans, the walker's and a block's, with the folder of its ledger."""
    folder = tmp_path_factory.mktemp("fit")
    scans = [walker[0], block()]
    return folder, scans, fit_subject(scans, family, quick_config(), ("walk", "block"), ledger=Ledger(folder))


def block():
    """Points on a block as high as a person."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (4000, 3))
    sides = rng.integers(0, 3, 4000)
    points[np.arange(4000), sides] = np.sign(points[np.arange(4000), sides])
    normals = np.zeros((4000, 3))
    normals[np.arange(4000), sides] = points[np.arange(4000), sides]
    return PointCloud((points * [0.4, 0.85, 0.3]).astype(np.float32), normals.astype(np.float32))


def test_a_known_pose_is_found_from_a_turned_scan(fitted, walker):
    _, _, found = fitted
    walk = found.frames[0]
    posed = found.body(torch.from_numpy(walk.pose)[None], torch.from_numpy(walk.translation)[None]).vertices[0]
    errors = np.linalg.norm(posed.detach().numpy() - walker[1], axis=1)
    assert np.median(errors) < 0.01 and walk.failed == ""
    assert abs((np.degrees(walk.heading) - 222 + 180) % 360 - 180) < 10


def test_a_scan_of_no_person_is_reported_as_failed(fitted):
    _, _, found = fitted
    assert found.failed == ("block",) and "head, hands and feet" in found.frames[1].failed


def test_a_resumed_fit_gives_the_same_bits_without_work(fitted, family, monkeypatch):
    folder, scans, found = fitted
    monkeypatch.setattr(Registration, "fit_one", None)
    again = fit_subject(scans, family, quick_config(), ("walk", "block"), ledger=Ledger(folder))
    for first, second in zip(found.frames, again.frames):
        assert np.array_equal(first.pose, second.pose) and np.array_equal(first.translation, second.translation)
        assert first.quality == second.quality and first.failed == second.failed


def test_a_sequence_goes_on_from_the_scan_before(family, walker, monkeypatch):
    scans = [walker[0], scan_of(family.body(torch.zeros(0)), authored_motion("walk", seconds=1.5).poses[11])[0]]
    starts, fit_one = [], Registration.fit_one

    def noted(self, scan, shape=None, start=None):
        starts.append(start is not None)
        return fit_one(self, scan, shape, start)

    monkeypatch.setattr(Registration, "fit_one", noted)
    found = fit_subject(scans, family, quick_config(sequence=True), progress=False)
    assert starts == [False, True] and found.failed == ()


@pytest.fixture(scope="module")
def clothed(person_folder):
    """Bodies of a file with one shape parameter, their size; a mean one's scan with cloth over its trunk and legs."""
    family = smpl_family(person_folder / "template.npz", 1)
    body = family.body(family.mean)
    bare = torch.zeros(len(body.bind_vertices))
    for joint in ("head", "neck", "left_wrist", "right_wrist", "left_elbow", "right_elbow", "left_foot", "right_foot"):
        bare += body.weights[:, body.joint_names.index(joint)]
    bare += body.weights[:, [body.joint_names.index(f"{side}_ankle") for side in ("left", "right")]].sum(dim=1)
    pose = authored_motion("walk", seconds=1.5).poses[0]
    return family, pose, scan_of(body, pose, cloth=CLOTH * (1 - bare).clamp(0, 1))


@pytest.mark.parametrize("clothing", [True, False])
def test_cloth_outside_the_skin_does_not_make_the_body_larger(clothed, clothing):
    """From the true pose; both sides costing alike, the body grows into the cloth."""
    family, pose, (cloud, skin) = clothed
    config = quick_config(clothing=clothing)
    turned = torch.from_numpy(pose.copy())
    turned[0] = torch.from_numpy((TURN * Rotation.from_rotvec(pose[0])).as_rotvec())
    start = Fit(turned[None], torch.zeros(1, 3), family.mean[None])
    start.translation[:] = torch.from_numpy(skin.mean(axis=0)) - PosedFamily(family, start).points()[0].mean(dim=0)
    with torch.no_grad():
        fit, _ = Registration(family, config).fit_one(prepare_samples(cloud, config), start=start)
    growth = float(fit.shape)  # of the size, 3% a standard deviation
    assert abs(growth) < 0.15 if clothing else growth > 0.3


def test_the_scan_in_minimal_clothing_gives_everyone_s_shape(clothed, monkeypatch):
    """It is taken for skin; a shape that is given is kept, and nothing estimated."""
    family, pose, (cloud, _) = clothed
    bare, _ = scan_of(family.body(family.mean), pose)
    seen, fit_shape = [], Registration.fit_shape

    def noted(self, scans, fit):
        seen.append((self.config.clothing, len(scans)))
        return fit_shape(self, scans, fit)

    monkeypatch.setattr(Registration, "fit_shape", noted)
    found = fit_subject([cloud, bare], family, quick_config(), minimal=[1], progress=False)
    assert seen == [(False, 1)] and abs(found.shape["beta0"]) < 0.2
    given = fit_subject([bare], family, quick_config(), shape=[0.5], progress=False)
    assert given.shape == {"beta0": 0.5} and len(seen) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, n: (p[:500], n[:500]), "one: expected at least 2000 points, got 500"),
        (lambda p, n: (np.where(np.arange(len(p))[:, None] == 7, np.nan, p), n), r"3 NaN or infinite .* \(7, 0\)"),
        (lambda p, n: (100 * p, n), "got a largest extent of 174.5. Hint: the unit may be cm"),
        (lambda p, n: (p, 0.3 * n), "one: expected unit normals, got lengths off by 0.7"),
    ],
)
def test_scans_that_cannot_be_fitted_are_refused_with_the_figure(family, walker, change, message):
    cloud = PointCloud(*change(walker[0].points, walker[0].normals))
    with pytest.raises(AvatarError, match=message):
        fit_subject([cloud], family, quick_config(), ("one",), progress=False)


def test_arguments_that_do_not_fit_are_refused(family, walker):
    with pytest.raises(AvatarError, match="scans: expected at least one"):
        fit_subject([], family, quick_config())
    with pytest.raises(AvatarError, match="minimal: expected numbers of scans below 1, got \\[3\\]"):
        fit_subject([walker[0]], family, quick_config(), minimal=[3])
    with pytest.raises(AvatarError, match="shape: expected 0 parameters, got 2"):
        fit_subject([walker[0]], family, quick_config(), shape=[1.0, 2.0])
    with pytest.raises(AvatarError, match="stages: expected at least one"):
        FittingConfig(stages=[])
    with pytest.raises(AvatarError, match="reach: expected above 0 and at most 1, got 0"):
        StageConfig(reach=0)
