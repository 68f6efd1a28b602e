import numpy as np
import pytest

from anytouch_jax.evaluate import splits
from anytouch_jax.evaluate.splits import FOLDS, RowRoles, seeded_splits, split_scheme

N = 240


def rows(kind: str = "apart", **changes) -> RowRoles:
    """60 groups of 4 rows. apart: three quarters teach; shared: every group does both; new: test
    has other classes.
    """
    group = np.arange(N) // 4
    test = {"apart": group % 4 == 3, "shared": np.arange(N) % 4 == 3, "new": group % 4 == 3}[kind]
    y = np.where(test, 3 + group // 4 % 3, group % 3) if kind == "new" else group // 4 % 3
    everything = np.ones(N, bool)
    return RowRoles(
        y, np.array([f"g{one}" for one in group]), test, everything, everything
    )._replace(**changes)


@pytest.mark.parametrize("kind", ["apart", "shared", "new"])
@pytest.mark.parametrize("seed", range(2))
def test_no_group_is_ever_on_two_sides(kind, seed):
    roles = rows(kind)
    tested = []
    for cut in seeded_splits(roles, seed, "grouped"):
        sides = [set(roles.groups[part]) for part in cut]
        assert (
            all(sides)
            and not sides[0] & sides[1]
            and not sides[0] & sides[2]
            and not sides[1] & sides[2]
        )
        tested += cut.test.tolist()
    wanted = np.flatnonzero(roles.test) if kind != "shared" else np.arange(N)
    assert sorted(tested) == wanted.tolist()  # every row once


def test_a_split_that_parts_the_groups_is_kept():
    roles = rows()
    (cut,) = seeded_splits(roles, 0, "grouped")
    assert split_scheme(roles)[0] == "split"
    np.testing.assert_array_equal(cut.test, np.flatnonzero(roles.test))
    assert sorted([*cut.fit, *cut.val]) == np.flatnonzero(~roles.test).tolist()
    assert len(cut.val) == len(np.flatnonzero(~roles.test)) // FOLDS


@pytest.mark.parametrize("protocol", ["grouped", "released"])
def test_a_sensor_of_test_alone_is_folded_within_test(protocol):
    """A sensor that is in split test alone, fitted on and tested on: its number has folds, as its
    class has.
    """
    roles = rows()
    roles = roles._replace(
        y=np.linspace(0, 1, N), regression=True, may_fit=roles.test, may_test=roles.test
    )
    scheme, used, _ = split_scheme(roles)
    assert scheme == "folds"
    np.testing.assert_array_equal(used, roles.test)
    cuts = seeded_splits(roles, 0, protocol)
    assert len(cuts) == FOLDS and all(
        len(cut.fit) and roles.test[one].all() for cut in cuts for one in cut
    )


def test_every_class_is_learned_in_every_fold():
    roles = rows("shared")
    for seed in range(5):
        for cut in seeded_splits(roles, seed, "grouped"):
            assert set(roles.y[cut.fit]) == set(roles.y[cut.test]) == {0, 1, 2}


def test_seeds_deal_anew_and_equal_seeds_equally():
    roles = rows()
    first, again, other = (seeded_splits(roles, seed, "grouped")[0].val for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert set(first) != set(other)


@pytest.mark.parametrize("kind", ["apart", "shared"])
def test_released_keeps_the_manifests_split_whatever_it_shares(kind):
    roles = rows(kind)
    (cut,) = seeded_splits(roles, 3, "released")
    np.testing.assert_array_equal(cut.fit, np.flatnonzero(~roles.test))
    np.testing.assert_array_equal(cut.test, np.flatnonzero(roles.test))
    assert not len(cut.val)


@pytest.mark.parametrize("kind", ["apart", "shared", "new"])
@pytest.mark.parametrize("protocol", ["grouped", "released"])
def test_sensors_and_units_teach_and_are_tested_apart(kind, protocol):
    finger = np.arange(N) // 2 % 2 == 0
    roles = rows(kind, may_fit=finger, may_test=~finger)
    for cut in seeded_splits(roles, 0, protocol):
        assert finger[cut.fit].all() and finger[cut.val].all() and not finger[cut.test].any()
        assert len(cut.fit) and len(cut.test)


@pytest.mark.parametrize("count", [2, 5, 7, 100])
def test_folds_keep_groups_whole_and_spread_classes(count):
    groups = np.repeat(np.arange(30), 5)
    y = np.repeat(np.arange(30) % 3, 5)
    left_out = []
    for fit, out in splits.group_folds(np.arange(150), groups, y, count):
        assert set(groups[fit]).isdisjoint(groups[out]) and len(fit) + len(out) == 150
        if count == 5:
            assert np.bincount(y[out]).tolist() == [10, 10, 10]
        left_out.append(out)
    assert len(left_out) == min(count, 30)
    np.testing.assert_array_equal(np.sort(np.concatenate(left_out)), np.arange(150))


def test_bootstraps_draw_whole_groups():
    groups = np.arange(60) // 4
    rows = np.arange(12, 60)
    for drawn, weights in splits.group_bootstraps(rows, groups, 3):
        assert set(drawn) <= set(rows) and weights.sum() == len(rows)
        for group in np.unique(groups[drawn]):
            assert (
                np.sum(groups[drawn] == group) == 4
                and len(set(weights[groups[drawn] == group])) == 1
            )
    assert not list(splits.group_bootstraps(rows, groups, 0))
