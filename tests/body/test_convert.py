"""The converter: faithful to good files, and nothing in a hostile one is ever run."""

import builtins
import io
import os
import pickle
import subprocess
import sys
import tracemalloc
import types
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import torch
from bodies import distinct, random_model, write_unwrapped

from avatar.body.inert_pickle import read_pickled_arrays
from avatar.body.open import open_body
from avatar.body.packed import packed_body, write_template
from avatar.body.smpl import convert_body_model, joint_tree, smpl_body
from avatar.checks import AvatarError, DataError
from avatar.cli import start
from avatar.nn.atlas import Atlas
from avatar.verbs import VERBS

PROTOCOLS = range(6)


@pytest.fixture
def chumpy(monkeypatch):
    """Modules of chumpy's names, so that pickles can be written as chumpy's users wrote them."""

    class Ch:
        def __init__(self, **state):
            self.__dict__.update(state)

    class Select(Ch):
        pass

    for module, kind in (("chumpy.ch", Ch), ("chumpy.reordering", Select)):
        kind.__module__, kind.__qualname__ = module, kind.__name__
        fake = types.ModuleType(module)
        setattr(fake, kind.__name__, kind)
        monkeypatch.setitem(sys.modules, module, fake)
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    return types.SimpleNamespace(Ch=Ch, Select=Select)


def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as stored:
        return dict(stored)


def check_faithful(path: Path, kind: str, model: dict, components: int = 10) -> None:
    plain = load(path)
    for key in ("v_template", "J_regressor", "weights", "posedirs"):
        np.testing.assert_array_equal(plain[key], model[key].astype(np.float32))
    np.testing.assert_array_equal(plain["shapedirs"], model["shapedirs"][..., :components].astype(np.float32))
    np.testing.assert_array_equal(plain["faces"], model["f"])
    assert tuple(plain["parents"]) == joint_tree(kind)[1] and tuple(plain["joint_names"]) == joint_tree(kind)[0]
    assert plain["kind"] == [kind] and not any(array.dtype.hasobject for array in plain.values())


@pytest.mark.parametrize("kind", ["smpl", "smplh", "smplx"])
@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_good_files_convert_faithfully(kind, suffix, tmp_path):
    model, source = vars(random_model(kind)), tmp_path / f"model{suffix}"
    if suffix == ".npz":
        np.savez(source, **model)
    else:
        source.write_bytes(pickle.dumps(model))
    assert convert_body_model(source, tmp_path / "plain.npz") == kind
    check_faithful(tmp_path / "plain.npz", kind, model)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("compress", [scipy.sparse.csc_matrix, scipy.sparse.csr_matrix])
def test_pickles_as_smpl_has_them(compress, protocol, chumpy, tmp_path):
    """Sparse regressor, chumpy arrays plain and selected, Fortran order, and things no one needs."""
    model = vars(random_model("smpl"))
    wide = np.concatenate([model["shapedirs"], model["shapedirs"] + 1], axis=-1)
    entries = np.arange(wide.size).reshape(wide.shape)[..., :10]
    shaped = chumpy.Select(a=chumpy.Ch(x=wide), idxs=entries.ravel(), preferred_shape=entries.shape)
    stored = {
        **model,
        "J_regressor": compress(model["J_regressor"]),
        "v_template": chumpy.Ch(x=model["v_template"]),
        "shapedirs": shaped,
        "weights": np.asfortranarray(model["weights"]),
        "posedirs": model["posedirs"].astype(">f8"),
        "bs_type": "lrotmin",
        "names": np.array(["a", None], dtype=object),
        "scalar": np.float64(3.0),
        "unused": chumpy.Ch(x=chumpy.Ch(x=np.zeros(3))),
    }
    (tmp_path / "model.pkl").write_bytes(pickle.dumps(stored, protocol=protocol))
    convert_body_model(tmp_path / "model.pkl", tmp_path / "plain.npz")
    check_faithful(tmp_path / "plain.npz", "smpl", model)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_numbers_and_text_beside_arrays_are_read(protocol, tmp_path):
    stored = {"scale": np.float32(0.8), "count": 3, "gender": "female", "names": ["a", "b"], "big": np.float64(2)}
    (tmp_path / "fit.pkl").write_bytes(pickle.dumps(stored, protocol=protocol))
    found = read_pickled_arrays(tmp_path / "fit.pkl", ("scale",), ("count", "gender", "big", "none"))
    assert {key: value.item() for key, value in found.items()} == {key: stored[key] for key in found}
    assert found["scale"].dtype == np.float32 and set(found) == {"scale", "count", "gender", "big"}
    with pytest.raises(DataError, match="names: expected an array of numbers"):
        read_pickled_arrays(tmp_path / "fit.pkl", ("names",))
    with pytest.raises(DataError, match="expected the keys scale, pose, it lacks pose"):
        read_pickled_arrays(tmp_path / "fit.pkl", ("scale", "pose"))


def test_pickles_of_python_2(tmp_path):
    """Its buffers are byte strings, its module names old: a pickle of protocol 2 written out by hand."""
    model = vars(random_model("smpl"))
    out = io.BytesIO()

    def text(value: str) -> bytes:
        return b"U" + bytes([len(value)]) + value.encode()  # SHORT_BINSTRING, as only Python 2 writes it

    def array(value: np.ndarray) -> bytes:
        raw = value.tobytes()
        make = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85" + text("b") + b"\x87R"
        dtype = b"cnumpy\ndtype\n" + text(value.dtype.str[1:]) + b"K\x00K\x01\x87R"
        dtype += b"(K\x03" + text("<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        shape = b"(" + b"".join(b"M" + size.to_bytes(2, "little") for size in value.shape) + b"t"
        return make + b"(K\x01" + shape + dtype + b"\x89T" + len(raw).to_bytes(4, "little") + raw + b"tb"

    out.write(b"\x80\x02}(")
    for key, value in model.items():
        if key == "v_template":  # copy_reg._reconstructor(chumpy.ch.Ch, object, None), then its state
            state = b"}" + text("x") + array(value) + b"s"
            value = b"ccopy_reg\n_reconstructor\ncchumpy.ch\nCh\nc__builtin__\nobject\nN\x87R" + state + b"b"
            out.write(text(key) + value)
        else:
            out.write(text(key) + array(value))
    out.write(b"u.")
    (tmp_path / "model.pkl").write_bytes(out.getvalue())
    convert_body_model(tmp_path / "model.pkl", tmp_path / "plain.npz")
    check_faithful(tmp_path / "plain.npz", "smpl", model)


def test_smplx_files_lose_their_expressions_and_their_object_arrays_stay_unread(tmp_path):
    model = vars(random_model("smplx", components=20))
    np.savez(tmp_path / "model.npz", **model, part2num=np.array({"hip": 1}, dtype=object))
    assert convert_body_model(tmp_path / "model.npz", tmp_path / "plain.npz") == "smplx"
    check_faithful(tmp_path / "plain.npz", "smplx", model, components=10)


class Payload:
    """Pickles as a call."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def payloads(canary: Path) -> dict[str, bytes]:
    """Hostile pickles by name; each would make the canary file if it were run."""
    touch = f"touch {canary}"
    opened = f"open({str(canary)!r}, 'w')"
    model = vars(random_model("smpl"))
    line = touch.encode()
    nested = {**model, "extra": [{"deep": (Payload(os.system, touch),)}]}
    in_state = {**model, "weights": np.array([Payload(os.system, touch)], dtype=object)}
    return {
        "os.system": pickle.dumps(Payload(os.system, touch)),
        "builtins.eval": pickle.dumps(Payload(builtins.eval, opened)),
        "builtins.exec": pickle.dumps(Payload(builtins.exec, opened)),
        "open": pickle.dumps(Payload(open, str(canary), "w")),
        "path touch": pickle.dumps(Payload(Path.touch, canary)),
        "subprocess": pickle.dumps(Payload(subprocess.check_call, ["touch", str(canary)])),
        "nested": pickle.dumps(nested),
        "in an object array": pickle.dumps(in_state),
        "protocol 0": pickle.dumps(Payload(os.system, touch), protocol=0),
        "__main__": b"c__main__\nsystem\n(V" + line + b"\ntR.",
        "__builtin__": b"c__builtin__\neval\n(V" + opened.encode() + b"\ntR.",
        "inst": b"(V" + line + b"\nios\nsystem\n.",
        "obj": b"(cos\nsystem\nV" + line + b"\no.",
        "newobj": b"\x80\x02cos\nsystem\nV" + line + b"\n\x85\x81.",
        "stack global": b"\x80\x04\x8c\x05posix\x8c\x06system\x93\x8c" + bytes([len(line)]) + line + b"\x85R.",
        "chumpy module": b"cchumpy\nos.system\n(V" + line + b"\ntR.",
        "chumpy attribute": b"\x80\x04\x8c\x09chumpy.ch\x8c\x0cnp.os.system\x93.",
        "chumpy class": b"cchumpy.ch\nMatVecMult\n(V" + line + b"\ntR.",
        "numpy attribute": b"\x80\x04\x8c\x05numpy\x8c\x09os.system\x93.",
        "numpy function": b"cnumpy\nfromfile\n(V" + str(canary).encode() + b"\ntR.",
        "stand-in name": b"cavatar.body.convert\nInert\n)R.",
        "getattr": b"c__builtin__\ngetattr\n(cos\nsystem\ntR.",
        "reconstructor of a stranger": b"ccopy_reg\n_reconstructor\n(cos\nsystem\nc__builtin__\nobject\nNtR.",
        "extension": b"\x80\x02\x82\x01.",
        "persistent": b"Pos.system\n.",
        "state of a stand-in class": b"cchumpy.ch\nCh\n}Varray\ncos\nsystem\nsb.",
    }


def test_every_payload_would_run_when_trusted(tmp_path):
    """The canary works: a plain unpickler does run these."""
    canary = tmp_path / "canary"
    for name in ("os.system", "builtins.eval", "nested", "protocol 0", "stack global", "obj"):
        pickle.loads(payloads(canary)[name])
        assert canary.exists(), name
        canary.unlink()


@pytest.mark.parametrize("name", payloads(Path("none")))
def test_hostile_pickles_are_refused_and_nothing_runs(name, tmp_path):
    canary = tmp_path / "canary"
    (tmp_path / "model.pkl").write_bytes(payloads(canary)[name])
    with pytest.raises(DataError, match=r"model\.pkl"):
        convert_body_model(tmp_path / "model.pkl", tmp_path / "plain.npz")
    assert not canary.exists() and not (tmp_path / "plain.npz").exists()


def test_refusals_name_what_was_refused(tmp_path):
    (tmp_path / "model.pkl").write_bytes(pickle.dumps(Payload(os.system, "true")))
    with pytest.raises(DataError, match=r"refused posix\.system"):
        convert_body_model(tmp_path / "model.pkl", tmp_path / "plain.npz")


@pytest.mark.parametrize("key", ["v_template", "part2num"])
def test_hostile_npz_runs_nothing(key, tmp_path):
    """An object array in a key that is needed is refused; in another it is never read."""
    canary = tmp_path / "canary"
    hostile = np.array([Payload(os.system, f"touch {canary}")], dtype=object)
    np.savez(tmp_path / "model.npz", **{**vars(random_model("smpl")), key: hostile})
    if key == "v_template":
        with pytest.raises(DataError, match=r"model\.npz: v_template"):
            convert_body_model(tmp_path / "model.npz", tmp_path / "plain.npz")
    else:
        convert_body_model(tmp_path / "model.npz", tmp_path / "plain.npz")
        assert "part2num" not in load(tmp_path / "plain.npz")
    assert not canary.exists()


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_truncated_files_are_refused(suffix, tmp_path):
    source = tmp_path / f"model{suffix}"
    model = vars(random_model("smpl"))
    if suffix == ".npz":
        np.savez(source, **model)
    else:
        source.write_bytes(pickle.dumps(model))
    whole = source.read_bytes()
    for share in (0.0, 0.01, 0.3, 0.7, 0.99):
        source.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(DataError, match=rf"model\{suffix}"):
            convert_body_model(source, tmp_path / "plain.npz")


@pytest.mark.parametrize(
    "data",
    [
        b"\x80\x02]r\xff\xff\xff\x03.",  # a memo of a gigabyte
        b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x00.",  # bytes without end
        b"\x80\x04" + b"(" * 100_000,
        b"]" * 5000 + b"a" * 4999 + b".",
        b"I1\n.",
        b"}.",
    ],
)
def test_pickles_that_mean_to_exhaust_are_refused_in_little_memory(data, tmp_path):
    (tmp_path / "model.pkl").write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"model\.pkl"):
            convert_body_model(tmp_path / "model.pkl", tmp_path / "plain.npz")
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()


def test_sparse_matrices_whose_entries_lie_elsewhere_are_refused(tmp_path):
    """Each in a process of its own: scipy would read and write where they lead."""
    elsewhere = [
        ("indptr", [0, 300_000_000, 0]),  # as many entries as there are none of
        ("indptr", [0, 5, -1]),
        ("indptr", [0, 2**40, 2**40]),
        ("indices", [0, 300_000_000]),
        ("indices", [0, -300_000_000]),
    ]
    model = vars(random_model("smpl"))
    for compress, (number, (key, values)) in product(
        (scipy.sparse.csc_matrix, scipy.sparse.csr_matrix), enumerate(elsewhere)
    ):
        matrix = compress(model["J_regressor"])
        setattr(matrix, key, np.concatenate([values, getattr(matrix, key)[len(values) :]]).astype(np.int64))
        path = tmp_path / f"{matrix.format}_{number}.pkl"
        path.write_bytes(pickle.dumps({**model, "J_regressor": matrix}))
    code = (
        "import os, sys\n"
        "from avatar.body.smpl import convert_body_model\n"
        "for path in sys.argv[1:]:\n"
        "    child = os.fork()\n"
        "    if not child:\n"
        "        os.dup2(os.open(path + '.err', os.O_WRONLY | os.O_CREAT), 2)\n"
        "        convert_body_model(path, path + '.npz')\n"
        "        sys.exit(0)\n"
        "    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)\n"
    )
    paths = sorted(map(str, tmp_path.glob("*.pkl")))
    done = subprocess.run([sys.executable, "-c", code, *paths], capture_output=True, text=True, timeout=300)
    codes = dict(zip(paths, map(int, done.stdout.split()), strict=True))
    assert len(codes) == 10 and done.returncode == 0, done.stderr
    for path, ended in codes.items():
        said = Path(f"{path}.err").read_text()
        assert ended == 1 and "DataError" in said and Path(path).name in said, (path, ended, said)


def test_mutated_pickles_give_one_kind_of_error(tmp_path):
    """Flipped bytes: the file converts, or it is refused by name; nothing else comes out."""
    whole = pickle.dumps({**vars(random_model("smpl")), "J_regressor": scipy.sparse.csc_matrix(np.eye(24, 40))})
    rng = np.random.default_rng(0)
    small = len(whole) - sum(value.nbytes for value in vars(random_model("smpl")).values())
    assert small < 0.1 * len(whole)
    heads = np.flatnonzero([byte in whole[:200] for byte in whole])  # mostly opcodes and headers
    for _ in range(100):
        damaged = bytearray(whole)
        for place in rng.choice(heads, 20):
            damaged[place] = rng.integers(256)
        (tmp_path / "model.pkl").write_bytes(bytes(damaged))
        try:
            convert_body_model(tmp_path / "model.pkl", tmp_path / "plain.npz")
        except DataError as error:
            assert "model.pkl" in str(error)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": None}, "weights"),
        ({"v_template": np.zeros((40, 2))}, "v_template: expected shape"),
        ({"weights": np.zeros((40, 23))}, "weights: expected shape"),
        ({"posedirs": np.zeros((40, 3, 7))}, "posedirs: expected shape"),
        ({"v_template": np.full((40, 3), np.nan)}, "v_template: expected finite"),
        ({"v_template": np.array([["a"] * 3] * 40)}, "v_template"),
        ({"kintree_table": np.full((2, 24), np.nan)}, "kintree_table: expected"),
        ({"f": np.full((30, 3), np.nan)}, "f: expected"),
        ({"kintree_table": np.zeros((2, 24), np.uint32)}, "kintree_table: expected the joints of"),
    ],
)
@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_files_of_something_else_are_refused(changes, message, suffix, tmp_path):
    model = {key: value for key, value in {**vars(random_model("smpl")), **changes}.items() if value is not None}
    source = tmp_path / f"model{suffix}"
    if suffix == ".npz":
        np.savez(source, **model)
    else:
        source.write_bytes(pickle.dumps(model))
    with pytest.raises(DataError, match=message) as caught:
        convert_body_model(source, tmp_path / "plain.npz")
    assert source.name in str(caught.value)


def test_paths_are_checked(tmp_path):
    with pytest.raises(DataError, match="there is none"):
        convert_body_model(tmp_path / "none.pkl", tmp_path / "plain.npz")
    with pytest.raises(DataError, match=r"expected a \.npz or \.pkl"):
        convert_body_model(tmp_path / "model.fbx", tmp_path / "plain.npz")
    with pytest.raises(AvatarError, match="target"):
        convert_body_model(tmp_path / "model.npz", tmp_path / "plain.pkl")


def test_command_line(tmp_path, monkeypatch, capsys):
    np.savez(tmp_path / "model.npz", **vars(random_model("smplh")))

    def run(*paths: Path) -> None:
        monkeypatch.setattr(sys, "argv", ["convert_body", *map(str, paths)])
        start("convert_body", VERBS["convert_body"])

    run(tmp_path / "model.npz", tmp_path / "plain.npz")
    assert "smplh body" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        run(tmp_path / "none.npz", tmp_path / "plain.npz")
    assert "none.npz: expected an npz file" in capsys.readouterr().err


def unwrapped(model: dict, places: np.ndarray) -> dict:
    """SMPL-X's own atlas: every corner of every triangle has a place of its own."""
    return model | {"vt": places, "ft": np.arange(model["f"].size).reshape(-1, 3)}


@pytest.fixture
def places() -> np.ndarray:
    return np.random.default_rng(3).random((90, 2))


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
@pytest.mark.parametrize("kind", [np.uint32, np.float64])
def test_smplx_files_bring_their_own_atlas(suffix, kind, places, tmp_path):
    model, source = unwrapped(vars(random_model("smplx")), places), tmp_path / f"model{suffix}"
    model["ft"] = model["ft"].astype(kind)
    if suffix == ".npz":
        np.savez(source, **model)
    else:
        source.write_bytes(pickle.dumps(model))
    convert_body_model(source, tmp_path / "plain.npz")
    body = smpl_body(tmp_path / "plain.npz")
    assert body.template.uv.numpy()[body.template.uv_faces].shape == (30, 3, 2)
    np.testing.assert_array_equal(body.template.uv.numpy(), places.astype(np.float32))
    assert smpl_body(tmp_path / "plain.npz", canonical_pose=torch.ones(22, 3)).template.uv_faces is not None


def test_smpl_files_take_an_atlas_from_an_obj_of_their_mesh(places, tmp_path):
    model = distinct(vars(random_model("smpl")))
    (tmp_path / "model.pkl").write_bytes(pickle.dumps(model))
    obj = write_unwrapped(tmp_path / "uv.obj", model, places)
    assert convert_body_model(tmp_path / "model.pkl", tmp_path / "plain.npz", obj) == "smpl"
    template = smpl_body(tmp_path / "plain.npz").template
    np.testing.assert_allclose(template.uv[template.uv_faces].numpy(), places.reshape(30, 3, 2), atol=1e-6)
    convert_body_model(tmp_path / "model.pkl", tmp_path / "bare.npz")
    assert smpl_body(tmp_path / "bare.npz").template.uv is None


def test_a_given_obj_comes_before_the_files_own_atlas(places, tmp_path):
    model = distinct(vars(random_model("smplx")))
    np.savez(tmp_path / "model.npz", **unwrapped(model, places) | {"ft": np.full((30, 3), 90)})  # which is unsound
    obj = write_unwrapped(tmp_path / "uv.obj", model, 1 - places)
    convert_body_model(tmp_path / "model.npz", tmp_path / "plain.npz", obj)
    template = smpl_body(tmp_path / "plain.npz").template
    np.testing.assert_allclose(template.uv[template.uv_faces].numpy(), 1 - places.reshape(30, 3, 2), atol=1e-6)


def test_any_template_of_ours_takes_an_atlas_from_an_obj_through_the_command(tmp_path, monkeypatch, capsys):
    body = open_body("female").template
    bare = replace(body, uv=None, uv_faces=None)
    write_template(tmp_path / "template.npz", bare)
    lines = [f"v {x} {y} {z}" for x, y, z in body.vertices.tolist()] + [f"vt {u:.9f} {v:.9f}" for u, v in body.uv]
    for face, corners in zip(body.faces.tolist(), body.uv_faces.tolist()):
        lines.append("f " + " ".join(f"{v + 1}/{c + 1}" for v, c in zip(face, corners)))
    (tmp_path / "body.obj").write_text("\n".join(lines))
    command = ["convert_body.py", "template.npz", "with_uv.npz", "--uv", "body.obj"]
    monkeypatch.setattr(sys, "argv", command)
    monkeypatch.chdir(tmp_path)
    start("convert_body", VERBS["convert_body"])
    assert "packed body" in capsys.readouterr().out
    found = packed_body(tmp_path / "with_uv.npz").template
    torch.testing.assert_close(found.uv[found.uv_faces], body.uv[body.uv_faces])
    torch.testing.assert_close(found.vertices, body.vertices)
    samples = Atlas(found, 64).pixel_points(2000)
    torch.testing.assert_close(samples.vertex_ids, Atlas(body, 64).pixel_points(2000).vertex_ids)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ft": np.full((30, 3), 90)}, r"uv_faces: expected indices in \[0, 90\)"),
        ({"ft": np.arange(87).reshape(29, 3)}, "ft"),
        ({"ft": np.full((30, 3), 0.5)}, "ft: expected whole numbers"),
        ({"vt": np.full((90, 3), 0.5)}, "vt"),
    ],
)
def test_atlases_that_do_not_fit_their_model_are_refused(change, message, places, tmp_path):
    np.savez(tmp_path / "model.npz", **unwrapped(vars(random_model("smplx")), places) | change)
    with pytest.raises(DataError, match=rf"model\.npz.*{message}"):
        convert_body_model(tmp_path / "model.npz", tmp_path / "plain.npz")
    assert not (tmp_path / "plain.npz").is_file()


def test_an_obj_that_is_not_the_models_is_refused_with_the_mend(places, tmp_path):
    model = distinct(vars(random_model("smpl")))
    np.savez(tmp_path / "model.npz", **model)
    obj = write_unwrapped(tmp_path / "uv.obj", model | {"v_template": np.zeros((41, 3))}, places)
    with pytest.raises(DataError, match=r"uv\.obj.*40 vertices, got 41.*UV template of this body model"):
        convert_body_model(tmp_path / "model.npz", tmp_path / "plain.npz", obj)
    (tmp_path / "bare.obj").write_text("v 0 0 0\n" * 40 + "f 1 2 3\n")
    with pytest.raises(DataError, match=r"bare\.obj.*no texture coordinates.*vt"):
        convert_body_model(tmp_path / "model.npz", tmp_path / "plain.npz", tmp_path / "bare.obj")
    assert not (tmp_path / "plain.npz").is_file()
