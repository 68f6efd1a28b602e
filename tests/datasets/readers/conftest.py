"""One fixture: index a small dataset, and check what must hold for every manifest."""

from collections.abc import Callable
from pathlib import Path

import pytest
from reader_world import Table, check_laws

from anytouch_jax.datasets.readers import IndexOptions, index


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Table]:
    """read(name, root=tmp_path, out=None, **options): index a dataset, check the laws of every
    manifest.
    """

    def run(name: str, root: Path = tmp_path, out: Path | None = None, **options: object) -> Table:
        table = Table(index(name, root, out, options=IndexOptions(**options)))  # type: ignore[arg-type]
        check_laws(table, root)
        again = Table(index(name, root, out, options=IndexOptions(**options)))  # type: ignore[arg-type]
        # one order, always
        assert again.manifest.content_hash == table.manifest.content_hash
        return table

    return run
