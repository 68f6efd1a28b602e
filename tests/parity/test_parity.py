"""This implementation against outputs and gradients of the authors' PyTorch code; and that the
check can fail.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from places import SHARED

from anytouch_jax.errors import UserError
from tests.parity import cases
from tests.parity.golden_files import GRADIENT, Case, Row, read_cases
from tests.parity.run import main

HERE = Path(__file__).parent / "golden"
ALL = SHARED / "golden"  # the whole set, where it lies next to the checkout
WHOLE = [case.name for case in read_cases(ALL)] if ALL.is_dir() else []
SAVED = sorted(ALL.glob("*.pth"))
CASES = {case.name: case for case in read_cases(HERE)}
COMPARISONS = {  # at least so many: a case that compares nothing would be within tolerance too
    "A_stage1_image": 70,
    "A_stage1_image_small_scale": 8,
    "F_stage2_match_image": 50,
    "I_pos_embed": 2,
    "stage1_params": 1,
    "stage2_params": 1,
}


def copied(tmp_path: Path, name: str, info=None, **changes) -> Path:
    """A folder with one case (and the parameters it needs), arrays changed by functions of the old
    ones.
    """
    for file in (f"{name}.json", f"{name}.npz", *(p.name for p in HERE.glob("stage1_params.*"))):
        shutil.copy(HERE / file, tmp_path)
    with np.load(HERE / f"{name}.npz") as file:
        arrays = dict(file)
    for key, change in changes.items():
        arrays[key] = change(arrays.get(key))
    np.savez(tmp_path / f"{name}.npz", **arrays)
    described = json.loads((HERE / f"{name}.json").read_text())
    (tmp_path / f"{name}.json").write_text(json.dumps((info or (lambda x: x))(described)))
    return tmp_path


def bad(folder: Path) -> dict[str, Row]:
    return {row.array: row for row in cases.run(folder) if not row.good}


@pytest.mark.parametrize("name", sorted(COMPARISONS))
def test_a_case_is_within_tolerance(name):
    rows = cases.run_case(CASES[name])
    assert {r.array: (r.error, r.tolerance, r.note) for r in rows if not r.good} == {}
    assert len(rows) >= COMPARISONS[name]


def test_every_case_of_the_folder_is_run():
    assert set(CASES) == set(COMPARISONS)
    if ALL.is_dir():
        assert set(WHOLE) > set(COMPARISONS)
        assert {path.name.split("_")[0] for path in SAVED} == {"stage1", "stage2"}


@pytest.mark.slow
@pytest.mark.parametrize("name", WHOLE)
def test_a_case_of_the_whole_set_is_within_tolerance(name):
    (case,) = [case for case in read_cases(ALL) if case.name == name]
    assert {
        r.array: (r.error, r.tolerance, r.note) for r in cases.run_case(case) if not r.good
    } == {}


@pytest.mark.slow
@pytest.mark.parametrize("path", SAVED, ids=lambda path: path.name)
def test_the_authors_checkpoints_give_the_recorded_parameters(path, tmp_path):
    stage = path.name.split("_")[0]
    for file in (path, ALL / f"{stage}_params.npz", ALL / f"{stage}_params.json"):
        shutil.copy(file, tmp_path)
    rows = cases.run(tmp_path)
    assert [row.case for row in rows] == [f"{stage}_params", path.name] and all(
        row.good for row in rows
    )


NEW = {"out/new": lambda _: np.zeros(3, np.float32)}


@pytest.mark.parametrize(
    ("case", "changes", "lists", "note"),
    [
        (
            "A_stage1_image_small_scale",
            {"out/latent": lambda x: np.where(x == x.max(), np.nan, x)},
            {},
            "",
        ),
        ("I_pos_embed", {"pos_embed_32_4_cls": lambda x: x[:, :16]}, {}, "shape"),
        ("I_pos_embed", NEW, {"out/new": [[3], "float32"]}, "not understood"),
        ("I_pos_embed", NEW, {}, "not understood"),
    ],
    ids=["a NaN", "another shape", "an array that nobody compares", "one that is not listed"],
)
def test_what_cannot_be_compared_is_reported(tmp_path, case, changes, lists, note):
    folder = copied(
        tmp_path, case, lambda info: info | {"arrays": info["arrays"] | lists}, **changes
    )
    assert note in bad(folder)[next(iter(changes))].note


def test_unknown_broken_and_empty_cases_are_failures_not_tracebacks(tmp_path):
    with pytest.raises(UserError, match="no golden case"):
        cases.run(tmp_path)
    for name in ("Z_new", "A_broken", "I_pos"):
        (tmp_path / f"{name}.json").write_text("{}")
    np.savez(tmp_path / "I_pos.npz", unknown=np.zeros(3))
    rows = [row for row in cases.run(tmp_path) if not row.good]
    assert [row.case for row in rows] == ["A_broken", "I_pos", "Z_new"] and rows[
        1
    ].note == "nothing was compared"
    assert all("understand" in row.note or "understood" in row.note for row in rows[::2])
    (tmp_path / "A_x.json").write_text("{")
    with pytest.raises(UserError, match=r"A_x\.json is not JSON"):
        cases.run(tmp_path)


def test_tolerances_are_the_larger_of_relative_and_five_times_the_noise():
    case = Case("c", HERE, {"float32_vs_float64": {"arrays": {"out/a": [3e-4, 10.0]}}})
    case.arrays = {
        "out/a": np.array([10.0, 0.0]),
        "out/b": np.array([10.0, 0.0]),
        "out/c": np.zeros(2),
    }
    case.compare("out/a", np.array([10.0, 1e-3]))
    case.compare("out/b", np.array([10.0, 1e-3]), GRADIENT)
    case.compare("out/c", np.array([0.0, 2e-5]))
    a, b, c = case.rows
    assert a.good and a.error == pytest.approx(1e-4) and a.tolerance == pytest.approx(1.5e-4)
    assert not b.good and b.tolerance == pytest.approx(GRADIENT)
    # a recorded zero is compared in absolute terms, and not with a tolerance of its size
    assert not c.good
    assert not Row("c", "d", float("nan"), 1.0).good


def test_exit_codes_and_table_of_the_command(tmp_path, capsys):
    good = tmp_path / "good"
    wrong = tmp_path / "wrong"
    for folder in (good, wrong):
        folder.mkdir()
    assert main([str(copied(good, "I_pos_embed"))]) == 0
    assert "0 out of tolerance" in capsys.readouterr().out
    assert (
        main([str(copied(wrong, "I_pos_embed", pos_embed_32_4_cls=lambda x: x + 1)), "--verbose"])
        == 1
    )
    out = capsys.readouterr().out
    assert (
        "1 out of tolerance" in out
        and "pos_embed_32_4_cls" in out
        and "OUT" in out
        and "pos_embed_512_16_cls" in out
    )
