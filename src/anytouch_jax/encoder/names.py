"""Names of the files that say what a folder or a file is: to ask for them needs nothing heavy."""

from pathlib import Path


def describes(path: Path) -> Path:
    """The JSON beside the artefact of `anytouch export`."""
    return path.with_name(f"{path.name}.json")
