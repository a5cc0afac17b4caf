"""The verbs on other people's data: what they print, write, refuse and leave out."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from avatar.body.packed import write_body
from avatar.checks import AvatarError, DataError
from avatar.data.layouts import open_outfit_folder
from avatar.export.rigged import write_rigged_glb
from avatar.fitting.quality import FitQuality
from avatar.fitting.subjects import FrameFit, SubjectFit
from avatar.geometry.trees import build_tree
from avatar.io.ledger import Ledger
from avatar.io.meshes import write_mesh
from avatar.io.points import write_points
from avatar.pipeline.intake import CheckConfig, InfoConfig, data_check, data_convert, data_fit, data_info
from avatar.records import Mesh, PointCloud
from avatar.sources import registered
from avatar.sources.conversion import ConvertConfig
from avatar.sources.registered import FitScansConfig, family_of, given_shape


@pytest.fixture(scope="module")
def scans(tiny_outfit, tmp_path_factory):
    """Folders of the tiny outfit's train frames: ``coat`` with a body and its parameters, ``bare`` in mm without."""
    folder = tmp_path_factory.mktemp("scans")
    write_body(folder / "coat" / "template.npz", tiny_outfit.body)
    for number, name in enumerate(tiny_outfit.frames("train")):
        frame = tiny_outfit.load("train", name)
        points, normals = frame.scan.points[::2], frame.scan.normals[::2]
        write_points(folder / f"coat/scan_{number}.ply", PointCloud(points, normals))
        write_points(folder / f"bare/scan_{number}.ply", PointCloud(1000 * points, normals))
        fit = {"poses": frame.body.pose.reshape(1, -1), "trans": frame.body.translation[None]}
        np.savez(folder / f"coat/scan_{number}.npz", **fit)
    return folder


def test_info_prints_one_screen(scans, tiny_folder, capsys):
    data_info(InfoConfig(source=scans / "coat"))
    fitted = capsys.readouterr().out
    data_info(InfoConfig(source=scans / "bare"))
    bare = capsys.readouterr().out
    data_info(InfoConfig(source=tiny_folder))
    own = capsys.readouterr().out
    assert "layout: plain" in fitted and "22 joints" in fitted and "frames: 5 train, 1 test" in fitted
    assert "units: mm" in bare and "body: none beside the scans. Hint: fit one: " in bare and "2,000 points" in bare
    assert "layout: this project" in own and max(map(len, (fitted, bare, own))) < 1000


def test_check_measures_frames_and_names_those_that_are_refused(scans, tmp_path, capsys):
    path = tmp_path / "out" / "check.csv"
    assert data_check(CheckConfig(source=scans / "coat", frames=None, out=path)) == [path]
    text = capsys.readouterr().out
    rows = list(csv.DictReader(path.open()))
    assert "points a scan: 2,000" in text and "refused" not in text and len(rows) == 6
    assert all(float(row["covered"]) > 0.9 and row["outfit"] == "coat" for row in rows)
    data_check(CheckConfig(source=scans / "bare", frames=2))
    text = capsys.readouterr().out
    assert "without a fitted body: 3 of 3 frames" in text and "frames: 5 train (2 looked at), 1 test\n" in text


def test_unknown_outfits_of_our_own_are_named(tiny_folder):
    with pytest.raises(AvatarError, match="outfits: expected one of tiny, got 'tinny'"):
        data_check(CheckConfig(source=tiny_folder.parent, outfits=["tinny"]))


def test_check_finds_copies_leaks_and_parts_without_a_scan(tiny_outfit, tmp_path, capsys):
    write_body(tmp_path / "coat" / "template.npz", tiny_outfit.body)
    names = tiny_outfit.frames("train")
    for split, number, name in (("train", 1, names[0]), ("train", 2, names[3]), ("test", 1, names[3])):
        frame = tiny_outfit.load("train", name)
        owner = tiny_outfit.template.joint_names.index("left_ankle")
        foot = tiny_outfit.template.weights.numpy().argmax(axis=1) >= owner
        ankle = frame.body.joint_transforms[owner, :3] @ [*tiny_outfit.template.joints[owner].numpy(), 1]
        kept = np.linalg.norm(frame.scan.points - ankle, axis=1) > (0.3 if foot.any() and number == 2 else 0)
        place = tmp_path / "coat" / split / f"scan_{number}"
        write_points(place.with_suffix(".ply"), PointCloud(frame.scan.points[kept], frame.scan.normals[kept]))
        np.savez(place.with_suffix(".npz"), poses=frame.body.pose.reshape(1, -1), trans=frame.body.translation[None])
    data_check(CheckConfig(source=tmp_path / "coat"))
    text = capsys.readouterr().out
    assert "one pose in two splits: train/scan_2 and test/test-scan_1, 0.000 rad apart" in text
    assert "without a scan: left_ankle in 1 of 3 frames" in text


def test_convert_writes_an_outfit_and_leaves_invalid_frames_out_where_asked(scans, tiny_outfit, tmp_path):
    config = ConvertConfig(source=scans / "coat", data_root=tmp_path / "data", name="coat")
    (folder,) = data_convert(config)
    outfit = open_outfit_folder(folder)
    frame, true = (
        outfit.load("train", outfit.frames("train")[1]),
        tiny_outfit.load("train", tiny_outfit.frames("train")[1]),
    )
    assert np.abs(frame.scan.points - true.scan.points[::2]).max() < 1e-6
    assert np.abs(frame.body.vertices - true.body.vertices).max() < 1e-6
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}
    data_convert(config)
    assert before == {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}
    spoilt = tmp_path / "spoilt"
    spoilt.mkdir()
    for path in (scans / "coat").iterdir():
        (spoilt / path.name).write_bytes(path.read_bytes())
    with np.load(spoilt / "scan_2.npz") as stored:
        np.savez(spoilt / "scan_2.npz", poses=stored["poses"] + 0.7, trans=stored["trans"])
    broken = replace(config, source=spoilt, name="broken")
    with pytest.raises(DataError, match="scan_2"):
        data_convert(broken)
    (folder,) = data_convert(replace(broken, skip_invalid=True))
    assert "scan.2" not in open_outfit_folder(folder).frames("train")
    assert '"train/scan.2": "' in (folder / "source.json").read_text()


def test_another_source_is_not_written_over_an_outfit(scans, tmp_path):
    config = ConvertConfig(source=scans / "coat", data_root=tmp_path, name="coat")
    data_convert(config)
    with pytest.raises(DataError, match="expected an outfit converted from"):
        data_convert(
            replace(config, source=scans / "bare", body=replace(config.body, path=scans / "coat/template.npz"))
        )
    with pytest.raises(DataError, match="expected a body beside the scans"):
        data_convert(replace(config, source=scans / "bare", name="other"))
    assert not (tmp_path / "mine" / "other").exists()


def test_fit_writes_the_fitted_body_its_report_and_leaves_failed_frames_out(
    scans, tiny_outfit, tmp_path, monkeypatch, caplog
):
    """The registration itself is replaced by the truth, one frame of it failing."""
    asked = []

    def fit_subject(clouds, family, config, names, minimal, shape, ledger):
        asked.append((len(clouds), names, minimal, isinstance(ledger, Ledger)))
        assert np.ptp(clouds[0].points[:, 1]) < 2.5  # metres
        quality = FitQuality(0.005, 0.02, 0.0, 0.001, 0.97, 80.0)
        frames = []
        for name, own in zip(names, tiny_outfit.frames("train")):
            body = tiny_outfit.load_body("train", own)
            failed = "the scan covers 60% of the body" if name == "scan.3" else ""
            frames.append(FrameFit(name, body.pose, body.translation, quality, failed))
        return SubjectFit({}, tiny_outfit.body, tuple(frames))

    monkeypatch.setattr(registered, "fit_subject", fit_subject)
    config = FitScansConfig(source=scans / "bare", data_root=tmp_path, name="coat", minimal=["scan.1"], pictures=1)
    config = replace(config, body=replace(config.body, path=scans / "coat" / "template.npz"))
    (folder,) = data_fit(config)
    assert asked == [(6, [f"scan.{number}" for number in range(6)], [1], True)]
    outfit = open_outfit_folder(folder)
    assert outfit.frames("train") == ("scan.0", "scan.1", "scan.2", "scan.4") and outfit.frames("test") == ("scan.5",)
    true = tiny_outfit.load("train", tiny_outfit.frames("train")[4])
    assert np.abs(outfit.load("train", "scan.4").body.vertices - true.body.vertices).max() < 1e-5
    assert "no body fits scan.3" in caplog.text and "scan.3" in (folder / "fits" / "fits.md").read_text()
    assert len(list((folder / "fits").glob("*.png"))) == 1
    with pytest.raises(AvatarError, match=r"minimal: expected one of scan\.0, "):
        data_fit(replace(config, minimal=["scan_1"]))


def test_a_body_is_fitted_to_the_meshes_of_another_models_bodies(scans, tiny_outfit, tmp_path, monkeypatch):
    """Their skin is what is fitted, not the cloth of the scans over it; a frame without one is named."""
    folder = tmp_path / "scans"
    folder.mkdir()
    faces = tiny_outfit.template.faces.numpy()
    for number, name in enumerate(tiny_outfit.frames("train")[:3]):
        (folder / f"scan_{number}.ply").write_bytes((scans / f"bare/scan_{number}.ply").read_bytes())
        body = Mesh(1000 * tiny_outfit.load_body("train", name).vertices, faces[:, [1, 2, 0]])
        write_mesh(folder / f"scan_{number}_smpl.obj", body)
    seen = []

    def fit_subject(clouds, family, config, *others):
        seen.append(config.clothing)
        true = tiny_outfit.load_body("train", tiny_outfit.frames("train")[1]).vertices
        gaps = build_tree(true).query(clouds[1].points)[0]
        assert len(gaps) == registered.SAMPLES and np.median(gaps) < 0.01 and gaps.max() < 0.05
        raise AvatarError("stopped here")

    monkeypatch.setattr(registered, "fit_subject", fit_subject)
    monkeypatch.setattr(registered, "family_of", lambda config: None)
    for missing in (False, True):
        if missing:
            (folder / "scan_1_smpl.obj").unlink()
        with pytest.raises(AvatarError, match="scan_1.*expected the mesh of a body" if missing else "stopped here"):
            data_fit(FitScansConfig(source=folder, data_root=tmp_path / "data", name="coat"))
    assert seen == [False, False]


def test_the_family_and_shape_that_are_fitted_follow_from_the_body_file(scans, person_folder, tiny_outfit, tmp_path):
    fixed = ConvertConfig(body=replace(ConvertConfig().body, path=scans / "coat" / "template.npz"))
    smpl = ConvertConfig(body=replace(ConvertConfig().body, path=person_folder / "template.npz"))
    assert family_of(fixed).names == () and len(family_of(smpl).names) > 0
    rigged = tmp_path / "person.glb"
    write_rigged_glb(rigged, tiny_outfit.body)
    assert family_of(replace(fixed, body=replace(fixed.body, path=rigged))).names == ()
    few = replace(smpl, body=replace(smpl.body, betas=[0.5]))
    assert given_shape(smpl, family_of(smpl)) is None
    assert given_shape(few, family_of(few)) == [0.5] + [0.0] * (len(family_of(few).names) - 1)
    for config in (
        ConvertConfig(body=replace(few.body, path=None)),
        replace(fixed, body=replace(fixed.body, betas=[1.0])),
    ):
        with pytest.raises(AvatarError, match=r"body\.betas: expected at most 0 numbers .* got 1\. Hint: "):
            given_shape(config, family_of(config))
