"""Architecture: a core and rings, who imports whom, names, and imports without side effects.

`../shared/DESIGN.md` and CONTRIBUTING.md describe the same table. Change them together.
"""

import ast
import importlib
import json
import subprocess
import sys
from collections.abc import Iterator

import pytest
from places import ROOT

from anytouch_jax import renamed

PACKAGE = "anytouch_jax"
ROOT = ROOT / "src" / PACKAGE
MODULE_NAMES = 16  # public functions and classes of a module: more are two subjects
MODULE_IMPORTS = 12  # modules of ours that a module outside `cli` imports: more are two jobs

# Names that every file of a room has, by convention: a command runs, a reader reads.
BY_CONVENTION = {
    ("cli", "run"),
    ("datasets.readers", "read"),
    ("datasets.readers", "READER"),
}

# What any room may import: these know numpy at most.
GROUND = {
    "errors",
    "signals",
    "text",
    "forks",
    "files",
    "progress",
    "shown",
    "sensors",
    "batch",
    "doors",
    "renamed",
}

# room of the core -> what of ours it may import beside the ground; a dotted name is one module of
# a room. A room may always import itself. No entry names a ring.
CORE: dict[str, set[str]] = {
    "ops": set(),
    "errors": {"signals", "text"},
    "signals": set(),
    "text": set(),
    "forks": set(),
    "files": {"signals", "text", "progress"},
    "progress": set(),
    "shown": set(),
    "sensors": set(),
    "batch": set(),
    "doors": set(),
    "renamed": set(),
    "config": set(),
    "nn": {"ops", "config"},
    "objectives": {"ops", "nn.functional", "config"},
    "weights": {"nn", "config"},
    "data": {"config"},
    # ops: sums of squares for the norms of gradients and parameters
    "train": {"config", "weights", "ops"},
    # train.loop: tokens of a new sensor are trained by the loop that trains everything
    "encoder": {"nn", "weights", "objectives", "ops", "data", "config", "train"},
    # objectives: the errors of stage 1 on pixels are measured by its own functions
    # weights.registry: whether another package brings the control of every probe
    "evaluate": {
        "encoder", "objectives", "data", "nn.functional", "ops", "config", "weights.registry",
    },
    "finetuning": {"objectives", "weights", "data", "config", "train", "encoder", "evaluate"},
    "training": {
        "nn", "objectives", "ops", "weights", "data", "config", "train", "encoder", "evaluate",
    },
}  # fmt: skip

# ring -> the rings that it may import. A ring may import all of the core but `cli`. A head that
# measures is streamed, shown and exported, so `live` and `export` know `fields`.
RINGS: dict[str, set[str]] = {
    "sim": set(),
    "fields": {"sim"},
    "datasets": set(),
    "live": {"fields"},
    "zoo": set(),
    "export": {"fields"},
}
# These put everything together. Nobody imports `cli`.
TOP_ROOMS = {"cli", "__init__", "__main__"}

# Former places of modules, which give their names with a DeprecationWarning for one version.
MOVED = {f"{old}" for old in renamed.MODULES} | {"view"}

# library -> the only rooms (or modules) that know it
ONLY_IN: dict[str, set[str]] = {
    "flax": {"nn", "fields.module", "zoo"},
    "optax": {"train", "evaluate", "encoder", "sim.fitting"},
    "orbax": {"weights.checkpoint"},
    "sklearn": {"evaluate"},
    "matplotlib": {"evaluate"},
    "openai": {"datasets"},
    "tyro": {"cli"},
    "torch": set(),
    "tensorflow": set(),
    "pickle": {"zoo.torch_file", "datasets.readers.common"},
    "starlette": {"live.page"},
    "uvicorn": {"live.page"},
    "mujoco": {"sim.mujoco"},
    "gymnasium": {"sim.mujoco"},
    "importlib": {"__init__", "doors", "errors", "renamed"},
}
WITHOUT_JAX = {"data", "config", "batch", "datasets"} | GROUND
HARMLESS = {"importlib.metadata", "importlib.resources"}
HEAVY = ("jax", "flax", "optax", "orbax", "cv2", "sklearn", "scipy", "matplotlib", "pyarrow")

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


def may_import(room: str) -> set[str]:
    """Return the rooms and modules that a room may import."""
    if room in CORE:
        ground = set() if room in GROUND | {"ops"} else GROUND
        # the ground may use its own errors and short reprs
        return CORE[room] | ground | {room, *(() if room == "ops" else ("errors", "shown"))}
    return set(CORE) | RINGS[room] | {room}


def faults(module: str, source: str) -> list[str]:
    """Return the imports of `module` that the tables do not allow, as sentences."""
    room = module.split(".")[0]
    found: list[str] = []
    if module in MOVED:
        return found
    at_run_time = set(imports(module, source))
    for name, line in imports(module, source, typing=True):
        library = name.split(".")[0]
        ours = name.removeprefix(PACKAGE).removeprefix(".")
        if library == PACKAGE:
            if room not in TOP_ROOMS and not inside(ours, may_import(room)):
                found.append(f"{module}:{line} imports {ours or PACKAGE}, which {room} may not")
            continue
        if (name, line) not in at_run_time:
            continue  # a library that is imported for types alone is not loaded
        only = ONLY_IN.get(library)
        if only is not None and not inside(module, only) and not inside(name, HARMLESS):
            found.append(f"{module}:{line} imports {library}, which only {sorted(only)} may")
        if library == "jax" and room in WITHOUT_JAX:
            found.append(f"{module}:{line} imports jax; {room} runs in workers that have none")
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
    "fields.results",  # grows .part files while it measures, and renames them at the end
    "files.atomic",
    "weights.checkpoint",
    "weights.safetensors",
    "datasets.captions",
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
    assert rooms - TOP_ROOMS - {"view"} == set(CORE) | set(RINGS)


def test_the_core_names_no_ring() -> None:
    """What the tables allow is checked too: a row that lets a ring in would be found here."""
    assert not {ring for allowed in CORE.values() for ring in allowed} & set(RINGS)


def reached_from(*start: str) -> set[str]:
    """Return the modules of ours that import statements lead to from `start`, wherever they are."""
    edges = graph()
    reached: set[str] = set()
    waiting = list(start)
    while waiting:
        module = waiting.pop()
        if module not in reached:
            reached.add(module)
            waiting += edges[module]
    return reached


@pytest.mark.parametrize("start", ["encoder.encoder", "training", "evaluate.probing"])
def test_the_core_reaches_no_ring(start: str) -> None:
    assert sorted(one for one in reached_from(start) if one.split(".")[0] in RINGS) == []


def test_what_an_encoder_of_ours_loads() -> None:
    """Loading and using the encoder in the package imports no module of a ring either."""
    code = (
        "import json, sys, numpy as np, anytouch_jax as at\n"
        "encoder = at.load_encoder('anytouch-tiny', engine='xla')\n"
        "frame = np.zeros((64, 64, 3), np.uint8)\n"
        "encoder.encode_touch(encoder.preprocess(frame), 'digit')\n"
        "print(json.dumps([name for name in sys.modules if name.startswith('anytouch_jax.')]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    loaded = [name.split(".")[1] for name in json.loads(done.stdout.splitlines()[-1])]
    # The weights of the package have the head of fields, so its module builds their parameters.
    assert set(loaded) & set(RINGS) <= {"fields"}


def test_a_door_leads_somewhere() -> None:
    """Every row of the tables of doors names a module and an attribute that exist."""
    from anytouch_jax import doors

    tables = [
        table for name, table in vars(doors).items() if name.isupper() and isinstance(table, dict)
    ]
    for table in tables:
        for name, door in table.items():
            module, _, attribute = door.target.partition(":")
            assert module.split(".")[0] in RINGS, name
            assert hasattr(__import__(f"{PACKAGE}.{module}", fromlist=["_"]), attribute), name


def test_a_module_has_one_job() -> None:
    edges = graph()
    # `renamed` does not count: it leaves with the old names.
    counts = {module: len(others - {"renamed"}) for module, others in edges.items()}
    many = {module: count for module, count in counts.items() if count > MODULE_IMPORTS}
    assert {module: count for module, count in many.items() if module.split(".")[0] != "cli"} == {}


def test_imports_follow_the_table() -> None:
    assert [
        fault for module, path in MODULES.items() for fault in faults(module, path.read_text())
    ] == []


def test_no_import_cycles() -> None:
    assert cycle(graph()) == []


def test_a_module_has_one_subject() -> None:
    names = {module: len(public_names(path.read_text())) for module, path in MODULES.items()}
    assert {module: count for module, count in names.items() if count > MODULE_NAMES} == {}


def public_names(source: str) -> list[str]:
    """Return the public classes and functions at the top level of a module."""
    kinds = (ast.FunctionDef, ast.ClassDef)
    return [
        node.name
        for node in ast.parse(source).body
        if isinstance(node, kinds) and not node.name.startswith("_")
    ]


# Names that two modules use, and why both are right. No new one may come.
USED_TWICE = {
    "Measure": "the interface that the encoder knows, and the class of fields that has it",
    "TouchEncoder": "the field's word for the network, and for the interface of every encoder",
    "cached_export": "a door of the encoder, and what lies behind it",
    "load_engine": "a door of the encoder, and what lies behind it",
    "fit_head": "of a probe, and on the page by the touches that were taught",
    "warn": "of a sentence for the user, and of an old name",
}


def test_a_public_name_means_one_thing() -> None:
    homes: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        for name in public_names(path.read_text()):
            if (module.rpartition(".")[0], name) not in BY_CONVENTION:
                homes.setdefault(name, []).append(module)
    twice = {name for name, modules in homes.items() if len(modules) > 1}
    assert twice <= USED_TWICE.keys(), "a name that is used twice for other things"
    assert twice >= USED_TWICE.keys(), "a name that may leave the list"


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
        # who reads a file needs its types too, so imports for types count
        ("evaluate.probing", "if TYPE_CHECKING:\n    from .. import cli", 1),
        ("nn.anytouch", "from anytouch_jax.fields.module import FieldDecoder", 1),
        ("live.stream", "from anytouch_jax.sim import recorder", 1),
        ("fields.measure", "from anytouch_jax.sim import recorder", 0),
        ("zoo.families", "from anytouch_jax.weights import load", 0),
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


TOP = {
    ".ci",
    ".github",
    ".gitignore",
    "CHANGELOG.md",
    "CITATION.cff",
    "CONTRIBUTING.md",
    "LICENSE",
    "Makefile",
    "README.md",
    "SECURITY.md",
    "docs",
    "experiments",
    "integrations",
    "mkdocs.yml",
    "pyproject.toml",
    "requirements.txt",
    "src",
    "tests",
}


@pytest.mark.parametrize("old", sorted(renamed.MODULES))
def test_a_former_module_still_gives_its_names(old: str) -> None:
    module = importlib.import_module(f"{PACKAGE}.{old}")
    home = importlib.import_module(f"{PACKAGE}.{renamed.MODULES[old][0]}")
    name = public_names(MODULES[renamed.MODULES[old][0]].read_text())[0]
    with pytest.warns(DeprecationWarning, match=f"{old}.{name} is called"):
        assert getattr(module, name) is getattr(home, name)
    with pytest.raises(AttributeError, match="no attribute"):
        getattr(module, "no_such_name")  # noqa: B009, the look-up is what is tested


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
