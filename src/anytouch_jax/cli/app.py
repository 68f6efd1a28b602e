"""The `anytouch` command: its subcommands, its help and its exit statuses.

0 is success, 1 a failed check, 2 a user's mistake, 130 Ctrl-C and 141 a closed pipe.

A subcommand is a row of COMMANDS, and its module is imported when it is used: so `anytouch --help`
needs no package beside Python's own, and a command of a ring costs nothing to the others.
"""

from __future__ import annotations

import errno
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from functools import partial
from typing import Any, NamedTuple

from anytouch_jax import __version__, renamed
from anytouch_jax.cli.arguments import RENAMED, parse_options
from anytouch_jax.doors import Door, enter, lacking
from anytouch_jax.errors import CheckError, UserError, shorten


class Command(NamedTuple):
    """A subcommand, as names that are imported when they are used.

    Attributes:
        record: "module:class" of its options, below `anytouch_jax.cli`.
        function: "module:function" that it runs, from that record to an exit status.
        summary: one line for the help, which imports no command.
        parser: "module:function" that reads its words, if that is not `parse_options`.
        extra: of `pip install "anytouch_jax[extra]"`, if it needs more than the core.
    """

    record: str
    function: str
    summary: str
    parser: str = ""
    extra: str = ""

    @property
    def options(self) -> type:
        """The class of its options."""
        kind: type = self._find(self.record)
        return kind

    @property
    def run(self) -> Callable[[Any], int]:
        """What it runs."""
        run: Callable[[Any], int] = self._find(self.function)
        return run

    @property
    def parse(self) -> Callable[..., Any]:
        """What reads its words."""
        if not self.parser:
            return parse_options
        parse: Callable[..., Any] = self._find(self.parser)
        return parse

    def _find(self, target: str) -> Any:
        return enter(Door(f"cli.{target}", self.extra))


GROUPS = {
    "data": "Prepare a manifest of tactile frames.",
    "sensor": "Fit, calibrate and check your own sensor.",
    "probe": "Probe frozen features with simple heads.",
}
COMMANDS = {
    "data simulate": Command(
        "data:SimulateOptions",
        "data:run_simulate",
        "Simulate touches felt by several sensors, with RGB images, captions and forces.",
    ),
    "data index": Command(
        "data:DatasetOptions",
        "data:run_index",
        "Make a manifest of a downloaded dataset or of your recordings.",
    ),
    "data contact": Command(
        "data:ContactOptions",
        "data:run_contact",
        "Mark the frames in contact by their difference from the background.",
    ),
    "data verify": Command(
        "data:VerifyOptions",
        "data:run_verify",
        "Check manifests and their files: missing, broken, repeated, swapped or leaking.",
    ),
    "data annotate": Command(
        "data:AnnotateOptions",
        "data:run_annotate",
        "Caption every touch without a text by a vision-language model.",
        extra="annotate",
    ),
    "data pack": Command(
        "data:PackOptions",
        "data:run_pack",
        "Store millions of small files in a few ZIP shards, which training reads as well.",
    ),
    "train": Command(
        "train:TrainOptions",
        "train:run",
        "Pre-train stage 1 (masked autoencoding) or stage 2 (alignment, matching).",
        parser="train:parse",
    ),
    "embed": Command(
        "embed:EmbedOptions",
        "embed:run",
        "Embed a manifest, a folder of frames, an image or a video: an .npz of features.",
    ),
    "measure": Command(
        "measure:MeasureOptions",
        "measure:run",
        "Measure depth, shear, contact area and force in mm and N.",
    ),
    "stream": Command(
        "stream:StreamOptions",
        "stream:run_stream",
        "Embed a camera or a video frame by frame, and report the latency.",
    ),
    "probe label": Command(
        "probe:LabelOptions",
        "probe:run_label",
        "Probe a label column with linear and kNN heads on frozen features.",
    ),
    "probe tasks": Command(
        "probe:TasksOptions",
        "probe:run_tasks",
        "Probe named tasks, with new splits of whole objects and recordings by every seed.",
    ),
    "probe benchmark": Command(
        "probe:BenchmarkOptions",
        "probe:run_benchmark",
        "Probe a public benchmark with the authors' settings.",
    ),
    "finetune": Command(
        "finetune:TuningOptions",
        "finetune:run",
        "Train the encoder and a head on your labels, in minutes.",
    ),
    "retrieve": Command(
        "retrieve:RetrieveOptions",
        "retrieve:run_retrieve",
        "Retrieve the same touch felt by another sensor, or search stored touches.",
    ),
    "sensor fit": Command(
        "sensor:FitSensorOptions",
        "sensor:run_fit",
        "Fit the look of your sensor to 5 to 50 images of it, for the simulator.",
    ),
    "sensor calibrate": Command(
        "calibrate:CalibrateOptions",
        "calibrate:run",
        "Set the depth of your device by presses of a ball, and its force by a known weight.",
    ),
    "sensor check": Command(
        "check:CheckOptions",
        "check:run",
        "Say what has changed since the stored image of the untouched gel.",
    ),
    "report": Command(
        "retrieve:ReportOptions",
        "retrieve:run_report",
        "Report on a stage-1 and a stage-2 run: samples, losses, retrieval, probes.",
    ),
    "adapt": Command(
        "sensor:AdaptOptions",
        "sensor:run_adapt",
        "Make tokens for a new sensor from simulated touches, or from a few labelled frames.",
    ),
    "export": Command(
        "export:ExportOptions",
        "export:run",
        "Export a touch encoder for jax alone or as ONNX, or weights as safetensors.",
    ),
    "info": Command(
        "info:InfoOptions",
        "info:run",
        "Describe an encoder, a run, weights, a manifest, features, a head or cameras.",
    ),
    "view": Command(
        "stream:ViewOptions",
        "stream:run_view",
        "Show recordings, features, a run or a camera on a page in the browser.",
        extra="view",
    ),
}


def console() -> int:
    """Run the `anytouch` command.

    This silences XLA's C++ log: jaxlib 0.10.1 logs a spurious error for each program that it reads
    from the cache. Set TF_CPP_MIN_LOG_LEVEL to see it.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    return guarded("anytouch", lambda: _main(argv))


def _main(argv: Sequence[str] | None) -> int:
    args = list(sys.argv[1:] if argv is None else argv)
    if args[:1] == ["--version"]:
        print(__version__)
        return 0
    group = args[0] if args and args[0] in GROUPS else ""
    words = args[1:] if group else args
    if not words or words[0] in ("-h", "--help"):
        print(_usage(group))
        if words:
            return 0
        return 2
    name = f"{group} {words[0]}".strip()
    if name not in COMMANDS:
        print(_unknown(name, group), file=sys.stderr)
        return 2
    return guarded(f"anytouch {name}", lambda: _run(COMMANDS[name], name, words[1:]))


def _run(command: Command, name: str, words: Sequence[str]) -> int:
    """Read the words of a command and run it.

    Raises UserError that names the extra of a package that is not installed.
    """
    try:
        today = renamed.words(words, lambda line: print(line, file=sys.stderr))
        return command.run(command.parse(command.options, name, today))
    except ModuleNotFoundError as error:
        missing = error.name or ""
        # One of ours is a bug, and so is one that no extra brings.
        if not command.extra or missing.startswith("anytouch_jax"):
            raise
        raise lacking(f"anytouch {name}", missing, command.extra) from None


def guarded(program: str, run: Callable[[], int]) -> int:
    """Call `run` and return its exit status.

    `program` begins the sentence of an error; a bug keeps its traceback.
    """
    status = 2
    try:
        with warnings.catch_warnings():
            warnings.showwarning = partial(_show_warning, warnings.showwarning)
            try:
                status = run()
            except Exception as error:
                missing = _missing_devices()
                if missing is not None:
                    raise missing from error
                raise
        sys.stdout.flush()
        return status
    except SystemExit as stop:  # the parser's, after --help or a usage error
        if isinstance(stop.code, int):
            return stop.code
        return int(stop.code is not None)
    except UserError as error:
        sentence = str(error)
        status = 1 if isinstance(error, CheckError) else 2
    except BrokenPipeError:  # the reader of our output closed it (| head)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        advice = ". Free some space." if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        sentence = f"{error.filename or 'a file'}: {error.strerror or error}{advice}"
    except (MemoryError, RuntimeError) as error:
        # Python 3.11 wraps a Ctrl-C that comes while a class is made, as in an import.
        if isinstance(error.__cause__, KeyboardInterrupt):
            return _interrupted()
        # XLA's is a RuntimeError, and so are bugs
        if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        less = "Use a smaller --batch, --size, --gallery or --preset, or --model.remat in training."
        sentence = f"there is not enough memory. {less}"
    except KeyboardInterrupt:
        return _interrupted()
    print(f"{program}: {shorten(sentence)}", file=sys.stderr)
    return status


def _interrupted() -> int:
    """Say that the command was interrupted, and return its status."""
    print("interrupted", file=sys.stderr)
    return 130


def _missing_devices() -> UserError | None:
    """Return the error of a JAX_PLATFORMS that jax cannot use, None otherwise.

    jax raises it as one of many types, wherever its devices are needed first.
    """
    platforms = os.environ.get("JAX_PLATFORMS", "")
    jax = sys.modules.get("jax")
    if platforms in ("", "cpu") or jax is None:
        return None
    try:
        jax.devices()
    except Exception:
        return UserError(
            f"JAX_PLATFORMS is {platforms!r}, which jax cannot use here: unset it, or install jax "
            "for it"
        )
    return None


def _show_warning(
    default: Callable[..., None], message: Warning | str, category: type[Warning], *where: Any
) -> None:
    """Print a UserWarning of the library as a sentence.

    Python would show a line of code with it, which says nothing to a user.
    """
    if category is UserWarning:
        print(shorten(str(message)), file=sys.stderr)
    else:
        default(message, category, *where)


def _usage(group: str = "") -> str:
    """Return the help that lists the commands of a group, or all of them."""
    shown = COMMANDS
    prefix = ""
    about = "One representation of touch for many camera-based tactile sensors."
    example = "embed"
    if group:
        prefix = f"{group} "
        shown = {name: one for name, one in COMMANDS.items() if name.startswith(prefix)}
        about = GROUPS[group]
        example = next(iter(shown))
    width = max(map(len, shown))
    lines = "\n".join(f"  {name:{width}}  {command.summary}" for name, command in shown.items())
    return f"""usage: anytouch {prefix}COMMAND [options]

{about}

{lines}

Example: anytouch {example} --help

Every command explains its options and gives an example with --help."""


def _unknown(name: str, group: str) -> str:
    """Return the sentence that answers a command that does not exist."""
    if name in RENAMED:
        return f"anytouch: {name} has a new name: use {RENAMED[name]}."
    if group and name.partition(" ")[2].startswith("-"):
        choices = " or ".join(one for one in COMMANDS if one.startswith(f"{group} "))
        return f"anytouch: {group} needs a subcommand: {choices}."
    near = get_close_matches(name, [*COMMANDS, *GROUPS], 1)
    hint = f" Did you mean {near[0]}?" if near else ""
    return f"anytouch: there is no command {name!r}.{hint} See anytouch --help."
