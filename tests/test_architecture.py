"""The arrows of docs/design.md, read from the imports, and what no file of the package may do.

A room may import itself and the rooms below it. Rooms of one layer may import each other, but in layer 3, where
they are strangers; no arrow may close a circle of modules.
"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "avatar"
LAYERS = {
    "records": 0,
    "checks": 0,
    "declared": 0,
    "settings": 0,
    "values": 0,
    "environment": 0,
    "invocation": 0,
    "progress": 0,
    "processes": 0,
    "verbs": 0,
    "geometry": 1,
    "io": 2,
    "body": 2,
    "data": 3,
    "simulate": 3,
    "canonical": 3,
    "nn": 3,
    "implicit": 3,
    "training": 4,
    "export": 4,
    "evaluation": 4,
    "pipeline": 5,
    "config": 6,
    "arguments": 6,
    "cli": 6,
    "help": 6,
    "__main__": 6,
    "plain_verbs": 6,
}
STRANGERS = 3  # the layer whose rooms do not import each other
FORBIDDEN = {("evaluation", "nn"), ("evaluation", "training")}
ONLY_IN = {  # package: the rooms that may name it at all
    "hydra": {"config", "arguments"},
    "omegaconf": {"config", "arguments"},
    "open3d": {"export"},
    "newton": {"simulate"},
    "warp": {"simulate"},
    "triton": {"geometry"},
    "anny": {"body"},
    "smplx": set(),
}
# Triton is not among them, for torch loads it where it is installed.
LAZY = {*ONLY_IN, "roma", "pyvista", "pygltflib", "pxr", "matplotlib", "skimage", "tensorboard"} - {"triton"}
KERNELS = {"avatar.simulate.kernels": "warp"}  # decorators need it at the top; itself imported inside functions only
IMPORTERS = ("require", "import_module", "__import__")
RESTRICTED = PACKAGE / "body" / "inert_pickle.py"
DECLARED = PACKAGE / "declared.py"  # executes statements of the package's own sources, as importing them would
# What builds a tree by default, which on some points never ends where denormals count as zero (geometry/trees.py)
TREES = {
    *("KDTree", "cKDTree", "kdtree", "BallTree", "NearestNeighbors", "KNeighborsClassifier", "KNeighborsRegressor"),
    *("griddata", "NearestNDInterpolator", "RBFInterpolator", "ProximityQuery", "proximity", "registration"),
    *("sample_surface_even", "remove_close", "clusters", "group_distance"),
}
TREE_BUILDERS = {
    "avatar/geometry/trees.py": "the one builder",
    "avatar/pipeline/benchmarks/search.py": "scipy as it comes is what is measured, on clouds that are always the same",
}


def room_of(path: Path) -> str:
    """The room a file of the package stands in."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def module_of(path: Path) -> str:
    """The dotted name of a file of the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.AST, module: str, package: bool) -> list[tuple[int, str]]:
    """Line and dotted name of all a file imports, inside functions too, `require("name")` included."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = module.split(".")[: len(module.split(".")) - node.level + package]
                base = ".".join([*parents, base]).rstrip(".")
            found += [(node.lineno, f"{base}.{alias.name}") for alias in node.names]
        elif isinstance(node, ast.Call) and name_of(node.func).rpartition(".")[2] in IMPORTERS:
            found += [(node.lineno, str(word.value)) for word in node.args[:1] if isinstance(word, ast.Constant)]
    return found


def name_of(node: ast.AST) -> str:
    """``a.b.c`` of a chain of attributes, and ``?.b.c`` where it starts from an expression."""
    if isinstance(node, ast.Attribute):
        return f"{name_of(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


def sources(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def arrow_faults(path: Path, tree: ast.Module) -> list[str]:
    """Imports of a file of the package that no arrow allows."""
    room, faults = room_of(path), []
    if room == "__init__":
        names = {name for _, name in imported(tree, "avatar", True)} - {"os", "sys"}
        return [f"avatar/__init__.py imports {name}" for name in sorted(names)]
    for line, name in imported(tree, module_of(path), path.name == "__init__.py"):
        first, _, rest = name.partition(".")
        other = rest.partition(".")[0]
        if first == "avatar" and other in LAYERS and other != room:
            up = LAYERS[other] > LAYERS.get(room, 0)
            strange = LAYERS[other] == LAYERS.get(room, 0) == STRANGERS
            if up or strange or (room, other) in FORBIDDEN:
                faults.append(f"{path.relative_to(ROOT)}:{line}: {room} imports {name}")
        if first in ONLY_IN and room not in ONLY_IN[first]:
            faults.append(f"{path.relative_to(ROOT)}:{line}: {room} imports {first}")
    return faults


def careless_calls(tree: ast.Module) -> list[tuple[int, str]]:
    """Line and description of calls that could run what a file or an argument holds."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in ("pickle", "cPickle", "dill", "marshal", "shelve"):
            found.append((node.lineno, f"from {node.module}"))
        if not isinstance(node, ast.Call):
            continue
        name, given = name_of(node.func), {word.arg: word.value for word in node.keywords}

        def is_true(word: str, given: dict = given) -> bool:
            return word in given and getattr(given[word], "value", "unknown") is not False

        safe_loader = "Safe" in name_of(given.get("Loader", ast.Constant(0)))
        careless = {
            "torch.load without weights_only=True": name == "torch.load"
            and getattr(given.get("weights_only"), "value", None) is not True,
            "allow_pickle": is_true("allow_pickle"),
            "a pickle read": name.startswith(("pickle.", "dill.", "marshal.", "shelve."))
            and name.rpartition(".")[2] in ("load", "loads", "Unpickler", "_Unpickler", "open"),
            "yaml without the safe loader": name in ("yaml.load", "yaml.unsafe_load", "yaml.full_load")
            and not safe_loader,
            f"{name}()": name in ("eval", "exec", "os.system", "os.popen"),
            "extractall": name.endswith(".extractall"),
            "shell=True": is_true("shell"),
        }
        found += [(node.lineno, what) for what, there in careless.items() if there]
    return found


def test_every_room_has_its_layer():
    rooms = {room_of(path) for path in sources("avatar")} - {"__init__", "assets"}
    assert rooms <= set(LAYERS), f"give a layer to {rooms - set(LAYERS)}"


@pytest.mark.parametrize("path", sources("avatar"), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(path):
    assert arrow_faults(path, parse(path)) == []


def test_no_circle_of_modules():
    """Imports at the top of a file must have an order; those inside functions wait until all is loaded."""
    modules = {module_of(path): path for path in sources("avatar")}
    waiting = {}
    for module, path in modules.items():
        top = ast.Module([node for node in parse(path).body if isinstance(node, (ast.Import, ast.ImportFrom))], [])
        names = {name for _, name in imported(top, module, path.name == "__init__.py")}
        waiting[module] = {other for name in names for other in (name, name.rpartition(".")[0]) if other in modules}
        waiting[module] -= {module}
    while ready := [module for module, needs in waiting.items() if not needs & waiting.keys()]:
        for module in ready:
            del waiting[module]
    assert not waiting, f"these import each other: {', '.join(sorted(waiting))}"


@pytest.mark.parametrize("path", sources("avatar", "tools"), ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_read_is_ever_run(path):
    if path not in (RESTRICTED, DECLARED):
        assert careless_calls(parse(path)) == []


def test_the_restricted_unpickler_finds_no_class_but_its_own():
    tree = parse(RESTRICTED)
    assert careless_calls(tree) == []  # it subclasses the unpickler, and never calls one that is not restricted
    kinds = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "InertUnpickler"]
    finders = [node for node in kinds[0].body if isinstance(node, ast.FunctionDef)]
    assert [node.name for node in finders] == ["find_class"]
    assert "super" not in ast.dump(finders[0]) and "import" not in ast.dump(finders[0])


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("torch.load(path)", True),
        ("torch.load(path, weights_only=False)", True),
        ("torch.load(path, weights_only=True)", False),
        ("np.load(path, allow_pickle=True)", True),
        ("np.load(path, allow_pickle=flag)", True),
        ("np.load(path, allow_pickle=False)", False),
        ("pickle.load(stream)", True),
        ("pickle.Unpickler(stream).load()", True),
        ("from pickle import load", True),
        ("pickle.dumps(value)", False),
        ("yaml.load(text)", True),
        ("yaml.load(text, Loader=yaml.SafeLoader)", False),
        ("yaml.safe_load(text)", False),
        ("eval(text)", True),
        ("model.eval()", False),
        ("build(model).eval()", False),
        ("exec(text)", True),
        ("archive.extractall(folder)", True),
        ("subprocess.run(line, shell=True)", True),
        ("subprocess.run([line])", False),
    ],
)
def test_careless_calls_are_seen(line, fault):
    assert bool(careless_calls(ast.parse(line))) == fault


def trees_built(tree: ast.Module) -> list[tuple[int, str]]:
    """Line and name of all that builds a KD-tree, in itself or inside a library's function."""
    names = [(node.lineno, node.attr) for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    names += [(line, part) for line, name in imported(tree, "avatar", True) for part in name.split(".")]
    return [(line, name) for line, name in names if name in TREES]


@pytest.mark.parametrize("path", sources("avatar", "tools"), ids=lambda path: str(path.relative_to(ROOT)))
def test_trees_are_built_in_one_place(path):
    if str(path.relative_to(ROOT)) not in TREE_BUILDERS:
        assert trees_built(parse(path)) == [], "use avatar.geometry.trees.build_tree"


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("from scipy.spatial import cKDTree", True),
        ("from scipy.spatial import KDTree as Tree", True),
        ("import scipy.spatial\nscipy.spatial.cKDTree(points)", True),
        ("from scipy import spatial\nspatial.KDTree(points)", True),
        ("mesh.kdtree.query(points)", True),
        ("require('trimesh').proximity.closest_point(mesh, points)", True),
        ("require('sklearn.neighbors').NearestNeighbors().fit(points)", True),
        ("from scipy.interpolate import griddata", True),
        ("from scipy.spatial.transform import Rotation", False),
        ("build_tree(points).query(points)", False),
    ],
)
def test_trees_are_seen(line, fault):
    assert bool(trees_built(ast.parse(line))) == fault


@pytest.mark.parametrize(
    ("file", "line", "fault"),
    [
        ("geometry/new.py", "from avatar.records import Template", False),
        ("geometry/new.py", "from avatar.body.model import BodyModel", True),
        ("body/new.py", "import avatar.io.npz", False),
        ("io/new.py", "def f():\n    from avatar.data.outfits import Outfit", True),
        ("nn/new.py", "from avatar import data", True),
        ("nn/new.py", "from ..training import losses", True),
        ("nn/new.py", "from . import decoders", False),
        ("simulate/new.py", "require('newton.solvers')", False),
        ("data/new.py", "require('newton')", True),
        ("evaluation/new.py", "from avatar.nn.closet import ClosetAvatar", True),
        ("training/new.py", "from avatar.nn.closet import ClosetAvatar", False),
        ("training/new.py", "import omegaconf", True),
        ("evaluation/new.py", "require('open3d')", True),
        ("__init__.py", "import torch", True),
    ],
)
def test_arrows_are_seen(file, line, fault):
    assert bool(arrow_faults(PACKAGE / file, ast.parse(line))) == fault


def in_fresh_python(code: str) -> str:
    """What a new interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_import_of_the_package_imports_nothing_else():
    heavy = {"torch", "numpy", "scipy", "trimesh", "roma", *LAZY}
    loaded = in_fresh_python("import sys, avatar; print(*{name.partition('.')[0] for name in sys.modules})")
    assert not heavy & set(loaded.split())


def test_no_module_but_those_of_the_command_line_imports_a_heavy_or_optional_package():
    modules = [module_of(path) for path in sources("avatar") if room_of(path) not in ("config", "arguments", "help")]
    modules.sort(key=lambda module: module in KERNELS)  # last, for what it loads would hide what others do
    code = (
        "import importlib, sys\n"
        f"for module in {modules}:\n"
        f"    before = set(sys.modules)\n"
        "    importlib.import_module(module)\n"
        f"    found = {{n.partition('.')[0] for n in set(sys.modules) - before}} & set({LAZY})\n"
        f"    found.discard({KERNELS}.get(module))\n"
        "    if found: print(module, 'imports', *sorted(found))\n"
    )
    assert in_fresh_python(code) == ""
