"""`anytouch pack`: a manifest's files in a few Parquet shards."""

from __future__ import annotations

from anytouch_jax.cli.options_data import Pack
from anytouch_jax.cli.output import beside
from anytouch_jax.cli.words import log
from anytouch_jax.errors import UserError


def run(options: Pack) -> int:
    """Pack, or go on with a pack that was interrupted."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.prepare.shards import pack

    manifest = manifests.read(options.manifests)
    folder = options.out or beside(options.manifests[0], "packed", "")
    try:
        target = pack(manifest, folder, shard_bytes=options.shard_mb << 20, threads=options.threads, log=log)
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror or error}") from None
    print(f"{target}: {len(manifest):,} rows; train on it as on any manifest. Check a copy: sha256sum -c SHA256SUMS")
    return 0
