"""Groups and arrays of a zarr, versions 2 and 3, by their JSON alone.

They are read before zarr opens anything, because opening an array already runs the codecs that its
JSON names.
"""

from __future__ import annotations

import json
import math
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

from anytouch_jax.errors import UserError

_MOST_BYTES = 1 << 26  # of a JSON file
_MOST_MEMBER = 1 << 29  # of a file in a .zarr.zip: one chunk
_DEEPEST = 32
_JSON = (".zarray", ".zgroup", "zarr.json")


class Node(NamedTuple):
    """A group or an array.

    Attributes:
        is_array: Whether it is an array.
        version: Of the format, 2 or 3.
        attributes: As the user wrote them.
        codecs: Names of all codecs that reading it runs.
        chunk_bytes: Of a chunk when it is unpacked, 0 if unknown.
    """

    is_array: bool
    version: Literal[2, 3]
    attributes: dict[str, Any]
    codecs: set[str]
    chunk_bytes: int


def read_nodes(path: Path) -> dict[str, Node]:
    """Return the groups and arrays of a zarr by key, "" for its root.

    Raises UserError for a folder or a ZIP file that is none, and for one with a chunk that would
    fill the memory.
    """
    if path.is_dir():
        nodes = dict(_walk(_Folder(path), ""))
    else:
        with zipfile.ZipFile(path) as archive:
            large = [one.filename for one in archive.infolist() if one.file_size > _MOST_MEMBER]
            if large:
                raise UserError(f"{path}: {large[0]} has more than {_MOST_MEMBER} bytes")
            nodes = dict(_walk(_Archive(archive), ""))
    if not nodes:
        raise UserError(
            f"{path} is no zarr: it has no {', '.join(_JSON)} at its top; give the folder that has"
        )
    return nodes


class _Folder:
    """A zarr in a folder."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self, name: str) -> bytes | None:
        """Return a file, None if there is none."""
        file = self._path / name
        if not file.is_file():
            return None
        if file.stat().st_size > _MOST_BYTES:
            raise UserError(f"{file} has more than {_MOST_BYTES} bytes")
        return file.read_bytes()

    def folders(self, key: str) -> list[str]:
        """Return the names of the folders in one."""
        return [one.name for one in (self._path / key).iterdir() if one.is_dir()]


class _Archive:
    """A zarr in a ZIP file."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        self._sizes = {one.filename: one.file_size for one in archive.infolist()}
        self._folders: dict[str, dict[str, None]] = {}
        for name in self._sizes:
            parts = name.split("/")[:-1]
            for at, part in enumerate(parts):
                self._folders.setdefault("/".join(parts[:at]), {})[part] = None

    def read(self, name: str) -> bytes | None:
        """Return a file, None if there is none."""
        if name not in self._sizes:
            return None
        if self._sizes[name] > _MOST_BYTES:
            raise UserError(f"{name} in the ZIP file has more than {_MOST_BYTES} bytes")
        return self._archive.read(name)

    def folders(self, key: str) -> list[str]:
        """Return the names of the folders in one."""
        return list(self._folders.get(key, ()))


def _walk(store: _Folder | _Archive, key: str, depth: int = 0) -> Iterator[tuple[str, Node]]:
    """Yield a node and all below it. The folders of an array are its chunks, and not entered."""
    node = _node(store.read, f"{key}/" if key else "")
    if node is None:
        return
    yield key, node
    if node.is_array:
        return
    if depth == _DEEPEST:
        raise UserError(f"{key} is a group {depth} levels deep; no group lies deeper than that")
    for name in store.folders(key):
        yield from _walk(store, f"{key}/{name}".lstrip("/"), depth + 1)


def _node(read: Callable[[str], bytes | None], base: str) -> Node | None:
    """Return the node of a folder, None if it is none."""
    about = _object(read(f"{base}zarr.json"))
    if about is not None:
        return _version_3(about)
    array = _object(read(f"{base}.zarray"))
    if array is None and read(f"{base}.zgroup") is None:
        return None
    attributes = _object(read(f"{base}.zattrs")) or {}
    if array is None:
        return Node(False, 2, attributes, set(), 0)
    codecs = [array.get("compressor"), *(array.get("filters") or ())]
    names = {str(one.get("id")) for one in codecs if isinstance(one, dict)}
    size = math.prod(array.get("chunks") or ()) * _item_bytes(array.get("dtype"))
    return Node(True, 2, attributes, names, size)


def _version_3(about: dict[str, Any]) -> Node:
    attributes = about.get("attributes") or {}
    if about.get("node_type") != "array":
        return Node(False, 3, attributes, set(), 0)
    grid = (about.get("chunk_grid") or {}).get("configuration") or {}
    codecs = about.get("codecs") or []
    # A shard is a chunk of chunks, which are read one by one.
    inner = next((one for one in codecs if one.get("name") == "sharding_indexed"), None)
    shape = grid.get("chunk_shape") or ()
    if inner is not None:
        shape = inner["configuration"]["chunk_shape"]
    size = math.prod(shape) * _item_bytes(about.get("data_type"))
    return Node(True, 3, attributes, set(_names(codecs)), size)


def _names(codecs: Any) -> Iterator[str]:
    """Yield the names of codecs, and of those in them. "numcodecs.zlib" is zlib."""
    if isinstance(codecs, list):
        for one in codecs:
            yield from _names(one)
    elif isinstance(codecs, dict):
        if "name" in codecs:
            yield str(codecs["name"]).removeprefix("numcodecs.")
        configuration = codecs.get("configuration")
        if isinstance(configuration, dict):
            for name in ("codecs", "index_codecs"):
                yield from _names(configuration.get(name))
    elif isinstance(codecs, str):
        yield codecs.removeprefix("numcodecs.")


def _item_bytes(kind: Any) -> int:
    """Return the bytes of a value of a type as zarr writes it: "<f4", "|u1", "float32"."""
    if not isinstance(kind, str):
        return 1
    match = re.fullmatch(r"[<>|]?[a-zA-Z]+(\d+)", kind)
    if match is None:
        return 1
    number = int(match[1])
    # version 2 counts bytes, version 3 bits
    is_short = re.fullmatch(r"[<>|][a-zA-Z]\d+", kind) is not None
    return number if is_short else max(1, number // 8)


def _object(data: bytes | None) -> dict[str, Any] | None:
    if data is None:
        return None
    content = json.loads(data)
    if not isinstance(content, dict):
        raise UserError("its metadata are no JSON object")
    return content
