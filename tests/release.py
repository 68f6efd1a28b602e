"""The check before a release: `make release-check`, or `python -m tests.release`.

It builds the wheel and the source archive, reads their metadata, installs the wheel into an empty
environment, and runs the README's Python there. All of it stays in build/release.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from email import message_from_string
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VERSIONS = ("3.11", "3.12", "3.13")
BLOCK = re.compile(r"^```python\n(.*?)^```$\n+^```text\n(.*?)^```$", re.MULTILINE | re.DOTALL)
BUILD = "import sys; from setuptools import build_meta; build_meta.build_{}(sys.argv[1])"


def ran(*command: object, cwd: Path) -> str:
    """Run a command without this project in its path, and return its output.

    Exit with its errors if it fails.
    """
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}\n{done.stderr}")
    return done.stdout


def build(folder: Path) -> tuple[Path, Path]:
    """Build the wheel and the source archive into a folder."""
    for kind in ("sdist", "wheel"):
        ran(sys.executable, "-c", BUILD.format(kind), folder, cwd=ROOT)
    (wheel,) = folder.glob("*.whl")
    (sdist,) = folder.glob("*.tar.gz")
    return wheel, sdist


def metadata_faults(wheel: Path) -> list[str]:
    """Return what the metadata of a wheel lack, as sentences."""
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        text = file.read(
            next(name for name in names if name.endswith(".dist-info/METADATA"))
        ).decode()
    about = message_from_string(text)
    classifiers = about.get_all("Classifier") or []
    links = about.get_all("Project-URL") or []
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "version"
    ]
    wanted = {
        f"the classifier of Python {one}": f"Programming Language :: Python :: {one}" in classifiers
        for one in VERSIONS
    }
    wanted |= {
        "a link to the project": bool(links),
        "a licence": about["License-Expression"] == "MIT"
        and any(name.endswith("LICENSE") for name in names),
        "the README": "```python" in str(about.get_payload()),
        "a summary": bool(about["Summary"]),
        f"the version {version}": about["Version"] == version,
        "the changelog of the version": f"[{version}]"
        in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
        "weights of an encoder": any(
            "weights/encoders/" in name and name.endswith(".safetensors") for name in names
        ),
        "py.typed": "anytouch_jax/py.typed" in names,
    }
    return [f"{name} is missing in {wheel.name}" for name, there in wanted.items() if not there]


def sdist_faults(sdist: Path) -> list[str]:
    """Return the files that a source archive lacks, as sentences."""
    with tarfile.open(sdist) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    return [
        f"{name} is missing in {sdist.name}"
        for name in ("pyproject.toml", "README.md", "LICENSE", "src/anytouch_jax/__init__.py")
        if name not in names
    ]


def main() -> int:
    """Check a release, and return 0 if it may go out."""
    folder = ROOT / "build" / "release"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    wheel, sdist = build(folder)
    print(wheel.name, sdist.name, flush=True)
    if faults := metadata_faults(wheel) + sdist_faults(sdist):
        print("\n".join(faults))
        return 1
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / "bin" / "python"
    ran(
        python,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-compile",
        "--disable-pip-version-check",
        wheel,
        cwd=folder,
    )
    print("installed into an empty environment", flush=True)
    (folder / "empty").mkdir()
    for code, shown in BLOCK.findall((ROOT / "README.md").read_text(encoding="utf-8")):
        if (printed := ran(python, "-c", code, cwd=folder / "empty")) != shown:
            print(f"README.md shows\n{shown}and prints\n{printed}")
            return 1
    print("the README's Python prints what it shows")
    return 0


if __name__ == "__main__":
    sys.exit(main())
