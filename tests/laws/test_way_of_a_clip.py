"""The page "The way of a clip": its nine stops are files, and the functions it names are in them."""

from __future__ import annotations

import ast
import re

from places import ROOT

PAGE = (ROOT / "docs" / "how" / "way_of_a_clip.md").read_text()
STOP = re.compile(r"^\*\*(\d)\. `([\w/]+\.py)`\*\*(.*)$", re.MULTILINE)


def test_the_nine_stops_exist_in_order_and_hold_what_the_page_names() -> None:
    stops = STOP.findall(PAGE)
    assert [int(number) for number, _, _ in stops] == list(range(1, 10))
    for _, name, text in stops:
        tree = ast.parse((ROOT / "src" / "anytouch_jax" / name).read_text())
        defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        named = {word.rpartition(".")[2] for word in re.findall(r"`(\w+\.?\w+)`", text)}
        others = {"Config", "fit", "stride", "TouchBatch"}  # named on the way, defined at another stop
        assert named - others <= defined, (name, named - others - defined)
        assert named & defined, name
