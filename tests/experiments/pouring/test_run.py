import json

import pytest
from PIL import Image

from experiments.pouring import run as pour


@pytest.mark.slow
def test_a_run_pours(script, tiny_run, tmp_path):
    out = tmp_path / "deep" / "pour"
    logged = script(pour, "--model", tiny_run, "--trials", 2, "--demos", 2, "--steps", 20, "--out", out)
    assert logged.status == 0, logged.err
    lines = logged.out.splitlines()
    masses = [float(line.split("|")[2]) for line in lines if line.startswith(("| 1 |", "| 2 |"))]
    result = json.loads((out / "pour.json").read_text())
    assert masses == pytest.approx(result["poured"]["touch"], abs=0.06) and all(0 <= m <= 100 for m in masses)
    means = {name: sum(abs(m - 60) for m in some) / 2 for name, some in result["poured"].items()}
    for name in ("touch", "blind", "count", "expert"):
        line = next(line for line in lines if line.startswith(f"{name}: mean error "))
        assert float(line.split()[3]) == pytest.approx(means[name], abs=0.06) and "95 %" in line
    assert means["expert"] < 5
    with Image.open(out / "pour.gif") as film:
        assert film.n_frames > 3


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--model", "nowhere"], "nowhere"), (["--model", "x", "--trials", "0"], "--trials"),
        (["--model", "x", "--demos", "0"], "--demos"), (["--model", "x", "--steps", "0"], "--steps"),
        (["--record", "y", "--demos", "1"], "--demos"), (["--recordings", "x.parquet"], "--model"),
    ],
)  # fmt: skip
def test_mistakes_are_one_sentence(script, words, named):
    logged = script(pour, *words)
    assert logged.status == 2 and named in logged.err and len(logged.err.strip().splitlines()) == 1


def test_what_was_recorded_is_not_mixed_with_new_pictures(script, tmp_path):
    (tmp_path / "manifest.parquet").write_bytes(b"of an earlier recording")
    logged = script(pour, "--record", tmp_path, "--demos", 2)
    assert logged.status == 2 and len(list(tmp_path.iterdir())) == 1


def test_a_policy_of_other_settings_is_not_written_over(script, tiny_run, tmp_path):
    kept = '{"model": "%s", "target": 60.0, "demonstrations": 2, "seed": 0, "stills": false, "fine_tuned": %s}'
    (tmp_path / "pour.json").write_text(kept % (tiny_run, "true"))
    logged = script(pour, "--model", tiny_run, "--demos", 2, "--out", tmp_path)
    assert logged.status == 2 and "(fine_tuned, markers)" in logged.err
    assert "--out" in logged.err and len(list(tmp_path.iterdir())) == 1
    logged = script(pour, "--model", tiny_run, "--demos", 2, "--steps", 3, "--out", tmp_path)
    assert logged.status == 2 and "(fine_tuned, markers, steps)" in logged.err


@pytest.mark.slow
def test_demonstrations_are_recorded_and_learned_from(script, tiny_run, tmp_path):
    demos, out = tmp_path / "demos", tmp_path / "policy"
    assert script(pour, "--record", demos, "--demos", 4, "--size", 28).status == 0
    logged = script(pour, "--model", tiny_run, "--recordings", demos / "manifest.parquet", "--steps", 20, "--out", out)
    assert logged.status == 0, logged.err
    assert "3 runs of gelsight_mini to learn from, 1 of split test" in logged.err
    assert {"touch", "blind"} <= json.loads((out / "pour.json").read_text()).keys()
    assert {path.name for path in out.iterdir()} == {"policy.npz", "encoder.safetensors", "pour.json"}
