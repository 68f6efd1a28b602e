import errno
import json
import os
import re
import subprocess
import sys
import warnings
from dataclasses import is_dataclass
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from anytouch_jax import __main__ as program
from anytouch_jax.cli import arguments
from anytouch_jax.cli.app import COMMANDS, GROUPS, guarded, main
from anytouch_jax.cli.arguments import options_of
from anytouch_jax.cli.train import Sections
from anytouch_jax.config import preset
from anytouch_jax.config.parsing import Range
from anytouch_jax.errors import UserError
from anytouch_jax.live.page import server

HELP = """
import contextlib, io, json, sys
from anytouch_jax.cli.app import COMMANDS, GROUPS, main
heavy = set('jax flax optax orbax numpy scipy sklearn cv2 pyarrow matplotlib tokenizers'.split())
pages = {}
for name in ['', *GROUPS, *COMMANDS]:
    with contextlib.redirect_stdout(io.StringIO()) as page:
        assert main([*name.split(), '--help']) == 0, name
    pages[name] = page.getvalue()
    assert not heavy & set(sys.modules), (name, heavy & set(sys.modules))
assert main(['info', sys.argv[1]]) == 0
assert not (heavy - {'numpy'}) & set(sys.modules), (heavy - {'numpy'}) & set(sys.modules)
print(json.dumps(pages))
"""


def test_every_help_has_an_example_and_imports_nothing_heavy(tmp_path):
    np.savez(tmp_path / "f.npz", features=np.zeros((2, 3), np.float32), rows=np.arange(2))
    words = [sys.executable, "-c", HELP, str(tmp_path / "f.npz")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = json.loads(done.stdout.splitlines()[-1])
    for name in COMMANDS:
        group, _, last = name.rpartition(" ")
        assert f"\n  {name} " in pages[""] and (
            not group or f"\n  {last} " in pages[group].replace(f"{group} ", "")
        )
        assert f"\nExample: anytouch {name} " in pages[name] and "--help" in pages[name]
        for option in re.split(r"\n\s*(?=--[\w-]+[ ,])", re.sub("[╭╮╰╯─│]", "", pages[name]))[1:]:
            words = re.sub(r"--[\w-]+|\{[^}]*\}|\((default|required)[^)]*\)", "", option)
            assert re.search("[a-z]{3}", words), f"{name} does not explain {option[:60]}"
    for group in GROUPS:
        assert "Example: anytouch" in pages[group]


def test_no_command_is_a_usage_error_and_the_version_is_printed(anytouch, monkeypatch, capsys):
    assert anytouch().status == anytouch("data").status == anytouch("probe").status == 2
    monkeypatch.setattr(sys, "argv", ["anytouch", "--version"])
    assert main() == 0 and capsys.readouterr().out.strip()[0].isdigit()


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("trin", "train"),
        ("data simulat", "data simulate"),
        ("probe task", "probe tasks"),
        ("xyzzy", None),
        ("simulate --out x", "anytouch data simulate"),
        ("convert a b", "anytouch export"),
        ("pour --run x", "make pouring"),
        ("translate", "make translation"),
        ("bench", "make bench"),
        ("parity", "make parity"),
        ("probe --label object", "probe label"),
    ],
)
def test_an_unknown_command_gets_one_line_that_names_the_right_one(anytouch, typed, meant):
    done = anytouch(*typed.split())
    assert done.status == 2 and len(done.err.splitlines()) == 1 and not done.out
    assert meant in done.err if meant else "Did you mean" not in done.err


def options_and_words(name):
    """The options of a command, and words that give each required one a value of its kind."""
    options = list(options_of(COMMANDS[name].options))
    words = [word for one in options if one.is_required for word in given(one)]
    if name == "train":
        config = preset("tiny", stage=2, towers="scratch")
        options += options_of(
            Sections, Sections(*(getattr(config, home) for home in get_type_hints(Sections)))
        )
    return options, words


def given(option, value=None):
    """Words that give an option a value for each of its places; `value` for its numbers."""
    values = [value or "1" if kind in (int, float) else "x" for kind in option.kinds]
    if option.is_positional:
        return values
    return [option.name, *values]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_of_every_command_answers_a_mistake_with_one_sentence(name, mistake, anytouch):
    options, needed = options_and_words(name)
    flags = {
        one.name.rpartition(".")[0] + one.name.rpartition(".")[2] for one in options if one.is_flag
    }
    known = {one.name for one in options} | flags

    def answer(option, *words, part=None):
        text = mistake(*name.split(), *([] if option.is_required else needed), *words)
        assert (part or option.name) in text and len(text) < 400, text

    page = anytouch(*name.split(), "--help-all" if name == "train" else "--help").out
    for option in (one for one in options if not one.is_positional):
        assert name == "train" or option.name in page
        if (typo := option.name[:-1]) not in known and len(typo) > 5:
            answer(option, typo, "x", part="did you mean --")
        if option.is_flag:
            answer(option, f"{option.name}=yes")
            continue
        if not option.may_be_empty:
            answer(option, option.name)
        if option.is_list:
            answer(option, option.name, "a,b", part=f"write {option.name} a b")
        if {int, float} & {*option.kinds}:
            answer(option, *given(option, "many"))
        if Literal in map(get_origin, option.kinds):
            answer(option, *given(option))


def ranges_of(kind, prefix="--"):
    """Yield each number of a record of options with whether it is whole, and its range."""
    plain = get_type_hints(kind)
    for name, hint in get_type_hints(kind, include_extras=True).items():
        parts = [plain[name], *get_args(plain[name])]
        inner = next((one for one in parts if is_dataclass(one)), None)
        spelt = f"{prefix}{name.replace('_', '-')}"
        if inner is not None:
            yield from ranges_of(inner, f"{spelt}.")
        elif found := [one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Range)]:
            yield spelt, int in parts, found[0]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_number_of_every_command_has_a_range(name, mistake):
    options, needed = options_and_words(name)
    kinds = (COMMANDS[name].options, Sections) if name == "train" else (COMMANDS[name].options,)
    ranges = {option: rest for kind in kinds for option, *rest in ranges_of(kind)}
    for option in options:
        assert option.name in ranges or not {int, float} & {*option.kinds}, option
        is_whole, (low, high, _) = ranges.get(option.name, (True, (-np.inf, np.inf, "")))
        wrong = [f"{2**70}"] if is_whole else ["nan", "inf", "-inf", "1e400"]
        wrong += [f"{low - 1:.17g}"] * bool(np.isfinite(low)) + [f"{high + 1:.17g}"] * bool(
            np.isfinite(high)
        )
        for value in wrong if option.name in ranges else ():
            # a stack of blocks does not know the name of its section
            last = option.name.rpartition(".")[2]
            assert last in mistake(*name.split(), *needed, *given(option, value)), (
                option.name,
                value,
            )


@pytest.mark.parametrize(
    ("typed", "right"),
    [
        ("embed --run r --data m.csv --out f.npz", "--model"),
        ("embed --model r --input m.csv --out f.npz", "--data"),
        ("embed --model r --data 0 --stream --out f.npz", "anytouch stream"),
        ("train --data m.csv --run r --loader.flip 0", "--data.flip"),
        ("train --data m.csv --run r --loop.seed=1", "--run.seed"),
        ("train --data m.csv --run r --clip weights", "--clip-weights"),
        ("probe label --data m.csv --tasks all", "anytouch probe tasks"),
        ("export --run r --out f.bin", "--model"),
        ("probe label --data a.csv --data=b.csv", "--data is given twice"),
        (
            "train --data a --run r --model.sensors digit --model.sensors gelslim",
            "--model.sensors is given twice",
        ),
        ("probe label --data a.csv --where force,7", "write --where force 7"),
        (
            "data contact m.csv --threshold digit=5 gelsight=7",
            "write --threshold digit 5 gelsight 7",
        ),
        (
            "data simulate --out x --sensors [gelsight_mini, digit]",
            "write --sensors gelsight_mini digit",
        ),
        ("stream --data 0 --out x --camera-size 640x480", "write --camera-size 640 480"),
        ("embed frames --out x", "did you mean --data frames?"),
        ("info a --health b", "'b' belongs to no option"),
        ("embed", "--data and --out are missing"),
        ("train --data m --run r --learning-rat 1", "did you mean --optim.learning-rate?"),
        ("train --data m --run r --model.sensors digti universal", "did you mean digit?"),
    ],
)
def test_a_mistake_names_what_is_right(mistake, typed, right):
    assert right in mistake(*typed.split())


def test_the_home_folder_follows_an_equals_sign_too(monkeypatch, mistake, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert f"{tmp_path}/none.csv" in mistake("probe", "label", "--data=~/none.csv", "--model", "x")
    assert arguments.expand_home("a=~/x") == "a=~/x" and arguments.expand_home("--note") == "--note"


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes."), 2, "memory"),
        (MemoryError(), 2, "memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (
            OSError(errno.ENOSPC, "No space left on device", "f.npz"),
            2,
            "f.npz: No space left on device",
        ),
    ],
)
def test_errors_of_the_machine_and_interrupts_are_one_line_and_bugs_are_not(
    capsys, error, status, words
):
    def run(error=error):
        raise error

    assert guarded("anytouch train", run) == status
    message = capsys.readouterr().err
    assert words in message and len(message.splitlines()) == 1
    with pytest.raises(RuntimeError, match="a bug"):
        guarded("anytouch train", lambda: run(RuntimeError("a bug")))


def test_ctrl_c_during_an_import_is_no_bug(capsys):
    def run():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stop:  # as Python 3.11 does in a class body
            raise RuntimeError("Error calling __set_name__ on 'Field' instance") from stop

    assert guarded("anytouch embed", run) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_ctrl_c_while_the_command_itself_is_imported_is_no_bug(capsys, monkeypatch):
    class Stopped:
        def find_spec(self, name, *_):
            if name == "anytouch_jax.cli.app":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "anytouch_jax.cli.app")
    monkeypatch.setattr(sys, "meta_path", [Stopped(), *sys.meta_path])
    assert program.run_command() == 130
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize(
    "error", [AssertionError(), UserError("could not read checkpoint"), RuntimeError("x")]
)
def test_a_platform_that_jax_lacks_is_one_sentence(capsys, monkeypatch, error):
    def run(*_):
        raise error

    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr("jax.devices", run)
    assert guarded("anytouch embed", run) == 2
    assert capsys.readouterr().err.startswith(
        "anytouch embed: JAX_PLATFORMS is 'cuda', which jax cannot use here"
    )


def test_a_reader_that_closes_the_pipe_gets_no_traceback():
    # The shell prints the status of the writer, since `true` has its own.
    script = f"( {sys.executable} -m anytouch_jax --help; echo $? >&2 ) | true"
    done = subprocess.run(
        ["sh", "-c", script], capture_output=True, text=True, check=False, env={**os.environ}
    )
    # 0 if the page fits into the pipe before it is closed
    assert done.stderr.strip() in ("141", "0")


def test_a_warning_of_the_library_is_a_sentence(capsys):
    def run():
        warnings.warn("sensor 'x' is not known", stacklevel=2)
        warnings.warn("jax will change", FutureWarning, stacklevel=2)
        return 0

    with warnings.catch_warnings(record=True) as others:
        warnings.simplefilter("always")
        assert guarded("anytouch info", run) == 0
    assert capsys.readouterr().err == "sensor 'x' is not known\n"
    assert [warning.category for warning in others] == [FutureWarning]


@pytest.mark.parametrize("command", ["probe label", "retrieve", "export"])
def test_compiled_programs_are_cached_on_disk(
    tmp_path, world, tiny_run, anytouch, monkeypatch, command
):
    from anytouch_jax.train import mesh

    enabled = []
    monkeypatch.setattr(mesh, "enable_compilation_cache", lambda: enabled.append(command))
    words = {
        "probe label": ("--data", world, "--label", "no_such_label"),
        "retrieve": ("--data", tmp_path / "no.csv"),
        "export": ("--out", tmp_path / "f.json"),
    }
    anytouch(*command.split(), "--model", tiny_run, *words[command])
    assert enabled == [command]


def test_mistakes(mistake, tmp_path):
    assert "--camera-fps has no effect" in mistake("view", tmp_path, "--camera-fps", 30)
    assert "no.csv" in mistake("view", tmp_path / "no.csv")
    (tmp_path / "a.mp4").write_bytes(b"no film")
    assert "no video" in mistake("view", tmp_path / "a.mp4")
    assert "--head" in mistake("view", tmp_path, "--head", "h.npz")
    assert "One camera" in mistake("view", "0", "1")
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    assert "features" in mistake("view", tmp_path / "a.npz")
    assert "no images" in mistake("view", tmp_path)


def test_it_serves_what_it_is_given(anytouch, pressed, monkeypatch):
    served = []
    monkeypatch.setattr(
        server, "serve", lambda sources, host, port, show: served.append((sources, host, port))
    )
    assert anytouch("view", pressed, "--port", 9000).status == 0
    ((sources, host, port),) = served
    assert [source.kind for source in sources] == ["table"] and (host, port) == ("127.0.0.1", 9000)
    assert anytouch("view").status == 0
    # cameras, and the examples
    assert [source.kind for source in served[1][0]] == ["start", "table"]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_summary_of_a_command_is_one_sentence_of_one_line(name):
    summary = COMMANDS[name].summary
    assert summary.endswith(".") and "\n" not in summary and len(summary) <= 90
    assert is_dataclass(COMMANDS[name].options) and callable(COMMANDS[name].run)


LAZY = """
import sys
from anytouch_jax.cli.app import main
assert main(["--help"]) == 0
ours = [name for name in sys.modules if name.startswith("anytouch_jax.")]
known = ("anytouch_jax.cli", "anytouch_jax.config", "anytouch_jax.doors", "anytouch_jax.errors",
         "anytouch_jax.sensors", "anytouch_jax.signals", "anytouch_jax.text",
         "anytouch_jax.shown", "anytouch_jax.renamed")
assert not [name for name in ours if not name.startswith(known)], ours
assert not [name for name in ours if name.startswith("anytouch_jax.cli.")
            and name.rpartition(".")[2] not in ("app", "arguments")], ours
"""


def test_the_list_of_commands_imports_none_of_them():
    done = subprocess.run([sys.executable, "-c", LAZY], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_package_of_an_extra_that_is_missing_is_named(anytouch, monkeypatch, tmp_path):
    def run(_):
        raise ModuleNotFoundError("No module named 'uvicorn'", name="uvicorn")

    monkeypatch.setattr("anytouch_jax.cli.stream.run_view", run)
    done = anytouch("view", tmp_path)
    assert done.status == 2 and len(done.err.splitlines()) == 1
    assert 'pip install "anytouch_jax[view]"' in done.err and "uvicorn" in done.err
    # a command of the core has no extra: that is a bug, and keeps its traceback
    monkeypatch.setattr("anytouch_jax.cli.info.run", run)
    with pytest.raises(ModuleNotFoundError, match="uvicorn"):
        anytouch("info", tmp_path)


@pytest.mark.parametrize(
    ("name", "typed", "field", "value"),
    [
        ("probe label", "--data a.csv b.csv", "data", (Path("a.csv"), Path("b.csv"))),
        ("probe label", "--data a --where force -1.5", "where", ("force", -1.5)),
        ("probe label", "--data a --no-controls", "controls", False),
        ("probe label", "--data a --no-controls --controls", "controls", True),
        ("probe label", "--data a --seeds=3 --seeds 4", "seeds", 4),
        ("probe label", "--data a --leave_out object", "leave_out", "object"),
        ("probe tasks", "--data a --heads linear knn", "heads", ("linear", "knn")),
        (
            "data contact",
            "m.csv --threshold digit 5 mini 7",
            "threshold",
            (("digit", 5.0), ("mini", 7.0)),
        ),
        ("info", "-- --odd", "paths", (Path("--odd"),)),
    ],
)
def test_words_become_the_values_of_a_record(name, typed, field, value):
    command = COMMANDS[name]
    record = command.parse(command.options, name, typed.split())
    assert isinstance(record, command.options) and getattr(record, field) == value


def test_a_section_without_a_value_is_one_sentence(mistake):
    assert "--model.patch needs a whole number" in mistake(
        "train", "--data", "m.csv", "--run", "r", "--model.patch"
    )
