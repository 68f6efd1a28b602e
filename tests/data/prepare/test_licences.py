import numpy as np
import pytest
from checked_world import finding_rows, with_patterns

from anytouch_jax.data.manifest.manifest import select_rows
from anytouch_jax.data.prepare.licences import NO, UNKNOWN, YES, allows, commercial_only, commercial_use, licences
from anytouch_jax.data.prepare.verify import verify
from anytouch_jax.errors import UserError


@pytest.fixture
def make(make):
    return with_patterns(make)


@pytest.mark.parametrize(
    ("licence", "use"),
    [
        ("MIT", YES), ("mit license", YES), ("Apache-2.0", YES), ("Apache 2.0 License", YES), ("BSD-3-Clause", YES),
        ("CC-BY-4.0", YES), ("CC BY-SA 4.0", YES), ("CC0", YES), ("CC-BY-NC-4.0", NO), ("CC BY-NC-SA 4.0", NO),
        ("non-commercial", NO), ("for research use only", NO), ("academic only", NO), ("Noncommercial terms", NO),
        ("custom", UNKNOWN), ("", UNKNOWN), (None, UNKNOWN), ("MIT, data under other terms", UNKNOWN),
        ("ncsa", UNKNOWN),
    ],
)  # fmt: skip
def test_licences_by_name(licence, use):
    assert allows(licence) == use


def test_commercial_rows_are_those_that_certainly_are(make):
    cases = [("MIT", None), ("MIT", True), ("MIT", False), ("CC-BY-NC-4.0", True), (None, True), (None, None),
             ("custom", True), ("custom", None)]  # fmt: skip
    rows = [{"license": name, "commercial": flag, "dataset": f"d{i % 2}"} for i, (name, flag) in enumerate(cases)]
    loose = make(rows)
    assert commercial_use(loose).tolist() == [YES, YES, NO, NO, YES, UNKNOWN, YES, UNKNOWN]
    kept = commercial_only(loose)
    assert kept.manifest.column("path").to_pylist() == [f"f{i}.png" for i in (0, 1, 4, 6)]
    assert (kept.non_commercial, kept.unknown) == (2, 2)
    assert kept.manifest.where(3) == loose.where(6)
    report = verify(loose)
    assert finding_rows(report) == {"licence_conflict": [3]} and "'CC-BY-NC-4.0'" in report.findings[0].examples[0]
    result = licences(loose)
    assert sum(entry.rows for entry in result) == 8 and result[0] == ("MIT", YES, ("d0", "d1"), 2)
    with pytest.raises(UserError, match=r"2 may not, 2 do not say"):
        commercial_only(select_rows(loose, np.array([2, 3, 5, 7])))
