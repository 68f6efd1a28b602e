import json
from types import SimpleNamespace

import numpy as np
import pytest
from touch_world import make_touches

import anytouch_jax as at
from anytouch_jax.cli.app import main
from anytouch_jax.cli.inputs import choose_gel
from anytouch_jax.data.images import encode
from anytouch_jax.encoder import embed


@pytest.fixture(scope="module")
def touches(tmp_path_factory):
    return make_touches(
        tmp_path_factory.mktemp("touches"), touches={"train": 6, "val": 6, "test": 10}, each=2
    )


def test_retrieval_of_a_run_and_its_controls(touches, tiny_run, tmp_path, capsys):
    out = tmp_path / "deep" / "found.json"
    words = ["--model", str(tiny_run), "--data", str(touches), "--gallery", "6", "--out", str(out)]
    assert main(["retrieve", *words]) == 0
    table = capsys.readouterr().out
    for name in (
        str(tiny_run),
        "random encoder",
        "pixels minus background",
        "area, centroid, force",
    ):
        assert f"| {name} | all | all |" in table
    result = json.loads(out.read_text())
    assert result["split"] == "test" and len(result["data"]) == 64
    pooled = {
        one["name"]: one
        for one in result["results"]
        if one["query_sensor"] == "all" and not one["centred"]
    }
    assert len(pooled) == 4
    for one in pooled.values():
        assert (
            one["gallery"] == 6 and one["queries"] == 60 and one["chance1"] == pytest.approx(1 / 6)
        )
        assert one["low"] <= one["top1"] <= one["high"] <= one["top5_high"]
    # every touch has its own texture
    assert pooled["pixels minus background"]["top1"] > 0.4
    fractions = []
    for more in ([], ["--by-chance"]):
        assert main(["retrieve", "--data", str(touches), "--gallery", "6", *more]) == 0
        line = next(
            x for x in capsys.readouterr().out.splitlines() if "force | all | all | no" in x
        )
        fractions.append(float(line.split("|")[5].split()[0]))
    assert fractions[1] > fractions[0]


def test_a_mistake_is_one_sentence(touches, mistake, tmp_path, world, monkeypatch):
    monkeypatch.setattr(embed, "embed_rows", lambda *_, **__: pytest.fail("the work was begun"))
    for words, named in (
        ("--split unused", "unused"),
        ("--model nowhere", "nowhere"),
        ("--gallery 5000", "5000"),
        ("--gallery 1", "--gallery"),
        ("--frames -1", "--frames"),
        ("--seeds 2", "--seeds"),
        ("--count 3", "--count"),
    ):
        assert named in mistake("retrieve", "--data", touches, *words.split())
    assert "--index" in mistake("retrieve")
    words = [
        "--data",
        touches,
        "--stage1",
        tmp_path / "s1",
        "--stage2",
        tmp_path / "s2",
        "--out",
        tmp_path / "report",
    ]
    assert "s1" in mistake("report", *words) and not (tmp_path / "report").exists()


def test_stored_touches_are_searched_by_a_frame(
    anytouch, mistake, monkeypatch, tmp_path, tiny_run, world
):
    index = tmp_path / "index.npz"
    assert anytouch("embed", "--model", tiny_run, "--data", world, "--out", index).status == 0
    with np.load(index) as file:
        path = str(file["key/path"][3])
    words = ("retrieve", "--index", index, "--model", tiny_run, "--query")
    gel = ("--sensor", "digit", "--count", 4, "--out", tmp_path / "hits.json")
    done = anytouch(*words, world.parent / path, *gel)
    assert done.status == 0, done.err
    hits = json.loads((tmp_path / "hits.json").read_text())["hits"]
    assert len(hits) == 4 and hits[0]["path"] in done.out
    cosines = [float(hit["cosine"]) for hit in hits]
    assert cosines == sorted(cosines, reverse=True)
    assert "text tower" in mistake(*words, "a soft sponge")
    assert "--query" in mistake(*words[:-1])
    assert "--split" in mistake(*words, "x", "--split", "val")
    monkeypatch.setattr(
        "anytouch_jax.encoder.encoder.load_encoder", lambda _: pytest.fail("loaded")
    )
    assert "did you mean digit" in mistake(*words, world.parent / path, "--sensor", "DIGIT")


def test_a_image_of_the_index_is_no_other_sensor(tmp_path, capfd):
    """Two of the package's examples differ by 13 grey levels or more from their own gels."""
    encoder = SimpleNamespace(subtracts=True, needs_background=True)
    touches = at.example_touches()
    known = {f"{touch.sensor} {touch.press}": touch.background for touch in touches}
    for touch in touches:
        path = tmp_path / "query.png"
        path.write_bytes(encode(touch.frame))
        gel, what = choose_gel(encoder, None, path, known, "the index was made with")
        said = capfd.readouterr().err
        assert gel is not None and any(gel is one for one in known.values())
        assert said == f"untouched gel: {what}\n" and "image that the index was made with" in what
        assert "head" not in said and "trust" not in said
