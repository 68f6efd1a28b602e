"""Makes the toy problem of this folder importable, and compiles each of its programs once for the whole folder."""

import jax
import pytest

from anytouch_jax.train.mesh import enable_compilation_cache

SETTINGS = {
    "jax_compilation_cache_dir": None,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


@pytest.fixture(scope="package", autouse=True)
def _compiled_once(tmp_path_factory):
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    for name, value in SETTINGS.items():
        jax.config.update(name, value)
    folder = enable_compilation_cache(tmp_path_factory.mktemp("compiled"))
    with pytest.MonkeyPatch.context() as patch:  # for child processes
        for name, value in (SETTINGS | {"jax_compilation_cache_dir": folder}).items():
            patch.setenv(name.upper(), str(value))
        yield
    for name, value in before.items():
        jax.config.update(name, value)
