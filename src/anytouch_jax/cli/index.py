"""`anytouch index`: a downloaded dataset becomes a manifest."""

from __future__ import annotations

from anytouch_jax.cli.options_data import Index


def run(options: Index) -> int:
    """Read the dataset, write its manifest, print what was found beside the paper's count."""
    from anytouch_jax.data import readers

    told = readers.IndexOptions(
        val=options.val, test=options.test, lists=options.lists, task=options.task, fold=options.fold,
        export=options.export, sensor=options.sensor, split_by=options.split_by, labels=options.labels,
    )  # fmt: skip
    report = readers.index(options.name, options.root, options.out, options=told, keep=options.keep)
    print("\n".join(report.lines()))
    return 0
