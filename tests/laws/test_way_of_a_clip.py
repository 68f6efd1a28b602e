import ast
import re

import pytest
from places import ROOT

STOP = re.compile(r"^\*\*(\d)\. `([\w/]+\.py)`\*\*(.*)$", re.MULTILINE)
ELSEWHERE = {"Config", "fit", "stride", "TouchBatch"}  # named on the way, defined at another stop


@pytest.mark.parametrize(("page", "count"), [("way_of_a_clip", 9), ("way_of_a_touch", 7)])
def test_the_stops_exist_in_order_and_hold_what_the_page_names(page: str, count: int) -> None:
    stops = STOP.findall((ROOT / "docs" / "how" / f"{page}.md").read_text())
    assert [int(number) for number, _, _ in stops] == list(range(1, count + 1))
    for _, name, text in stops:
        tree = ast.parse((ROOT / "src" / "anytouch_jax" / name).read_text())
        defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        named = {word.rpartition(".")[2] for word in re.findall(r"`(\w+\.?\w+)`", text)}
        assert named - ELSEWHERE <= defined, (name, named - ELSEWHERE - defined)
        assert named & defined, name
