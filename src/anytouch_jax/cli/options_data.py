"""The options of the subcommands that make and check manifests; see `options` for the others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from anytouch_jax.cli.options import Paths


@dataclass(frozen=True)
class Index:
    """Turn a downloaded dataset, or recordings of your own, into a manifest: one row a tactile frame.

    Example: anytouch index ycb_slide ~/data/YCB-Slide --out ~/data/YCB-Slide/ycb_slide.parquet

    Datasets: touch_and_go, visgel, cloth, objectfolder_real, tvl, ssvtp, ycb_slide, octopi, tacquad, feel,
    objectfolder, real_touch, taxim_presses, recordings. The last is for your own: a folder of pictures each, as
    OBJECT/RECORDING/0.png, with background.png, photo.jpg and caption.txt beside them or above. What is left out is
    counted, with the reason and the first file.
    """

    name: str
    """Name of the dataset."""
    root: Path
    """Folder that holds it, as it was unpacked."""
    out: Path | None = None
    """Manifest to write, .parquet or .csv, in ROOT or a folder above it (default: ROOT/NAME.parquet)."""
    keep: bool = False
    """Carry what you edited in the manifest OUT over by path: columns, splits, text, labels. Without it, an edited OUT
    is refused."""
    val: float = 0.05
    """Share of the objects or recordings for the split val, where the dataset has no split of its own."""
    test: float = 0.05
    """Share for the split test, likewise."""
    lists: Path | None = None
    """Folder with the dataset's list files, where they are not in ROOT."""
    task: Literal["material", "rough"] = "material"
    """touch_and_go: whose lists decide the split."""
    fold: int = 0
    """feel: which of its split_<k>.npy decides the split."""
    export: bool = False
    """Let the reader write pictures into ROOT, where the dataset comes as arrays or films."""
    sensor: str | None = None
    """recordings: the sensor that made them, as in the configuration's table, or a new name."""
    split_by: Literal["object", "recording"] = "object"
    """recordings: hold out whole objects, or recordings of each object, for a classifier of objects."""
    labels: Path | None = None
    """recordings: CSV table with a column object or sequence (or both); every other column becomes label.NAME (unit,
    touch and text stay as they are)."""


@dataclass(frozen=True)
class Contact:
    """Mark the frames in which the gel is touched: the difference from the untouched gel, by sensor, without markers.

    Example: anytouch contact ycb_slide.parquet --drop --out ycb_touched.parquet --picture contact.png

    The manifest gets label.contact_score and label.contact (1, 0, or empty where nothing is known).
    """

    manifest: Path
    """Manifest to mark (.csv, .parquet)."""
    out: Path | None = None
    """Manifest to write (default: NAME_contact beside it)."""
    drop: bool = False
    """Leave out frames without contact; the split background and frames of which nothing is known stay."""
    threshold: tuple[tuple[str, float], ...] = ()
    """Score above which a frame is contact, by sensor: digit 5 gelsight 7."""
    share: float = 0.0
    """Contact also has this share of the highest score of its recording, 0 to 1: the moments when contact is made and
    broken, which tell little of what is touched, are none. What --picture and --check show is by threshold alone."""
    picture: Path | None = None
    """PNG of kept and dropped frames by rising score: look at it before you trust a threshold."""
    check: bool = False
    """Print precision and recall against a column that knows; writes a manifest only with --out."""
    reference: str | None = None
    """Column for --check (default: label.force, label.contact or label.contact_score)."""
    above: float | None = None
    """Value above which the column for --check means contact."""
    threads: int = 2
    """Threads that read pictures."""


@dataclass(frozen=True)
class Verify:
    """Check manifests and every file they name: missing, broken, odd size, twice, swapped, leaking between splits.

    Example: anytouch verify touch.parquet --repair touch_clean.parquet

    Exits 1 when there are errors, or errors that --repair left. Ends with the licences of the data.
    """

    manifests: Paths
    """Manifests to check together (.csv, .parquet)."""
    repair: Path | None = None
    """Write a copy with what is certain repaired: unusable rows and files, repeated rows, swapped folders."""
    commercial_only: Path | None = None
    """Write a copy with the rows that may certainly be used commercially (after --repair, if both are given)."""
    swap: tuple[str, ...] = ()
    """With --repair: exchange touch image and photograph in these datasets. You looked at them."""
    decode: bool = True
    """Read and decode every picture whole; --no-decode only sees that files are there."""
    objects: bool = False
    """An object on both sides of a split is an error."""
    threads: int = 4
    """Threads that read files."""
    out: Path | None = None
    """Write the report as JSON too."""


@dataclass(frozen=True)
class Pack:
    """Store millions of small files in a few Parquet shards; training reads the very same batches from them.

    Example: anytouch pack touch.parquet --out packed

    The same command again goes on where it was interrupted. Viewers of Parquet and `datasets` read the shards.
    """

    manifests: Paths
    """Manifests to pack into one (.csv, .parquet)."""
    out: Path | None = None
    """Folder for manifest.parquet and the shards (default: NAME_packed beside the first manifest)."""
    shard_mb: int = 256
    """Size of a shard, MiB."""
    threads: int = 4
    """Threads that read files."""


@dataclass(frozen=True)
class Annotate:
    """Have a vision-language model describe every touch that lacks a caption, as the paper had GPT-4o do.

    Example: anytouch annotate tacquad.parquet --model gpt-4o --price-in 2.5 --price-out 10 --limit 20 --sheet look.html

    Shows what it will cost and asks before it starts. The key is taken from the environment (OPENAI_API_KEY) and
    stored nowhere. The same command again asks nothing twice. Exits 1 when a caption could not be had.
    """

    manifest: Path
    """Manifest with photographs or phrases (.csv, .parquet)."""
    out: Path | None = None
    """Manifest to write (default: NAME_captions beside it)."""
    answers: Path | None = None
    """Folder that keeps every answer (default: NAME_answers beside the manifest)."""
    url: str = "https://api.openai.com/v1"
    """Base address of an OpenAI-compatible endpoint; one on this machine needs no key."""
    model: str = "gpt-4o"
    """Name of the model."""
    key_variable: str = "OPENAI_API_KEY"
    """Environment variable that holds the key."""
    yes: bool = False
    """Do not ask for confirmation."""
    estimate: bool = False
    """Print the estimate and stop."""
    price_in: float | None = None
    """Price of a million tokens in, for the estimate."""
    price_out: float | None = None
    """Price of a million tokens out."""
    limit: int | None = None
    """Only the first so many captions: look at a sample first."""
    captions: Path | None = None
    """Ask nobody: take the captions of this table (.csv, .parquet), a key column and `text`."""
    key: str | None = None
    """Column of table and manifest by which --captions are found: caption_id, sequence, object, path ..."""
    sheet: Path | None = None
    """HTML page of captions beside their pictures, to check by hand."""
    sheet_count: int = 40
    """Captions on that page."""
    split: str | None = None
    """Only rows of this split."""
    family: tuple[tuple[str, Literal["photograph", "object", "phrase"]], ...] = ()
    """Which prompt a dataset of your own gets: mydata photograph."""
    second_image: str = "image2_path"
    """Column of a second photograph, for the prompt of the family object."""
    overwrite: bool = False
    """Also ask for rows that have a caption."""
    threads: int = 4
    """Questions at a time."""
    side: int = 512
    """Longest side of the pictures that are sent, pixels."""
    timeout: float = 60.0
    """Seconds for one answer."""
    tries: int = 5
    """Tries for one question."""
    max_tokens: int = 200
    """Most tokens of an answer."""
    token_field: str = "max_tokens"
    """Name of that limit in the protocol; newer models want max_completion_tokens."""
    temperature: float | None = 0.0
    """Temperature; None is not sent."""
    json_mode: bool = True
    """Ask for a JSON object; --no-json-mode for servers that do not know it."""
