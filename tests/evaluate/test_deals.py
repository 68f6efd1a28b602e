"""Whole groups on one side, whatever the manifest's split."""

from __future__ import annotations

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.choices import FOLDS
from anytouch_jax.evaluate.deals import Rows, cuts, scheme

N = 240


def rows(kind: str = "apart", **changes) -> Rows:
    """60 groups of 4 rows. apart: three quarters teach; shared: every group does both; new: test has other classes."""
    group = np.arange(N) // 4
    test = {"apart": group % 4 == 3, "shared": np.arange(N) % 4 == 3, "new": group % 4 == 3}[kind]
    y = np.where(test, 3 + group // 4 % 3, group % 3) if kind == "new" else group // 4 % 3
    everything = np.ones(N, bool)
    return Rows(y, np.array([f"g{one}" for one in group]), ~test, test, everything, everything)._replace(**changes)


@pytest.mark.parametrize("kind", ["apart", "shared", "new"])
@pytest.mark.parametrize("seed", range(4))
def test_no_group_is_ever_on_two_sides(kind, seed):
    given = rows(kind)
    tested = []
    for cut in cuts(given, seed, "honest"):
        sides = [set(given.groups[part]) for part in cut]
        assert all(sides) and not sides[0] & sides[1] and not sides[0] & sides[2] and not sides[1] & sides[2]
        tested += cut.test.tolist()
    wanted = np.flatnonzero(given.test) if kind != "shared" else np.arange(N)
    assert sorted(tested) == wanted.tolist()  # every row once


def test_a_split_that_parts_the_groups_is_kept():
    given = rows()
    (cut,) = cuts(given, 0, "honest")
    assert scheme(given)[0] == "split"
    np.testing.assert_array_equal(cut.test, np.flatnonzero(given.test))
    assert sorted([*cut.fit, *cut.val]) == np.flatnonzero(given.pool).tolist()
    assert len(cut.val) == len(np.flatnonzero(given.pool)) // FOLDS


def test_objects_left_out_are_dealt_within_the_test_rows():
    given = rows("new")
    how, used, why = scheme(given)
    assert how == "folds" and "no class of test" in why
    np.testing.assert_array_equal(used, given.test)
    for protocol in ("honest", "published"):
        found = cuts(given, 0, protocol)
        assert len(found) == FOLDS
        assert all(given.test[one].all() for cut in found for one in cut)


@pytest.mark.parametrize("protocol", ["honest", "published"])
def test_what_only_test_has_is_dealt_within_test(protocol):
    """A sensor that is in split test alone, fitted on and tested on: its number has folds, as its class has."""
    given = rows()
    given = given._replace(y=np.linspace(0, 1, N), measured=True, fits=given.test, tests=given.test)
    how, used, why = scheme(given)
    assert how == "folds" and "train has no row of what is fitted on" in why
    np.testing.assert_array_equal(used, given.test)
    found = cuts(given, 0, protocol)
    assert len(found) == FOLDS and all(len(cut.fit) and given.test[one].all() for cut in found for one in cut)


def test_every_class_is_learned_in_every_fold():
    given = rows("shared")
    for seed in range(5):
        for cut in cuts(given, seed, "honest"):
            assert set(given.y[cut.fit]) == set(given.y[cut.test]) == {0, 1, 2}


def test_seeds_deal_anew_and_equal_seeds_equally():
    given = rows()
    first, again, other = (cuts(given, seed, "honest")[0].val for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert set(first) != set(other)


@pytest.mark.parametrize("kind", ["apart", "shared"])
def test_published_keeps_the_manifests_split_whatever_it_shares(kind):
    given = rows(kind)
    (cut,) = cuts(given, 3, "published")
    np.testing.assert_array_equal(cut.fit, np.flatnonzero(given.pool))
    np.testing.assert_array_equal(cut.test, np.flatnonzero(given.test))
    assert not len(cut.val)


@pytest.mark.parametrize("kind", ["apart", "shared", "new"])
@pytest.mark.parametrize("protocol", ["honest", "published"])
def test_sensors_and_units_teach_and_are_tested_apart(kind, protocol):
    finger = np.arange(N) // 2 % 2 == 0
    given = rows(kind, fits=finger, tests=~finger)
    for cut in cuts(given, 0, protocol):
        assert finger[cut.fit].all() and finger[cut.val].all() and not finger[cut.test].any()
        assert len(cut.fit) and len(cut.test)


def test_numbers_are_dealt_by_chance():
    given = rows()._replace(y=np.linspace(0, 1, N), measured=True)
    parts = {tuple(cuts(given, seed, "honest")[0].val) for seed in range(3)}
    assert len(parts) == 3


def test_one_group_is_too_few():
    with pytest.raises(UserError, match="all rows to learn from are of one group, 'g'"):
        cuts(rows()._replace(groups=np.where(rows().test, "other", "g")), 0, "honest")
    with pytest.raises(UserError, match="unknown protocol 'lucky'"):
        cuts(rows(), 0, "lucky")
