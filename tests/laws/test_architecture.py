"""Architecture: who imports whom, size of modules and rooms, names, start-up imports."""

import ast
import json
import subprocess
import sys
from collections.abc import Iterator

import pytest
from places import ROOT

PACKAGE = "anytouch_jax"
ROOT = ROOT / "src" / PACKAGE
MODULE_LINES = 600
MODULE_NAMES = 15
# The design allows 31,000 lines and 160 files. These limits may only fall.
PACKAGE_LINES = 35_100
PACKAGE_FILES = 150
EVALUATE_LINES = 3_570
# Names that every file of a room has, by convention: a command runs, a reader reads.
BY_CONVENTION = {("cli", "run"), ("data.readers", "read"), ("data.readers", "READER")}

# room -> what of ours it may import; a dotted name is one module of a room. A room may always
# import itself.
MAY_IMPORT: dict[str, set[str]] = {
    "ops": set(),
    "errors": set(),
    "files": set(),
    "bars": set(),
    "shown": set(),
    "batch": {"shown"},
    "config": {"errors", "shown"},
    "nn": {"ops", "config", "shown"},
    "objectives": {"ops", "nn.functional", "batch", "config"},
    "simulated": {"sim", "data", "batch", "config", "errors"},
    "weights": {"nn", "config", "files", "errors", "shown"},
    "data": {"config", "batch", "files", "errors", "bars", "shown"},
    "sim": {"data.manifest", "data.tokenizer", "config", "files", "errors"},
    # ops: sums of squares for the norms of gradients and parameters
    "train": {"batch", "config", "weights", "ops", "files", "errors", "shown"},
    # ops: unit-norm embeddings, and the contrast that fits a new sensor's tokens
    "encoder": {
        "nn",
        "weights",
        "objectives",
        "ops",
        "data",
        "config",
        "files",
        "errors",
        "bars",
        "shown",
    },
    # a simulator of a user's sensor, and tokens of an encoder that are trained on it
    "fitting": {
        "sim",
        "simulated",
        "encoder",
        "nn",
        "objectives",
        "ops",
        "data",
        "config",
        "files",
        "errors",
        "bars",
    },
    # objectives: stage 1's errors on pixels are measured by stage 1's own functions
    "evaluate": {
        "encoder",
        "objectives",
        "data",
        "ops",
        "config",
        "files",
        "errors",
        "bars",
        "shown",
    },
    "view": {"evaluate", "encoder", "data", "config", "files", "errors"},
}
# may import anything of ours, except that nobody imports cli
FREE = {"cli", "pretrain", "__init__", "__main__"}
# readers know the helpers of their folder and manifests, nothing else of `data`
READERS_MAY_IMPORT = {
    "data.readers",
    "data.manifest",
    "data.images",
    "data.names",
    "config",
    "files",
    "errors",
    "bars",
}

# library -> the only rooms (or modules) that know it
ONLY_IN: dict[str, set[str]] = {
    "jax": {
        "ops",
        "nn",
        "objectives",
        "train",
        "weights",
        "encoder",
        "evaluate",
        "sim",
        "simulated",
        "cli",
        "pretrain",
        "fitting",
    },
    "flax": {"nn"},
    "optax": {"train", "evaluate", "encoder", "fitting"},
    "orbax": {"weights.checkpoint"},
    "sklearn": {"evaluate"},
    "matplotlib": {"evaluate"},
    "openai": {"data.prepare"},
    "tyro": {"cli"},
    "torch": set(),
    "tensorflow": set(),
    "pickle": {"weights.torch_file", "data.readers.common"},
    "starlette": {"view.server"},
    "uvicorn": {"view.server"},
    "importlib": {"__init__", "cli.app"},
}
HARMLESS = {"importlib.metadata", "importlib.resources"}
HEAVY = (
    "jax",
    "flax",
    "optax",
    "orbax",
    "cv2",
    "sklearn",
    "scipy",
    "matplotlib",
    "pyarrow",
    "tokenizers",
)

MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(ROOT.rglob("*.py"))
}


def imports(module: str, source: str, *, typing: bool = False) -> Iterator[tuple[str, int]]:
    """(dotted name, line) of everything that `module` imports anywhere, relative imports resolved.

    Without `typing` what stands under `if TYPE_CHECKING:` is left out: it is never imported.
    """
    package = [PACKAGE, *module.split(".")[:-1]]
    tree = ast.parse(source)
    choices = [node for node in ast.walk(tree) if isinstance(node, ast.If)]
    typing_only = [
        node
        for node in choices
        if ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")
    ]
    never = {id(inner) for node in typing_only for part in node.body for inner in ast.walk(part)}
    for node in ast.walk(tree):
        if id(node) in never and not typing:
            continue
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((f"{origin}.{alias.name}", node.lineno) for alias in node.names)


def inside(name: str, allowed: set[str]) -> bool:
    """Whether the dotted `name` is one of `allowed` or lies below one."""
    return any(name == one or name.startswith(f"{one}.") for one in allowed)


def faults(module: str, source: str) -> list[str]:
    """Imports of `module` that the table does not allow, as sentences."""
    room = module.split(".")[0]
    found = []
    for name, line in imports(module, source):
        if name == PACKAGE or name.startswith(f"{PACKAGE}."):
            ours = name.removeprefix(PACKAGE).removeprefix(".")
            allowed = (
                READERS_MAY_IMPORT
                if module.startswith("data.readers")
                else MAY_IMPORT.get(room, set()) | {room}
            )
            if room not in FREE and not inside(ours, allowed):
                found.append(f"{module}:{line} imports {ours or PACKAGE}, which {room} may not")
        else:
            library = name.split(".")[0]
            if (
                library in ONLY_IN
                and not inside(module, ONLY_IN[library])
                and not inside(name, HARMLESS)
            ):
                found.append(
                    f"{module}:{line} imports {library}, which only {sorted(ONLY_IN[library])} may"
                )
            if room == "ops" and library != "jax" and library not in sys.stdlib_module_names:
                found.append(f"{module}:{line} imports {library}; ops knows jax alone")
    return found


def graph() -> dict[str, set[str]]:
    """module -> modules of ours that it imports, for types too: who reads one file needs the
    other.
    """
    edges: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        names = {
            name.removeprefix(f"{PACKAGE}.")
            for name, _ in imports(module, path.read_text(), typing=True)
        }
        reached = {name if name in MODULES else name.rpartition(".")[0] for name in names}
        edges[module] = (reached & set(MODULES)) - {module}
    return edges


def cycle(edges: dict[str, set[str]]) -> list[str]:
    """One cycle of the graph, or nothing: nodes without outgoing edges are taken away until none is
    left.
    """
    edges = {node: set(targets) for node, targets in edges.items()}
    while free := [node for node, targets in edges.items() if not targets]:
        for node in free:
            del edges[node]
        for targets in edges.values():
            targets.difference_update(free)
    return sorted(edges)


# These write elsewhere than into the file that `atomic_path` gives: they append, or rename a whole
# folder.
WRITERS = {
    "files",
    "weights.checkpoint",
    "weights.safetensors",
    "data.prepare.captions",
    "train.progress",
}


@pytest.mark.parametrize("module", sorted(MODULES.keys() - WRITERS))
def test_a_failed_write_leaves_the_old_file(module: str) -> None:
    """A path is written under the name `part`, which `atomic_path` gives and renames."""
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Call):
            name = (
                node.func.attr
                if isinstance(node.func, ast.Attribute)
                else getattr(node.func, "id", "")
            )
            mode = [
                one.value
                for one in node.args[:2]
                if isinstance(one, ast.Constant) and isinstance(one.value, str)
            ]
            if name in ("write_text", "write_bytes") or (
                name == "open" and mode and set(mode[-1]) & set("wax+")
            ):
                names = {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}
                assert names & {"part", "atomic_path"}, ast.unparse(node)


def test_every_module_has_a_room() -> None:
    rooms = {module.split(".")[0] for module in MODULES}
    assert rooms <= set(MAY_IMPORT) | FREE
    assert set(MAY_IMPORT) <= rooms


def test_imports_follow_the_table() -> None:
    assert [
        fault for module, path in MODULES.items() for fault in faults(module, path.read_text())
    ] == []


def test_no_import_cycles() -> None:
    assert cycle(graph()) == []


def test_modules_and_rooms_keep_their_size() -> None:
    lines = {module: len(path.read_text().splitlines()) for module, path in MODULES.items()}
    assert {module: count for module, count in lines.items() if count > MODULE_LINES} == {}
    names = {module: len(public_names(path.read_text())) for module, path in MODULES.items()}
    assert {module: count for module, count in names.items() if count > MODULE_NAMES} == {}
    assert sum(lines.values()) <= PACKAGE_LINES and len(MODULES) <= PACKAGE_FILES
    assert (
        sum(count for module, count in lines.items() if module.startswith("evaluate"))
        <= EVALUATE_LINES
    )


def public_names(source: str) -> list[str]:
    """Return the public classes and functions at the top level of a module."""
    kinds = (ast.FunctionDef, ast.ClassDef)
    return [
        node.name
        for node in ast.parse(source).body
        if isinstance(node, kinds) and not node.name.startswith("_")
    ]


def test_a_public_name_means_one_thing() -> None:
    homes: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        for name in public_names(path.read_text()):
            if (module.rpartition(".")[0], name) not in BY_CONVENTION:
                homes.setdefault(name, []).append(module)
    assert {name: modules for name, modules in homes.items() if len(modules) > 1} == {}


@pytest.mark.parametrize(
    ("module", "source", "count"),
    [
        ("data.loader", "def f():\n    from jax import random", 1),
        ("data.loader", "from ..ops import tokens", 1),
        ("train.loop", "from anytouch_jax.nn import functional", 1),
        ("objectives", "from .nn.touch import Encoder", 1),
        ("ops.losses", "import numpy as np", 1),
        ("io.release", "import pickle", 1),
        ("evaluate.probe", "if TYPE_CHECKING:\n    pass\nelse:\n    from .. import cli", 1),
        ("objectives", "from .nn.functional import Net", 0),
        ("ops.losses", "import math\nfrom . import tokens", 0),
        (
            "nn.touch",
            "from ..ops.tokens import patchify\nfrom flax import nnx\nfrom .layers import Block",
            0,
        ),
        ("evaluate.probing", "if TYPE_CHECKING:\n    from .. import cli", 0),
        ("io.release", "from importlib import resources", 0),
    ],
)
def test_the_table_catches_and_allows(module: str, source: str, count: int) -> None:
    assert len(faults(module, source)) == count


def test_a_cycle_is_seen() -> None:
    assert cycle({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == ["a", "b", "c"]
    assert cycle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_the_package_and_the_command_line_import_nothing_heavy() -> None:
    loaded = _loaded_after_each(
        [PACKAGE, *(f"{PACKAGE}.{name}" for name in ("config", "batch", "errors", "cli.app"))]
    )
    assert {
        module: names & set(HEAVY) for module, names in loaded.items() if names & set(HEAVY)
    } == {}


def test_data_workers_never_load_jax() -> None:
    loaded = _loaded_after_each(
        [f"{PACKAGE}.{name}" for name in MODULES if name.startswith("data.")]
    )
    network = {"jax", "flax", "optax"}
    assert {module: names & network for module, names in loaded.items() if names & network} == {}


def _loaded_after_each(modules: list[str]) -> dict[str, set[str]]:
    """Return the top-level names in sys.modules after importing each of `modules` in turn, in one
    fresh interpreter.
    """
    code = (
        "import importlib, json, sys\nloaded = {}\n"
        f"for module in {modules!r}:\n"
        "    importlib.import_module(module)\n"
        "    loaded[module] = sorted({name.partition('.')[0] for name in sys.modules})\n"
        "print(json.dumps(loaded))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {module: set(names) for module, names in json.loads(done.stdout).items()}


def test_a_public_name_stays_callable_when_its_module_is_imported() -> None:
    """`pretrain` is a module and the function in it: the import of one hides the other."""
    import anytouch_jax as at
    import anytouch_jax.training

    assert callable(at.pretrain)
    with pytest.raises(TypeError, match="missing"):
        at.pretrain()


TOP = {
    ".ci",
    ".gitignore",
    "CHANGELOG.md",
    "CITATION.cff",
    "CONTRIBUTING.md",
    "LICENSE",
    "Makefile",
    "README.md",
    "docs",
    "experiments",
    "integrations",
    "mkdocs.yml",
    "pyproject.toml",
    "requirements.txt",
    "src",
    "tests",
}


def test_nothing_else_lies_at_the_top() -> None:
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT.parents[1], capture_output=True, text=True
    )
    if listed.returncode:
        pytest.skip("the sources are not a clone")
    assert {name.partition("/")[0].strip('"') for name in listed.stdout.splitlines()} <= TOP


def test_every_command_has_a_parser() -> None:
    """Words taken from sys.argv by place make a folder of `--help`."""
    for folder in ("src", "experiments", "integrations", "docs"):
        for path in (ROOT.parents[1] / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                taken = isinstance(node, ast.Subscript) and ast.unparse(node) in {
                    f"sys.argv[{i}]" for i in range(1, 9)
                }
                assert not taken, f"{path}: parse the words of the command"
