"""The paper's public benchmarks as presets: rows, split, pooling, sensor tokens, head and its hyper-parameters.

Sources: paper, appendix "Downstream Datasets" and Tables 1 to 3; the released code's run_probe_{TAG,Feel,OF1,OF2}.sh,
main_probe.py and downstream_dataset.py (batches are of two devices together). What differs here: features are
computed once, so training pictures are not augmented (the release flips and jitters them, except for ObjectFolder 2.0).
`published` is the release's protocol, its epoch the best on test; `honest` parts videos and objects, and chooses the
epoch on groups left out of train.

Their manifests: `anytouch index touch_and_go ROOT` (`--task rough` for roughness), `anytouch index feel ROOT --fold 3`,
`anytouch index objectfolder ROOT`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from anytouch_jax.encoder.encoder import Pooling
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.heads import Recipe
from anytouch_jax.evaluate.tasks import Task


@dataclass(frozen=True)
class Benchmark:
    """A preset. `universal`: the universal tokens for all (sensors never trained on); `paper`: accuracy of AnyTouch in
    the paper."""

    task: Task
    pooling: Pooling
    recipe: Recipe
    universal: bool
    paper: float

    def settings(self) -> dict[str, Any]:
        """Keyword arguments of `battery.run`."""
        return {
            "pooling": self.pooling, "recipe": self.recipe, "universal": self.universal,
            "head_names": ("gradient",), "protocols": ("published", "honest"),
        }  # fmt: skip


def _touch_and_go(label: str, listed: str, paper: float) -> Benchmark:
    task = Task(f"touch_and_go_{label}", f"label.{'rough' if listed == 'rough' else label}", groups=("recording",),
                which="all", listed=listed, where=("dataset", "touch_and_go"))  # fmt: skip
    return Benchmark(task, "class", Recipe(batch=128, rate=2e-4, decay=0.05), False, paper)


def _objectfolder(number: int, pooling: Pooling, batch: int, paper: float) -> Benchmark:
    task = Task(f"objectfolder{number}_material", "label.material", which="all",
                where=("dataset", f"objectfolder{number}"))  # fmt: skip
    recipe = Recipe(batch=batch, rate=1e-3, decay=0.01)
    return Benchmark(task, pooling, recipe, True, paper)


_FEEL = Task("feel_grasp", "label.success", which="all", fingers=True, where=("dataset", "feel"))
BENCHMARKS = {
    one.task.name: one
    for one in (
        _touch_and_go("material", "material", 0.8082),
        _touch_and_go("roughness", "rough", 0.8674),
        _touch_and_go("hardness", "material", 0.9468),
        Benchmark(_FEEL, "class", Recipe(batch=256, rate=1e-3, decay=0.05), False, 0.8053),
        _objectfolder(1, "mean", 128, 0.4962),
        _objectfolder(2, "class", 256, 0.7602),
    )
}  # fmt: skip


def benchmark_of(name: str) -> Benchmark:
    """The preset of that name. Raises UserError."""
    if name not in BENCHMARKS:
        raise UserError(f"there is no benchmark {name!r}; choose among {', '.join(BENCHMARKS)}")
    return BENCHMARKS[name]
