import dataclasses

from experiments.tables import plan

LEAVES = plan.leaves(plan.FULL)
BY_NAME = {(leaf.question, leaf.name, leaf.seed): leaf for leaf in LEAVES}


def stages(question: str, name: str, seed: int = 0) -> dict[int, str]:
    return {one.config.stage: one.key for one in BY_NAME[question, name, seed].trainings}


def test_one_stage_1_serves_all_that_start_from_it():
    whole = stages("q3", "anytouch")
    for name in ("anytouch", "no_text", "no_vision", "no_text_aligned", "no_matching", "no_stage2"):
        assert stages("ablations", name)[1] == whole[1], name
    assert stages("q2", "masked") == {1: whole[1]} and stages("q2", "matched") == whole
    assert stages("q3", "static_only") == stages("ablations", "no_dynamic")  # one model under the names of two tables
    for other in (stages("ablations", "no_universal"), stages("ablations", "no_dynamic"), stages("q3", "t3")):
        assert other[1] != whole[1]
    assert stages("q3", "anytouch", 1)[1] != whole[1]
    second = {stages("ablations", name)[2] for name in ("anytouch", "no_text", "no_vision", "no_matching", "no_stage1")}
    assert len(second) == 5


def test_the_unseen_sensor_is_in_no_training():
    for leaf in LEAVES:
        for one in leaf.trainings:
            names = [*one.config.data.manifests, *one.config.model.sensors]
            assert not any(plan.UNSEEN in name for name in names), leaf.key


def test_files_and_identities_are_of_one_run_each():
    assert len({leaf.key for leaf in LEAVES}) == len({leaf.identity for leaf in LEAVES}) == len(LEAVES)
    again = {leaf.key: leaf.identity for leaf in plan.leaves(plan.FULL)}
    assert plan.chosen(plan.training(plan.FULL, "anytouch", 0).config)["run"]["steps"] == plan.FULL.steps2
    longer = {leaf.key: leaf.identity for leaf in plan.leaves(dataclasses.replace(plan.FULL, steps1=181))}
    assert all(again[leaf.key] == leaf.identity for leaf in LEAVES)
    assert not set(longer.values()) & set(again.values())


def test_a_result_hangs_on_the_simulator_and_not_on_the_name_of_a_size(monkeypatch):
    again = {leaf.key: leaf.identity for leaf in LEAVES}
    named = plan.leaves(dataclasses.replace(plan.FULL, name="changed", seeds=(0, 1, 2, 3)))
    assert again.items() <= {leaf.key: leaf.identity for leaf in named}.items()
    monkeypatch.setattr("anytouch_jax.sim.dataset.VERSION", plan.simulator() + 1)
    later = {leaf.identity for leaf in plan.leaves(plan.FULL)}
    assert not later & set(again.values())
