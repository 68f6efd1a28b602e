"""`anytouch data pack`: files of a manifest in a few ZIP shards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from anytouch_jax.cli.output import default_target, log
from anytouch_jax.config.parsing import Count, Threads


@dataclass(frozen=True)
class PackOptions:
    """Store millions of small files in a few ZIP shards, from which training reads the same batches.

    Example: anytouch data pack touch.parquet --out packed

    Run the same command again to continue after an interruption.
    """

    manifests: Positional[tuple[Path, ...]]  # Manifests to pack into one (.csv, .parquet).
    out: Path | None = None
    """Folder for manifest.parquet and the shards (default: NAME_packed, next to the first manifest)."""
    shard_mb: Count[int] = 256  # Size of a shard, MiB.
    threads: Threads = 4  # Threads that read files.


def run(options: PackOptions) -> int:
    """Pack the files, or continue an interrupted pack."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.prepare.shards import pack

    manifest = manifests.read(options.manifests)
    folder = options.out or default_target(options.manifests[0], "packed", "")
    target = pack(manifest, folder, shard_bytes=options.shard_mb << 20, threads=options.threads, log=log)
    print(
        f"{target}: {len(manifest):,} rows. Train on it as on any manifest. Check a copy with sha256sum -c SHA256SUMS."
    )
    return 0
