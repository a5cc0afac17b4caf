"""The layers of docs/design.md, read from the imports, and what no file of the package may do.

A subpackage may import itself and those in lower layers. Those of one layer may import each other, but not in layer 3;
no imports may close a circle of modules. The packages of `tools/` may import the package, which
imports none of them.
"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "avatar"
TOOLS = ROOT / "tools"
OUTSIDE = {path.stem for path in TOOLS.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
LAYERS = {
    "records": 0,
    "checks": 0,
    "declared": 0,
    "settings": 0,
    "environment": 0,
    "invocation": 0,
    "progress": 0,
    "processes": 0,
    "verbs": 0,
    "world": 0,
    "geometry": 1,
    "io": 2,
    "body": 2,
    "data": 3,
    "simulate": 3,
    "canonical": 3,
    "nn": 3,
    "implicit": 3,
    "methods": 4,
    "training": 5,
    "export": 5,
    "evaluation": 5,
    "fitting": 5,
    "sources": 6,
    "runs": 6,
    "pipeline": 7,
    "config": 8,
    "api": 8,
    "arguments": 8,
    "cli": 8,
    "__main__": 8,
}
SIBLINGS = 3  # the layer whose subpackages do not import each other
FORBIDDEN = {("evaluation", "nn"), ("evaluation", "methods"), ("evaluation", "training")}
# Methods of avatars: each is known to its own file and the registry.
AVATARS = ("closet", "pop", "scale", "scanimate", "layered")
ONLY_IN = {  # package: the subpackages that may name it at all
    "hydra": {"config", "arguments"},
    "omegaconf": {"config", "arguments"},
    "open3d": {"export"},
    "pyacvd": {"geometry", "runs"},
    "xatlas": {"export", "runs"},
    "newton": {"simulate"},
    "warp": {"simulate"},
    "triton": {"geometry", "export"},  # in export: loaded before VTK
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
    *("griddata", "NearestNDInterpolator", "RBFInterpolator", "ProximityQuery", "proximity", "pipelines"),
    *("sample_surface_even", "remove_close", "clusters", "group_distance"),
}
TREE_BUILDERS = {
    "avatar/geometry/trees.py": "the one builder",
    "tools/benchmarks/search.py": "scipy as it comes is what is measured, on clouds that are always the same",
}


def package_of(path: Path) -> str:
    """The subpackage that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def module_of(path: Path) -> str:
    """The dotted name of a file of the package, or of `tools/`."""
    parts = path.relative_to(TOOLS if path.is_relative_to(TOOLS) else ROOT).with_suffix("").parts
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


def layer_faults(path: Path, tree: ast.Module) -> list[str]:
    """Imports of a file of the package that no layer allows."""
    package, faults = package_of(path), []
    if package == "__init__":
        names = {name for _, name in imported(tree, "avatar", True)} - {"os", "sys"}
        return [f"avatar/__init__.py imports {name}" for name in sorted(names)]
    for line, name in imported(tree, module_of(path), path.name == "__init__.py"):
        first, _, rest = name.partition(".")
        other = rest.partition(".")[0]
        if first == "avatar" and other in LAYERS and other != package:
            up = LAYERS[other] > LAYERS.get(package, 0)
            sibling = LAYERS[other] == LAYERS.get(package, 0) == SIBLINGS
            if up or sibling or (package, other) in FORBIDDEN:
                faults.append(f"{path.relative_to(ROOT)}:{line}: {package} imports {name}")
        if first in OUTSIDE or (first in ONLY_IN and package not in ONLY_IN[first]):
            faults.append(f"{path.relative_to(ROOT)}:{line}: {package} imports {first}")
    return faults


def method_branches(tree: ast.Module, module: str) -> list[tuple[int, str]]:
    """Line and description of all that depends on which method a run has: imports of methods, names, types."""
    names = list(imported(tree, module, False))
    own = {module.rpartition(".")[2]}
    if module.startswith("avatar.methods."):  # a method may be built on another one's classes
        bases = {name_of(base) for node in ast.walk(tree) if isinstance(node, ast.ClassDef) for base in node.bases}
        own |= {name.split(".")[2] for _, name in names if name.count(".") == 3 and name.rpartition(".")[2] in bases}
    found = [
        (line, name)
        for line, name in names
        for avatar in AVATARS
        if avatar not in own and f"{name}.".startswith(f"avatar.methods.{avatar}.")
    ]
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            constants = [side.value for side in (node.left, *node.comparators) if isinstance(side, ast.Constant)]
            found += [(node.lineno, f"compares with {value!r}") for value in constants if value in AVATARS]
            if any(name_of(side).endswith("method.name") for side in (node.left, *node.comparators)):
                found.append((node.lineno, "compares method.name"))
        elif isinstance(node, ast.Call) and name_of(node.func) in ("isinstance", "hasattr", "getattr"):
            asked = name_of(node.args[0]).rpartition(".")[2]
            if asked in ("model", "method") and not module.startswith("avatar.methods."):
                found.append((node.lineno, f"{name_of(node.func)} of a network"))
    return found


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


def test_every_subpackage_has_its_layer():
    packages = {package_of(path) for path in sources("avatar")} - {"__init__", "assets"}
    assert packages <= set(LAYERS), f"give a layer to {packages - set(LAYERS)}"


@pytest.mark.parametrize("path", sources("avatar"), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(path):
    assert layer_faults(path, parse(path)) == []


@pytest.mark.parametrize("path", sources("avatar"), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_asks_which_method_it_has(path):
    if module_of(path) != "avatar.methods.registry":
        assert method_branches(parse(path), module_of(path)) == []


@pytest.mark.parametrize(
    ("module", "line", "fault"),
    [
        ("avatar.runs.new", "from avatar.methods.pop import PopAvatar", True),
        ("avatar.methods.pop", "from avatar.methods.pop import PopAvatar", False),
        ("avatar.methods.new", "from avatar.methods.pop import PopAvatar", True),
        ("avatar.methods.new", "from avatar.methods.pop import PopAvatar\nclass New(PopAvatar): pass", False),
        ("avatar.runs.new", "if config.method.name == name: pass", True),
        ("avatar.runs.new", "if kind == 'scanimate': pass", True),
        ("avatar.runs.new", "if hasattr(avatar.model, 'garment_template'): pass", True),
        ("avatar.runs.new", "if isinstance(model, Network): pass", True),
        ("avatar.runs.new", "if avatar.method.makes_meshes: pass", False),
    ],
)
def test_branches_on_a_method_are_seen(module, line, fault):
    assert bool(method_branches(ast.parse(line), module)) == fault


def test_no_circle_of_modules():
    """Imports at the top of a file must have an order; those inside functions wait until all is loaded."""
    modules = {module_of(path): path for path in sources("avatar", "tools")}
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
        ("evaluation/new.py", "from avatar.methods.closet import ClosetAvatar", True),
        ("training/new.py", "from avatar.methods.closet import ClosetAvatar", False),
        ("training/new.py", "import omegaconf", True),
        ("evaluation/new.py", "require('open3d')", True),
        ("__init__.py", "import torch", True),
        ("pipeline/new.py", "from reliability.small_jobs import train_job", True),
        ("export/new.py", "import benchmarks.search", True),
    ],
)
def test_imports_that_point_up_are_seen(file, line, fault):
    assert bool(layer_faults(PACKAGE / file, ast.parse(line))) == fault


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
    command_line = ("config", "arguments")
    modules = [module_of(path) for path in sources("avatar") if package_of(path) not in command_line]
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
