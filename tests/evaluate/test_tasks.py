import numpy as np
import pytest
from task_world import row, simulated, table

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import tasks
from anytouch_jax.evaluate.tasks import BENCHMARKS, TASKS, Task, select

WORLD = simulated()
FRAME = np.asarray(WORLD.column("frame_index"))


def cells(selected: tasks.TaskRows, name: str) -> list:
    return [WORLD.value(int(one), name) for one in selected.rows[:, 0]]


def test_a_press_is_the_deepest_frame_of_each_recording():
    selected = select(WORLD, TASKS["material"])
    assert selected.rows.shape == (24 * 2 * 2, 1)
    assert len(set(cells(selected, "sequence"))) == 96 and set(FRAME[selected.rows[:, 0]]) == {2}
    np.testing.assert_array_equal(selected.labels, cells(selected, "label.material"))
    np.testing.assert_array_equal(
        selected.groups, [f"object {name}" for name in cells(selected, "object")]
    )
    np.testing.assert_array_equal(selected.split, cells(selected, "split"))


def test_contact_is_what_presses_and_ends_a_clip():
    selected = select(WORLD, TASKS["force"])
    # frame 0 does not press, 0 and 1 end no clip of three
    assert set(FRAME[selected.rows[:, 0]]) == {2, 3, 4}
    assert selected.labels.dtype == np.float64
    np.testing.assert_allclose(selected.labels, cells(selected, "label.force"))
    few = select(WORLD, Task("f", "label.force", "regression", which="contact"))
    assert set(FRAME[few.rows[:, 0]]) == {1, 2, 3, 4}


def test_moving_is_the_frame_that_slips_most_else_at_two_thirds():
    selected = select(WORLD, TASKS["twist"])
    twist = cells(selected, "label.twist")
    np.testing.assert_array_equal(selected.labels, twist)
    # "none" takes no part
    assert set(twist) == {"clockwise", "counterclockwise"}
    still = [WORLD.value(int(r), "label.slip") == 0 for r in selected.rows[:, 0]]
    assert any(still) and not all(still)
    assert set(FRAME[selected.rows[:, 0]]) == {3}  # 2/3 of 4 is 2.67
    assert len(selected.rows) == len(set(cells(selected, "sequence"))) == 64


@pytest.mark.parametrize("name", ["slip", "force", "twist", "slide"])
def test_stills_and_clips_of_a_dynamic_task_take_the_same_rows(name):
    for other in (1, 3):
        np.testing.assert_array_equal(
            select(WORLD, TASKS[name]).rows, select(WORLD, TASKS[name], other).rows
        )
    longer = select(WORLD, TASKS[name], 5)
    assert set(FRAME[longer.rows[:, 0]]) == {4}


def test_slip_is_a_fraction_above_a_half_or_a_mark():
    selected = select(WORLD, TASKS["slip"])
    np.testing.assert_array_equal(
        selected.labels == "yes", np.array(cells(selected, "label.slip")) > 0.5
    )
    marked = table(
        [
            row(sequence="a", frame_index=i, label__slip=1, label__contact_score=9.0)
            for i in range(3)
        ]
    )
    assert select(marked, TASKS["slip"]).labels.tolist() == ["yes"]


def test_a_file_with_scores_takes_scored_contact_only():
    scores = (9.0, 7.0, None)
    rows = [
        row(path=f"{i}.png", sequence=f"{i}", label__object="ball", label__contact_score=s)
        for i, s in enumerate(scores)
    ]
    assert select(table(rows), TASKS["object"]).rows.tolist() == [[0]]
    plain = [row(path=f"{i}.png", sequence=f"{i}", label__object="ball") for i in range(3)]
    # nothing is known of contact: all take part
    assert len(select(table(plain), TASKS["object"]).rows) == 3
    marked = [
        row(path=f"{i}.png", sequence=f"{i}", label__object="ball", label__contact=i)
        for i in range(2)
    ]
    assert select(table(marked), TASKS["object"]).rows.tolist() == [[1]]
    # A mark is what training goes by, whatever the score (it has a limit of its own for each
    # sensor); words are marks.
    both = [
        row(
            path=f"{i}.png",
            sequence=f"{i}",
            label__object="ball",
            label__contact=mark,
            label__contact_score=s,
        )
        for i, (mark, s) in enumerate((("True", 5.0), ("False", 9.0), ("1", 6.7)))
    ]
    assert select(table(both), TASKS["object"]).rows.tolist() == [[0], [2]]


def test_groups_fall_back_to_the_recording():
    rows = [
        row(sequence="v/1", label__object="a", grasp_group="g1", touch="t1"),
        row(sequence="v/2", label__object="a", touch="t1"),
        row(sequence="v/3", label__object="a"),
    ]
    assert select(table(rows), TASKS["object"]).groups.tolist() == [
        "grasp_group g1",
        "touch t1",
        "sequence v/3",
    ]
    rows += [row(sequence="w/1", label__object="b")]
    video = Task("x", "label.object", groups=("recording",))
    assert select(table(rows), video).groups.tolist() == ["recording v"] * 3 + ["recording w"]
    one = [row(sequence=f"mine/{i}", label__object="b") for i in range(2)]
    assert select(table(one), video).groups.tolist() == ["sequence mine/0", "sequence mine/1"]


def test_recordings_of_joined_files_are_never_one_group(tmp_path):
    files = [tmp_path / name for name in ("a.csv", "b.csv")]
    for file in files:
        some = [
            row(sequence="s1", object="ball", label__object="a", grasp_group="g1"),
            row(sequence="v/1", object="ball", label__object="a", touch="t1"),
            row(sequence="v/2", object="ball", label__object="a"),
        ]
        columns = {name: [one.get(name) for one in some] for name in {**some[0], **some[1]}}
        manifests.write(manifests.from_columns(columns, file), file)
    both = manifests.read(files)
    for groups, count in (
        (("grasp_group", "touch"), 6),
        (("recording",), 4),
        (("object",), 1),
        ((), 6),
    ):
        selected = select(both, Task("x", "label.object", groups=groups)).groups
        # an object's name is the same thing everywhere
        assert len(set(selected)) == count, groups
        assert len(set(selected[:3]) & set(selected[3:])) == (groups == ("object",))


def test_what_cannot_be_selected_is_refused():
    for words, task in (
        (("label.success", "label.material"), TASKS["grasp"]),
        (("label.slip", "0.1"), Task("x", "label.slip")),
        (("label.twist", "text"), Task("x", "label.twist", "regression")),
        (("downstream_test",), Task("x", "label.material", test_list="rough")),
    ):
        with pytest.raises(UserError) as error:
            select(WORLD, task)
        assert all(word in str(error.value) for word in words), error.value
    with pytest.raises(UserError, match="colour"):
        tasks.find_named(tasks.TASKS, "colour", "task")
    with pytest.raises(UserError, match="mnist"):
        tasks.find_named(BENCHMARKS, "mnist", "benchmark")
    with pytest.raises(UserError, match="material"):
        select(table([row(label__material="x", label__contact=0)]), TASKS["material"])


def grasps() -> list[dict]:
    rows = []
    for grasp, fingers in (("mug/0", "BA"), ("mug/1", "A"), ("pan/0", "AB")):
        for finger in fingers:
            for phase in ("during", "after"):
                if (grasp, finger, phase) != ("pan/0", "B", "after"):
                    rows.append(
                        row(
                            path=f"{grasp}/{phase}{finger}.png",
                            sequence=f"{grasp}/{phase}/{finger}",
                            unit=finger,
                            split="train" if phase == "during" else "unused",
                            object=grasp[:3],
                            touch=grasp if phase == "during" else None,
                            label__success=1 if phase == "during" else None,
                        )
                    )
    return rows


def test_two_fingers_of_a_grasp_stand_side_by_side():
    world = table(grasps())
    selected = select(world, TASKS["grasp"])
    names = [[world.value(int(one), "sequence") for one in pair] for pair in selected.rows]
    assert sorted(names) == [
        ["mug/0/during/A", "mug/0/during/B"],
        ["pan/0/during/A", "pan/0/during/B"],
    ]
    assert len(selected.notes) == 1 and "1 grasps" in selected.notes[0]
    assert sorted(selected.groups) == ["object mug", "object pan"]
    one = table([grasps()[0]])
    with pytest.raises(UserError, match="grasp"):
        select(one, TASKS["grasp"])


@pytest.mark.parametrize("empty", ["", " ", "n/a", "NaN", "None", "null", "-", "?"])
def test_an_empty_label_takes_no_part(empty):
    some = ["Wood", "wood", *[empty] * (len(WORLD) - 2)]
    empties = [empty] * len(WORLD)
    selected = select(
        manifests.replace_column(WORLD, "label.kind", some), Task("kind", "label.kind", which="all")
    )
    assert len(selected.rows) == 2 and "'Wood' and 'wood' differ only by" in selected.notes[-1]
    with pytest.raises(UserError, match=r"has a label|has no label"):
        select(
            manifests.replace_column(WORLD, "label.kind", empties),
            Task("kind", "label.kind", which="all"),
        )
