import numpy as np
import pytest

from anytouch_jax.data.loading.sampling import Matches, MatchKeys


def _keys(**columns):
    size = len(next(iter(columns.values())))
    return MatchKeys(
        *(np.array(columns.get(name, [-1] * size), np.int64) for name in MatchKeys._fields)
    )


def _draws(matches, anchor, count=200):
    drawn = [matches.draw(anchor, np.random.default_rng(key)) for key in range(count)]
    return {positive for positive, _ in drawn}, {negative for _, negative in drawn}


def test_negatives_are_elsewhere_and_by_option_of_another_object():
    keys = _keys(
        touch=[0, 0, 1, 2, 2, -1, -1, -1, -1],
        sensor=[0, 1, 0, 0, 1, 0, 0, 0, 0],
        object=[5, 5, 5, 6, 6, 6, 5, -1, -1],
        dataset=[0, 0, 0, 0, 0, 0, 0, 0, 1],
    )
    matches = Matches(np.arange(9), keys, other_object=True)
    assert matches.anchors.tolist() == [0, 1, 3, 4]
    # 2 is the same object, 6 too; 7 may be the very same place; 8 is of another data set.
    assert _draws(matches, 0)[1] == {3, 4, 5, 8}
    assert _draws(matches, 3)[1] == {0, 1, 2, 6, 8}
    # Sec. 3.4: "any other object or location"; 6 may be 0's own place
    anywhere = Matches(np.arange(9), keys)
    assert _draws(anywhere, 0)[1] == {2, 3, 4, 5, 8}
    assert _draws(anywhere, 3)[1] == {0, 1, 2, 6, 8}


def test_negatives_are_uniform():
    touch = np.repeat(np.arange(10), 2)
    matches = Matches(np.arange(20), _keys(touch=touch, sensor=np.tile([0, 1], 10), object=touch))
    counts = np.zeros(20)
    for key in range(3600):
        counts[matches.draw(4, np.random.default_rng(key))[1]] += 1
    assert not counts[4:6].any()
    assert np.abs(np.delete(counts, [4, 5]) - 200).max() < 5 * np.sqrt(200)


def test_a_rare_negative_is_found():
    touch = np.array([0, 0, *[1] * 3000, 2])
    keys = _keys(
        touch=touch, sensor=np.array([0, 1, *[0] * 3001]), object=np.array([*[0] * 3002, 1])
    )
    assert _draws(Matches(np.arange(3003), keys, other_object=True), 0, 20)[1] == {3002}


def test_no_anchor_where_there_is_no_pair_or_no_negative():
    assert not Matches(np.arange(0), _keys(touch=[], sensor=[])).anchors.size
    assert not Matches(np.arange(3), _keys(touch=[-1] * 3, sensor=[0, 1, 2])).anchors.size
    # nothing to tell them from
    assert not Matches(np.arange(2), _keys(touch=[0, 0], sensor=[0, 1])).anchors.size
    # 2 may be the place
    assert not Matches(np.arange(3), _keys(touch=[0, 0, -1], sensor=[0, 1, 1])).anchors.size
    other = _keys(touch=[0, 0, -1], sensor=[0, 1, 1], object=[1, 1, 2])
    assert Matches(np.arange(3), other).anchors.tolist() == [0, 1]
    # One known place, two objects named there: what has no place is elsewhere only for those of
    # another object.
    mixed = _keys(touch=[0, 0, 0, -1], sensor=[0, 1, 0, 1], object=[1, 1, 2, 2])
    assert Matches(np.arange(4), mixed).anchors.tolist() == [0, 1]
    assert Matches(np.array([3, 2, 1, 0]), mixed).anchors.tolist() == [2, 3]


def _random(seed, rows, highs):
    rng = np.random.default_rng(seed)
    columns = {
        name: rng.integers(-1, high, rows)
        for name, high in zip(MatchKeys._fields, highs, strict=True)
    }
    return _keys(**columns | {"sensor": np.abs(columns["sensor"])}), rng


@pytest.mark.parametrize("seed", range(5))
def test_laws_hold_on_random_tables(seed):
    """Another sensor is preferred to another unit, and an unknown unit is not another one."""
    keys, rng = _random(seed, 60, (8, 3, 4, 4, 2))
    pool = rng.permutation(60)[:40]
    matches = Matches(pool, keys)
    elsewhere = Matches(pool, keys, other_object=True)
    brute = []
    for a, row in enumerate(pool):
        same = [r for r in pool if keys.touch[r] == keys.touch[row] >= 0]
        sensors = {keys.sensor[r] for r in same}
        units = {keys.unit[r] for r in same} - {-1}
        if len(sensors) > 1 or (len(units) > 1 and keys.unit[row] >= 0):
            brute.append(a)
    assert matches.anchors.tolist() == brute and len(brute) > 5
    for anchor in matches.anchors:
        a = pool[anchor]
        others = {keys.sensor[r] for r in pool if keys.touch[r] == keys.touch[a]} - {keys.sensor[a]}
        for key in range(20):
            p, n = pool[list(matches.draw(int(anchor), np.random.default_rng(key)))]
            assert keys.touch[p] == keys.touch[a] and p != a
            assert keys.sensor[p] != keys.sensor[a] or (
                not others and -1 not in (keys.unit[p], keys.unit[a])
            )
            assert keys.sensor[p] != keys.sensor[a] or keys.unit[p] != keys.unit[a]
            assert keys.touch[n] != keys.touch[a]
            p, n = pool[list(elsewhere.draw(int(anchor), np.random.default_rng(key)))]
            assert keys.touch[n] != keys.touch[a]
            assert keys.object[n] != keys.object[a] or keys.object[a] == -1


@pytest.mark.parametrize("seed", range(6))
def test_a_negative_of_the_same_sensor_on_random_tables(seed):
    """A sensor that felt one place only is no partner."""
    keys, _ = _random(seed, 50, (9, 4, 4, 4, 2))
    matches = Matches(np.arange(50), keys, same_sensor=True)
    places = {s: set(keys.touch[keys.sensor == s].tolist()) - {-1} for s in range(4)}
    brute = []
    for a in range(50):
        same = [r for r in range(50) if keys.touch[r] == keys.touch[a] >= 0]
        others = [r for r in same if keys.sensor[r] != keys.sensor[a]]
        fit = [r for r in others if len(places[keys.sensor[r]]) > 1]
        units = {keys.unit[r] for r in same} - {-1}
        lock = (
            not others and len(units) > 1 and keys.unit[a] >= 0 and len(places[keys.sensor[a]]) > 1
        )
        brute += [a] if fit or lock else []
    assert matches.anchors.tolist() == brute and len(brute) > 5
    for anchor in brute:
        for key in range(20):
            p, n = matches.draw(anchor, np.random.default_rng(key))
            assert (
                keys.sensor[n] == keys.sensor[p]
                and keys.touch[n] != keys.touch[anchor] == keys.touch[p]
            )
