import math
import subprocess
import sys

import pytest
from places import ROOT

from anytouch_jax.errors import UserError
from experiments.records import read_records, write_record


def test_what_is_written_is_read_in_the_order_of_the_keys(tmp_path):
    path = tmp_path / "new" / "study.jsonl"
    assert read_records(path) == {}
    for key, value in (("b", 1), ("a", [1.5, None]), ("b", 2)):
        write_record(path, key, {"value": value})
    assert [*read_records(path).items()] == [("a", {"value": [1.5, None]}), ("b", {"value": 2})]
    assert len(path.read_text().splitlines()) == 2 and [*path.parent.iterdir()] == [path]


def test_processes_lose_no_record(tmp_path):
    path = tmp_path / "study.jsonl"
    code = "import sys; from pathlib import Path; from experiments.records import write_record\n"
    code += "for number in range(10): write_record(Path(sys.argv[1]), f'{sys.argv[2]}{number}', {'value': number})"
    writers = [subprocess.Popen([sys.executable, "-c", code, str(path), name], cwd=ROOT) for name in "abc"]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    assert len(read_records(path)) == 30


def test_a_broken_line_is_named_and_nan_is_refused(tmp_path):
    path = tmp_path / "study.jsonl"
    write_record(path, "a", {})
    with pytest.raises(ValueError, match="Out of range"):
        write_record(path, "b", {"value": math.nan})
    path.write_text(path.read_text() + '{"key": "b", "va')
    with pytest.raises(UserError, match=r"study\.jsonl, line 2"):
        read_records(path)
