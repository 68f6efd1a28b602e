"""Files: whole or not at all, locked, read with limits, and cached.

The names are defined in the modules of this folder, by subject, and are imported from here.
"""

from anytouch_jax.files.atomic import atomic_folder, atomic_path, atomic_write, part_path
from anytouch_jax.files.cache import cache_folder, remove_old
from anytouch_jax.files.csv_rows import csv_lines
from anytouch_jax.files.locks import lock
from anytouch_jax.files.npz import check_array, read_arrays
from anytouch_jax.files.placeholders import placeholder

__all__ = [
    "atomic_folder",
    "atomic_path",
    "atomic_write",
    "cache_folder",
    "check_array",
    "csv_lines",
    "lock",
    "part_path",
    "placeholder",
    "read_arrays",
    "remove_old",
]
