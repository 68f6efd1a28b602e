import numpy as np
import pytest
from checked_world import finding_rows, image_pairs, plain_rows, with_patterns

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import replace_column, select_rows
from anytouch_jax.data.prepare.repair import repair
from anytouch_jax.data.prepare.verify import verify
from anytouch_jax.errors import UserError


@pytest.fixture
def make(make):
    return with_patterns(make)


@pytest.mark.parametrize("witness", [True, False])
def test_a_swapped_dataset_is_suspected_and_mended_only_with_a_witness(make, tmp_path, witness):
    loose = image_pairs(tmp_path, make, swap=lambda i: True, witness=witness)
    report = verify(loose)
    (finding,) = (f for f in report.findings if f.kind == "swapped")
    assert finding.rows.tolist() == list(range(24)) and finding.level == ("error" if witness else "warning")
    assert ("suspected" in finding.sentence) != witness and "'tvl'" in finding.sentence
    fixed = repair(loose, report)
    if not witness:
        assert not fixed.done and any("swapped" in sentence for sentence in fixed.left)
        fixed = repair(loose, report, swap=["tvl"])
    assert len(fixed.done) == 1 and not any("swapped" in sentence for sentence in fixed.left)
    assert fixed.manifest.column("path").to_pylist()[:2] == ["see0.png", "see1.png"]
    assert fixed.manifest.column("image_path").to_pylist()[:2] == ["touch0.png", "touch1.png"]
    assert "swapped" not in finding_rows(verify(fixed.manifest))
    with pytest.raises(UserError, match="no dataset 'tlv' to swap; the manifest has tvl"):
        repair(loose, report, swap=["tlv"])


def test_an_exchanged_row_lives_by_its_new_touch_image(make, tmp_path):
    loose = image_pairs(tmp_path, make, swap=lambda i: True, witness=True)
    (tmp_path / "touch3.png").unlink()  # a photograph, in truth
    (tmp_path / "see5.png").write_bytes(b"")  # a touch image, in truth
    fixed = repair(loose, verify(loose), swap=["tvl"])
    kept = fixed.manifest.column("path").to_pylist()
    assert "see5.png" not in kept and kept[3] == "see3.png" and fixed.manifest.value(3, "image_path") is None
    assert len(kept) == 24


def test_repair_says_when_it_cannot_or_may_not(make, tmp_path):
    loose = make(plain_rows())
    with pytest.raises(UserError, match="of another manifest"):
        repair(select_rows(loose, np.arange(3)), verify(loose))
    manifests.write(loose, tmp_path / "manifest.csv")
    before = (tmp_path / "manifest.csv").read_bytes()
    loose = manifests.read(tmp_path / "manifest.csv")
    loose.file(0).unlink()
    fixed = repair(loose, verify(loose))
    assert (tmp_path / "manifest.csv").read_bytes() == before and len(fixed.manifest) == 5
    for row in range(1, 6):
        loose.file(row).unlink()
    with pytest.raises(UserError, match="are the files really in"):
        repair(loose, verify(loose))


def test_a_row_is_dropped_for_one_reason_only(make):
    loose = make([{"path": "one.png", "sequence": "s"}] * 2 + [{"path": "two.png"}])
    loose.file(0).write_bytes(b"no picture")
    assert repair(loose, verify(loose)).done == ("dropped 2 rows whose touch image cannot be used (2 unreadable)",)


def test_backgrounds_that_changed_places_too_are_no_witness(make, tmp_path):
    """TVL: the frames without contact lie in the same two folders as the others."""
    loose = image_pairs(tmp_path, make, swap=lambda i: True, witness=False)
    split = ["background" if i % 4 == 0 else "train" for i in range(24)]
    loose = replace_column(loose, "split", split)
    loose = replace_column(loose, "background_path", ["touch0.png"] * 24)
    report = verify(loose)
    (finding,) = (f for f in report.findings if f.kind == "swapped")
    assert finding.level == "warning" and "suspected" in finding.sentence
    fixed = repair(loose, report, swap=["tvl"])
    assert fixed.manifest.column("path").to_pylist()[:2] == ["see0.png", "see1.png"]
    assert fixed.manifest.column("background_path").null_count == 24


def test_backgrounds_go_with_the_dataset_that_is_exchanged(make, tmp_path):
    loose = image_pairs(tmp_path, make, swap=lambda i: True, witness=True)
    split = ["background" if i % 4 == 0 else "train" for i in range(24)] + ["background"]
    loose = replace_column(loose, "split", split)
    fixed = repair(loose, verify(loose))
    assert fixed.manifest.column("path").to_pylist()[:24] == [f"see{i}.png" for i in range(24)]
