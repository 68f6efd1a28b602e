"""The wheel: everything of `src` is in it, and it works where no checkout is."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
from places import ROOT


def ran(*command, cwd: Path) -> str:
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_wheel_works_in_an_empty_folder(tmp_path):
    """Without a network: the tools that build and what is imported are those of this
    environment.
    """
    source, empty, home = (tmp_path / name for name in ("source", "empty", "venv"))
    empty.mkdir()
    shutil.copytree(
        ROOT / "src", source / "src", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
    )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    ran(
        *pip,
        "wheel",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
        "-w",
        tmp_path,
        source,
        cwd=tmp_path,
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        packed = {name for name in file.namelist() if ".dist-info/" not in name}
    files = (
        p.relative_to(ROOT / "src")
        for p in (ROOT / "src" / "anytouch_jax").rglob("*")
        if p.is_file()
    )
    assert packed == {p.as_posix() for p in files if "__pycache__" not in p.parts}
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    ran(*pip, "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=tmp_path)
    place = Path(
        ran(
            python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=empty
        ).strip()
    )
    # after its own, so the wheel comes first
    (place / "others.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    assert ran(
        python, "-c", "import anytouch_jax; print(anytouch_jax.__file__)", cwd=empty
    ).startswith(str(place))
    assert "usage: anytouch COMMAND" in ran(home / "bin" / "anytouch", "--help", cwd=empty)
    assert "--on-bad-sample" in ran(home / "bin" / "anytouch", "train", "--help", cwd=empty)
    shape = (
        "at.load_encoder('anytouch-tiny').encode_touch(at.example_touches()[0].frame[:112, "
        ":112]).shape"
    )
    assert (
        ran(python, "-c", f"import anytouch_jax as at; print({shape})", cwd=empty).strip()
        == "(1, 448)"
    )
    assert not list(empty.iterdir())
