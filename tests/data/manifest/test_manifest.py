import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from checked_world import columns, plain_rows
from refused import refused

from anytouch_jax.config import preset
from anytouch_jax.data.manifest import content, schema
from anytouch_jax.data.manifest import manifest as m
from anytouch_jax.datasets.prompts import attach_text
from anytouch_jax.datasets.verify import verify

HEAD = "path,sensor,sequence,frame_index,split"


GOOD = f"{HEAD},stride,touch,commercial,label.slip,label.name,other\n" + (
    "a.png,digit,s,0,train,2,,1,0,x,7\n"
    'b.png,digit,s,2,train,2,t,0,1,"y, z",\n'
    "c.png,gelslim,r,5,test,,t,,,,q\n"
)


def _file(tmp_path, text, name="manifest.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_csv_is_typed_and_empty_cells_are_null(tmp_path):
    got = m.read(_file(tmp_path, "\ufeff" + GOOD))
    assert len(got) == 3
    assert got.column("frame_index").to_pylist() == [0, 2, 5]
    assert got.column("stride").to_pylist() == [2, 2, 1]
    assert got.column("touch").to_pylist() == [None, "t", "t"]
    assert got.column("commercial").to_pylist() == [True, False, None]
    assert got.column("label.slip").to_pylist() == [0, 1, None]
    assert got.column("label.name").to_pylist() == ["x", "y, z", None]
    assert got.column("other").to_pylist() == ["7", None, "q"]
    assert got.column("image_path").to_pylist() == [None] * 3
    assert got.present("touch").tolist() == [False, True, True]
    assert got.codes("touch").tolist() == [-1, 0, 0]
    assert got.file(1) == tmp_path / "b.png"


def test_csv_and_parquet_round_trip_with_one_hash(tmp_path):
    first = m.read(_file(tmp_path, GOOD))
    for name in ("again.csv", "again.parquet"):
        m.write(first, tmp_path / name)
        again = m.read(tmp_path / name)
        assert again.table.equals(first.table)
        assert again.content_hash == first.content_hash
    other = m.read(_file(tmp_path, GOOD.replace("c.png", "d.png"), "other.csv"))
    assert other.content_hash != first.content_hash
    moved = m.read(_file(tmp_path, GOOD.replace("2,,1", "2,q,1"), "moved.csv"))
    assert moved.content_hash != first.content_hash
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


def test_write_makes_paths_relative_to_the_new_folder(tmp_path):
    (tmp_path / "deep").mkdir()
    first = m.read(_file(tmp_path / "deep", GOOD))
    m.write(first, tmp_path / "up.parquet")
    up = m.read(tmp_path / "up.parquet")
    assert up.value(0, "path") == "deep/a.png"
    assert up.file(0) == first.file(0)
    refused(
        r"line 2 of .*manifest\.csv.*is not inside .*elsewhere",
        m.write,
        first,
        tmp_path / "elsewhere" / "x.csv",
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD.replace(",split", ",slit"), ["lacks the column 'split'", "slit"]),
        (
            GOOD.replace("s,2,train", "s,two,train"),
            ["line 3 of", "'frame_index'", "whole number", "'two'"],
        ),
        (GOOD.replace("s,2,train", "s,1_0,train"), ["line 3 of", "'frame_index'", "'1_0'"]),
        (GOOD.replace("s,2,train", "s,,train"), ["line 3 of", "'frame_index' is empty"]),
        (GOOD.replace("c.png", "  "), ["line 4 of", "'path' is empty"]),
        (
            GOOD.replace("test", "tset"),
            ["line 4 of", "'split'", "'tset'", "background", "did you mean test?"],
        ),
        (
            GOOD.replace("test", "Validation"),
            ["line 4 of", "'split'", "'Validation'", "did you mean val?"],
        ),
        (GOOD.replace("train,2,t,0", "train,0,t,0"), ["line 3 of", "'stride'", "at least 1, is 0"]),
        (GOOD.replace("2,,1,0,x", "2,,yes,0,x"), ["line 2 of", "'commercial'", "0 or 1", "'yes'"]),
        (GOOD.replace("\nb.png,digit,", "\nb.png,"), ["line 3: 10 cells for 11 columns", "b.png,"]),
        (GOOD.replace("other\n", "path\n"), ["'path' is there twice"]),
        (HEAD + "\n", ["has no rows"]),
        ("", ["cannot be read as a csv"]),
    ],
)
def test_a_bad_table_is_named_by_file_column_and_row(tmp_path, text, words):
    path = _file(tmp_path, text)
    sentence = refused(".", m.read, path)
    assert all(word in sentence for word in [str(path), *words])


def test_other_ways_to_give_no_manifest(tmp_path):
    (tmp_path / "x.parquet").write_bytes(b"PAR1 this is not one")
    (tmp_path / "latin.csv").write_bytes(f"{HEAD}\nf\xfcr.png,digit,s,0,train\n".encode("latin-1"))
    for path, words in [
        (tmp_path, "is a folder"),
        (tmp_path / "none.csv", "there is no manifest"),
        (tmp_path / "x.parquet", "cannot be read as a parquet"),
        (tmp_path / "latin.csv", "cannot be read as a csv"),
        (_file(tmp_path, GOOD, "x.txt"), "ends in .csv or .parquet"),
        ([], "no manifest is given"),
    ]:
        refused(words, m.read, path)
    link = tmp_path / "link.csv"
    cached = tmp_path / "cached.csv"
    link.symlink_to(_file(tmp_path, GOOD))
    assert len(m.read(link)) == 3
    (tmp_path / "3f2a").write_text(GOOD)
    cached.symlink_to(tmp_path / "3f2a")
    refused(r"cached.csv is a link into a cache.*--local-dir", m.read, cached)


def test_types_in_memory_are_enforced(tmp_path):
    coded = pa.array(["digit"]).dictionary_encode()
    gaps = m.from_columns(columns(stride=[3.0], sensor=coded), tmp_path / "x")
    assert gaps.table["stride"].type == pa.int64() and gaps.value(0, "sensor") == "digit"
    for odd in ({"split": ["train", "val"]}, {"frame_index": [10**20]}):
        refused("make no table", m.from_columns, columns(**odd), tmp_path / "x.csv")
    for name, cell in (("a", "soft"), ("b", ["soft"])):
        file = tmp_path / f"{name}.parquet"
        m.write(m.from_columns(columns(**{"label.x": [cell]}), file), file)
    refused("cannot be joined", m.read, [tmp_path / "a.parquet", tmp_path / "b.parquet"])


def test_joined_manifests_keep_their_folders_and_keys_apart(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    one = _file(tmp_path / "one", GOOD)
    two = _file(
        tmp_path / "two",
        GOOD.replace("label.slip", "label.grip").replace(",x,", ",3,").replace("y, z", "4"),
    )
    both = m.read([one, two])
    assert len(both) == 6
    assert both.file(4) == tmp_path / "two" / "b.png"
    assert both.where(4) == f"line 3 of {two}"
    assert both.column("label.grip").to_pylist() == [None, None, None, 0, 1, None]
    assert both.column("label.name").to_pylist() == ["x", "y, z", None, "3", "4", None]
    touch = both.codes("touch", own=True)
    assert touch[1] == touch[2] != touch[4] == touch[5] and touch[0] == touch[3] == -1
    assert both.clips(2).tolist() == [[0, 1], [3, 4]]
    refused("given twice", m.read, [one, one])


def test_rows_of_names_the_file_of_an_empty_split(tmp_path):
    got = m.read(_file(tmp_path, GOOD))
    assert got.rows_of("train").tolist() == [0, 1]
    refused(
        r"manifest\.csv: column 'split' has no row 'val'; it has test, train", got.rows_of, "val"
    )
    refused("unknown split 'trian'", got.rows_of, "trian")
    wide = m.from_columns(columns(**{f"label.c{i}": [i] for i in range(3000)}), tmp_path / "m.csv")
    assert len(refused("has no column 'gone'; it has path.* more", wide.column, "gone")) < 600


def test_resolve_keeps_inside_the_folder(tmp_path):
    root = tmp_path / "data"
    (root / "in").mkdir(parents=True)
    (tmp_path / "data2").mkdir()
    (tmp_path / "secret.png").write_bytes(b"x")
    (root / "link.png").symlink_to(tmp_path / "secret.png")
    (root / "out").symlink_to(tmp_path / "data2")
    (root / "inside.png").symlink_to(root / "in" / "a.png")
    assert m.resolve_path(root, "in/../in/a.png") == root / "in" / "a.png"
    assert m.resolve_path(root, "inside.png") == root / "in" / "a.png"
    for bad in ("../secret.png", "in/../../secret.png", "../data2/x"):
        refused(r"leaves the folder of the manifest, .*/data$", m.resolve_path, root, bad)
    for bad in ("link.png", "out/x.png"):
        refused(
            r"leaves the folder .*, by a link; put the files there, or", m.resolve_path, root, bad
        )
    for bad in ("in\\a.png", r"C:\data\a.png", r".\in\a.png", "C:/data/a.png"):
        refused(r"as on Windows; write it relative .* forward slashes", m.resolve_path, root, bad)
    (root / r"odd\name.png").write_bytes(b"x")
    assert m.resolve_path(root, r"odd\name.png").is_file()
    for bad, words in (
        ("", "empty"),
        (None, "empty"),
        ("a\0b", "not a file name"),
        (str(root / "a.png"), "absolute"),
    ):
        refused(words, m.resolve_path, root, bad)


def test_sensor_rows(tmp_path):
    rows = "a,digit,s,0,train\nb,tac3d,s,1,train\nc,newfinger,s,2,test\nd,allsight,s,3,train\n"
    text = f"{HEAD}\n{rows}"
    got = m.read(_file(tmp_path, text))
    model = preset("tiny").model
    refused(r"line 4 of .*manifest\.csv.*unknown sensor 'newfinger'", m.sensor_rows, got, model)
    ids, notes = m.sensor_rows(got, model, unknown="skip")
    assert ids.tolist() == [1, -1, -1, 6] and ids.dtype == np.int32
    assert any("1 rows of tac3d" in note for note in notes) and any(
        "newfinger" in note for note in notes
    )
    ids, notes = m.sensor_rows(got, model, unknown="universal")
    assert ids.tolist() == [1, -1, 9, 6] and any("universal" in note for note in notes)
    other = m.read(_file(tmp_path, text.replace("digit", "DIGIT")))
    for unknown in ("error", "skip", "universal"):
        with pytest.raises(
            m.ManifestError,
            match=r"line 2 of .*column 'sensor': sensor 'DIGIT' is not known: did you mean digit",
        ):
            m.sensor_rows(other, model, unknown=unknown)
    ids, notes = m.sensor_rows(got, model, np.array([0, 3]))
    assert ids.tolist() == [1, -1, -1, 6] and notes == []


def test_a_repeated_frame_is_an_error_for_clips_only(tmp_path):
    got = m.read(
        _file(tmp_path, f"{HEAD}\na,digit,s,0,train\nb,digit,r,7,train\nc,digit,r,7,train\n")
    )
    assert len(got.clips(1)) == 3
    refused(r"line 4 of .* repeats frame_index 7 of sequence 'r', as in line 3 of", got.clips, 2)


def test_joined_manifests_written_as_one_keep_their_keys_apart(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
        one = m.from_columns(
            columns(2, touch=["t0", "t1"], grasp_group=[7, 8]), tmp_path / name / "m.parquet"
        )
        m.write(one, tmp_path / name / "m.parquet")
    m.write(m.read([tmp_path / "a/m.parquet", tmp_path / "b/m.parquet"]), tmp_path / "both.parquet")
    one = m.read(tmp_path / "both.parquet")
    assert len(one.clips(2)) == 2 and [
        len(np.unique(one.codes(name))) for name in ("touch", "grasp_group")
    ] == [4, 4]


def test_columns_of_any_kind_are_carried_along(tmp_path):
    one, two = (
        m.from_columns(columns(box=[[1, k]], bytes=[b"\xff"]), tmp_path / "m.csv") for k in (2, 3)
    )
    assert one.content_hash != two.content_hash
    m.write(one, tmp_path / "m.parquet")
    assert m.read(tmp_path / "m.parquet").column("box").to_pylist() == [[1, 2]]
    refused("cannot be written", m.write, one, tmp_path / "m.csv")
    assert not (tmp_path / "m.csv").exists()


def test_a_csv_reads_one_class_from_spaces_unicode_forms_and_empty_spellings(tmp_path):
    head = "path,sensor,sequence,frame_index,split,object,label.kind,label.force"
    cells = [
        ("train ", "mug", "oak wood", "1"),
        (" train", " mug", "oak  wood ", "n/a"),
        ("train", "mug\u00a0", "", "NaN"),
        ("train", "-", "#N/A", "<NA>"),
        ("train", "None", "caf\u00e9", "none"),
        ("train", "null", "cafe\u0301", "2"),
    ]
    lines = [f"{i}.png, digit,s,{i},{','.join(line)}" for i, line in enumerate(cells)]
    got = m.read(_file(tmp_path, "\n".join([head, *lines]) + "\n"))
    assert set(got.column("split").to_pylist()) == {"train"} and set(
        got.column("sensor").to_pylist()
    ) == {"digit"}
    assert got.column("object").to_pylist() == ["mug"] * 3 + [None] * 3
    assert got.column("label.kind").to_pylist() == ["oak wood"] * 2 + [None] * 2 + ["caf\u00e9"] * 2
    # a column of numbers
    assert got.column("label.force").to_pylist() == [1, None, None, None, None, 2]


def test_texts_of_a_parquet_are_meant_as_they_are_written(tmp_path):
    """A table that a program wrote has nulls. Its "none" is a class: no slide, no twist."""
    texts = {"object": ["mug", "N/A", " "], "label.slide": ["left", "none", None]}
    pa.parquet.write_table(pa.table(columns(3, **texts)), tmp_path / "m.parquet")
    got = m.read(tmp_path / "m.parquet")
    assert got.column("object").to_pylist() == ["mug", "N/A", None]
    assert got.column("label.slide").to_pylist() == ["left", "none", None]


def test_an_error_in_a_csv_names_the_line_as_an_editor_counts_it(tmp_path):
    # spaces around names do not count
    head = " path, sensor,sequence ,frame_index,split,text,label.x"
    good = '0.png,digit,s,0,train,"of two\nlines",1\n\n'
    for bad, words in (
        ("1.png,digit,s,one,train,,2", "line 5 of .*csv: column 'frame_index'"),
        ("1.png,digit,s,1,tain,,2", "line 5 of .*csv: column 'split'"),
        ("1.png,digit,s,1,train", "line 5: 5 cells for 7 columns, in '1.png"),
        ("1.png,digit,s,1,train,soft, red,2", "line 5: 8 cells for 7 columns"),
        ('1.png,digit,s,1,train,"open,2', "the quote in line 5 is not closed"),
        ('1.png,digit,s,1,train,,"open', "the quote in line 5 is not closed"),
        (
            '1.png,digit,s,1,train,,"open\n1.png,digit,s,1,train,,"2',
            "the quote in line 5 is not closed",
        ),
    ):
        refused(words, m.read, _file(tmp_path, f"{head}\n{good}{bad}\n2.png,digit,s,2,train,,3\n"))
    for cells, words in (
        (
            ["Wood", "clay", "wood"],
            "line 7 of .*csv: column 'label.x' has 'wood', and line 5 of .* has 'Wood'",
        ),
        (
            [*map(str, range(9)), "12,5"],
            "line 14 of .*csv: column 'label.x' has '12,5' among numbers",
        ),
    ):
        lines = "".join(
            f'{i + 1}.png,digit,s,{i + 1},train,,"{cell}"\n' for i, cell in enumerate(cells)
        )
        refused(words, m.read, _file(tmp_path, f"{head}\n{good}{lines}"))


def test_labels_of_a_csv_keep_what_they_say(tmp_path):
    head = f"{HEAD},label.object,label.force,label.stable,label.word,label.serial"
    rows = [
        "a.png,digit,s,0,train,001, 1.5 ,True,True,0x1A",
        "b.png,digit,s,1,train,007, ,false,maybe,0x10",
    ]
    got = m.read(_file(tmp_path, "\n".join([head, *rows, "c.png,digit,s,2,train,100,2,,,"]) + "\n"))
    # not 26 and 16
    assert got.column("label.serial").to_pylist() == ["0x1A", "0x10", None]
    # names, whose zeros no number keeps
    assert got.column("label.object").to_pylist() == ["001", "007", "100"]
    assert got.column("label.force").to_pylist() == [1.5, None, 2]
    # as a Parquet manifest has it
    assert got.column("label.stable").to_pylist() == [True, False, None]
    assert got.column("label.word").to_pylist() == ["True", "maybe", None]
    m.write(got, tmp_path / "again.csv")
    again = m.read(tmp_path / "again.csv")
    assert again.table.equals(got.table) and again.content_hash == got.content_hash
    m.write(got, tmp_path / "other.parquet")
    both = m.read([tmp_path / "again.csv", tmp_path / "other.parquet"])
    assert both.column("label.object").to_pylist() == ["001", "007", "100"] * 2
    assert both.column("label.stable").to_pylist() == [True, False, None] * 2


def test_captions_are_attached_by_a_table(make, tmp_path):
    loose = make(plain_rows(text=None))
    csv = '\ufeffsequence,text\ns0,"soft, ""very""\nand round"\nq,unused\ns1,  \n'
    (tmp_path / "t.csv").write_text(csv, encoding="utf-8")
    got, notes = attach_text(loose, tmp_path / "t.csv")
    assert got.column("text").to_pylist() == ['soft, "very" and round'] * 3 + [None] * 3
    assert notes == [
        "3 rows got a caption by 'sequence'",
        "1 of 2 keys of t.csv are not in the manifest",
    ]
    (tmp_path / "u.csv").write_text("object,text\n cafe\u0301  noir,smooth\n", encoding="utf-8")
    drinks = m.replace_column(loose, "object", ["caf\u00e9 noir"] * 2 + ["tea"] * 4)
    assert (
        attach_text(drinks, tmp_path / "u.csv")[0].column("text").to_pylist()
        == ["smooth"] * 2 + [None] * 4
    )
    table = pa.table({"frame_index": [0, 1], "words": ["new", "one"], "n": [1, 2]})
    pa.parquet.write_table(table, tmp_path / "t.parquet")
    more, notes = attach_text(got, tmp_path / "t.parquet", key="frame_index", text="words")
    assert more.column("text").to_pylist() == ['soft, "very" and round'] * 3 + ["new", "one", None]
    assert notes == ["2 rows got a caption by 'frame_index'", "2 rows already had a caption"]
    nested = m.replace_column(got, "extra", pa.array([[0]] * len(got)))
    pa.parquet.write_table(pa.table({"extra": ["0"], "text": ["x"]}), tmp_path / "e.parquet")
    refused(
        "the key 'extra' must be a plain column, is list",
        attach_text,
        nested,
        tmp_path / "e.parquet",
    )
    over, _ = attach_text(
        got, tmp_path / "t.parquet", key="frame_index", text="words", overwrite=True
    )
    assert over.column("text").to_pylist() == [
        "new",
        "one",
        'soft, "very" and round',
        "new",
        "one",
        None,
    ]


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("sequence,text\n,a\n", {}, "line 2 of .*csv: a caption without sequence"),
        ("sequence,text\n\ns0,a\ns0,b\n", {}, "line 4 of .*csv: sequence 's0' has another caption"),
        ("sequence,caption\ns0,a\n", {}, "no column 'text'; it has sequence, caption"),
        ("sequence,touch,text\ns0,x,a\n", {}, "name the key column"),
        (
            "sequence,text\ns9,a\n",
            {},
            "no key 'sequence' of it is in the manifest; its first one is 's9'",
        ),
        ("sequence,text\ns0,a\n", {"key": "tuoch"}, "no column 'tuoch'"),
        ("grip,text\ns0,a\n", {}, "has no column 'grip'"),
        ('sequence,text\n"s0,a\n', {}, "the quote in line 2 is not closed"),
    ],
)
def test_a_table_that_does_not_fit_is_named(make, tmp_path, text, options, words):
    (tmp_path / "t.csv").write_text(text)
    refused(words, attach_text, make(plain_rows()), tmp_path / "t.csv", **options)
    refused("No such file", attach_text, make(plain_rows()), tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"split": None}, "lacks the column 'split'"),
        ({"frame_index": ["one", "two"]}, "'frame_index' must be a whole"),
        ({"frame_index": [1.5, 2.0]}, "row 0 of .*: column 'frame_index'"),
        ({"sensor": [1, 2]}, "'sensor' must be text"),
        ({"path": [["a"], ["b"]]}, "'path' must be text"),
        ({"commercial": [2, 0]}, "'commercial' must be a 0 or 1"),
        ({"path": ["a", None]}, "row 1 of .*parquet: column 'path' is empty"),
        ({"split": [b"train", b"test"]}, "'split' must be text"),
    ],
)
def test_a_parquet_with_a_missing_or_mistyped_column_is_named(tmp_path, change, words):
    given = {name: values for name, values in columns(2, **change).items() if values is not None}
    pa.parquet.write_table(pa.table(given), tmp_path / "m.parquet")
    error = refused(words, m.read, tmp_path / "m.parquet")
    assert "m.parquet" in error


def _with_broken_text(name):
    """A table whose text column `name` has bytes that are not UTF-8 in row 1."""
    table = pa.table(GOOD_COLUMNS)
    cells = [value.encode() for value in table[name].to_pylist()]
    cells[1] = b"a\xff\xfeb"
    buffers = pa.array(cells, pa.binary()).buffers()
    return table.set_column(
        table.column_names.index(name), name, pa.StringArray.from_buffers(len(cells), *buffers[1:])
    )


GOOD_COLUMNS = columns(2, object=["mug"] * 2, note=["n"] * 2) | {"label.x": ["u", "v"]}


@pytest.mark.parametrize("name", ["path", "split", "object", "label.x", "note"])
def test_text_of_a_parquet_that_is_not_utf8_is_named(tmp_path, name):
    pa.parquet.write_table(_with_broken_text(name), tmp_path / "m.parquet")
    refused(
        f"row 1 of .*parquet: column '{name}' must be UTF-8 text", m.read, tmp_path / "m.parquet"
    )


def test_a_name_that_is_not_utf8_makes_no_manifest_and_is_named(tmp_path):
    cells = columns(2, object=["mug", os.fsdecode(b"mug\xff")])
    told = refused(r"the name 'mug\\udcff' is not UTF-8", m.from_columns, cells, tmp_path / "m.csv")
    assert "codec" not in str(told)


@pytest.mark.parametrize(
    "kind", [pa.large_string(), pa.string_view(), pa.dictionary(pa.int8(), pa.large_string())]
)
def test_labels_of_every_text_type_are_text(tmp_path, kind):
    labels = pa.array(["Wood", "wood"]).cast(pa.large_string())
    labels = (
        labels.dictionary_encode().cast(kind) if pa.types.is_dictionary(kind) else labels.cast(kind)
    )
    pa.parquet.write_table(pa.table(GOOD_COLUMNS | {"label.x": labels}), tmp_path / "m.parquet")
    manifest = m.read(tmp_path / "m.parquet")
    assert manifest.table["label.x"].type == pa.string()
    assert "spelling" in [finding.kind for finding in verify(manifest, decode=False).findings]


@pytest.mark.parametrize("name", ["m.csv", "m.parquet"])
@pytest.mark.parametrize(
    ("text", "kind"),
    [("<!DOCTYPE html>\n<a,b>\n", "a web page"), ("version https://git-lfs.x", "a Git")],
)
@pytest.mark.parametrize("read", [m.read, m.summarise_file])
def test_a_web_page_and_a_pointer_are_called_so(tmp_path, name, text, kind, read):
    (tmp_path / name).write_text(text)
    refused(rf"{name} is {kind}", read, tmp_path / name)


@pytest.mark.parametrize("name", ["path", "split", "object", "label.x"])
def test_a_huge_cell_is_named_and_never_printed(tmp_path, name):
    huge = GOOD_COLUMNS | {name: ["train", "Z" * 1_000_000]}
    pa.parquet.write_table(pa.table(huge), tmp_path / "m.parquet")
    error = refused(
        f"row 1 of .*: column '{name}' has a text of 1000000 bytes", m.read, tmp_path / "m.parquet"
    )
    assert len(error) < 400
    # is read, and shortened in messages
    long = huge | {name: ["train", "Z" * 9_000], "frame_index": [0, 0]}
    pa.parquet.write_table(pa.table(long), tmp_path / "m.parquet")
    if name == "split":
        error = refused("unknown split 'ZZZ", m.read, tmp_path / "m.parquet")
        assert len(error) < 500
    else:
        report = verify(m.read(tmp_path / "m.parquet"))
        assert not report.ok and max(map(len, report.to_markdown().splitlines())) < 1000


def test_a_table_of_too_many_rows_is_refused_before_it_is_read(tmp_path, monkeypatch):
    pa.parquet.write_table(pa.table(GOOD_COLUMNS), tmp_path / "m.parquet")
    monkeypatch.setattr(schema, "MAX_ROWS", 1)
    refused("has 2 rows, more than 1; split it", m.read, tmp_path / "m.parquet")


def test_a_description_in_blocks_equals_the_whole_table(tmp_path, monkeypatch):
    monkeypatch.setattr(schema, "BLOCK", 7)
    monkeypatch.setattr(content, "BLOCK", 5)
    count = 40
    rng = np.random.default_rng(0)
    file = tmp_path / "m.parquet"
    cells = columns(
        count,
        sensor=rng.choice(["digit", "taxim", "gelslim"], count).tolist(),
        stride=[1, 2] * (count // 2),
        sequence=[f"r{i // 9}" for i in range(count)],
        frame_index=[i % 9 for i in range(count)],
        split=rng.choice(["train", "test"], count).tolist(),
        object=[None if i % 3 else "ball" for i in range(count)],
        extra=[b"a", None] * (count // 2),
    )
    cells |= {
        "label.b": [[i] for i in range(count)],
        "label.a": [None if i == 9 else i / 7 for i in range(count)],
    }
    order = rng.permutation(count)
    cells = {name: [values[i] for i in order] for name, values in cells.items()}
    pa.parquet.write_table(pa.table(cells), file, row_group_size=11)
    table = m.read(file)
    # bytes of text that are kept
    for kept in (1 << 20, 3):
        monkeypatch.setattr(content, "_KEPT", kept)
        got = m.summarise_file(file)
        assert got.digest == table.content_hash
    assert (got.rows, got.recordings, got.clips) == (count, 5, len(table.clips(3)))
    assert list(got.filled) == list(cells) and got.filled["object"] == table.present("object").sum()
    for name in ("split", "sensor"):
        values, rows = np.unique(cells[name], return_counts=True)
        assert got.counts[name] == (
            list(zip(values.tolist(), rows.tolist(), strict=True)),
            len(values),
        )
    (tmp_path / "m.csv").write_text(GOOD)
    assert m.summarise_file(tmp_path / "m.csv").digest == m.read(tmp_path / "m.csv").content_hash
    twice = {name: cells[name][20] for name in ("frame_index", "sequence", "split")}
    for row, changes, words in (
        (
            30,
            twice,
            r"row 30 of .*m\.parquet repeats frame_index \d of sequence 'r\d', as in row 20 of",
        ),
        (33, {"split": "tset"}, r"row 33 of .*m\.parquet: column 'split' .* did you mean test"),
        (33, {"path": None}, r"row 33 of .*m\.parquet: column 'path' is empty"),
    ):
        changed = {
            name: [*of[:row], changes.get(name, of[row]), *of[row + 1 :]]
            for name, of in cells.items()
        }
        pa.parquet.write_table(pa.table(changed), file, row_group_size=11)
        refused(words, m.summarise_file, file)
    for name in ("gone.parquet", "gone.csv", "m.txt"):
        refused(name, m.summarise_file, tmp_path / name)
