"""Steps chosen by a tolerance against equal ones to the paper's end, on coarse and on fine elements."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.precision.hold import of_equal_error
from remodel_fenicsx.scene.scene import Scene, preset_scene
from remodel_fenicsx.studies.estimates import typical

Array = NDArray[np.float64]
Measured = Callable[[Scene, list[float]], dict[str, Array]]

TOLERANCES, TURNS = (2.0, 1.0, 0.5, 0.25), 4
PREDICTORS = ("none", "autoregressive")
MESHES = {(2, 2): "refinement 2, degree 2", (1, 1): "refinement 1, degree 1"}


@dataclass(frozen=True)
class Law:
    """A preset, its equal steps, and runs that are combined with `weights` to the exact result on each mesh."""

    words: str
    preset: str
    steps: tuple[float, ...]
    reference: tuple[Mapping[str, Any], ...]
    weights: tuple[float, ...]


EXACT = ({"remodeling.coupling": "implicit", "time.step": 5.0, "time.tolerance": 1.0},)  # no error in time
RICHARDSON = ({"time.step": 0.5}, {"time.step": 0.25})
LAWS = {
    "printed": Law("printed", "kuhl-holzapfel-2007", (5.0, 2.5, 1.0, 0.5, 0.25), EXACT, (1.0,)),
    "consistent": Law("`consistent`", "consistent", (5.0, 2.5, 1.0, 0.5), RICHARDSON, (-1 / 3, 4 / 3)),
}


def _runs(law: Law) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Predictor, what the page calls the steps, and changes."""
    for predictor in PREDICTORS:
        for key, values in (("step", law.steps), ("tolerance", TOLERANCES)):
            for value in values:
                yield predictor, f"{key} {value:g}", {f"time.{key}": value, "solver.predictor": predictor}


def _kept(folder: Path, law: str, mesh: tuple[int, int], *words: str) -> Path:
    name = "-".join(("end", law, str(mesh[0]), "degree", str(mesh[1]), *words)).replace(" ", "-")
    return folder / f"{name}.npz"


def _scene(law: Law, mesh: tuple[int, int], changes: Mapping[str, Any]) -> Scene:
    wall = {"cells.initial": "isotropic", "model.kinematics": "radial"}
    elements = {"mesh.refinement": mesh[0], "mesh.degree": mesh[1]}
    return preset_scene(law.preset, "tube").with_values({**wall, **elements, **changes})


def run(folder: Path, measured: Measured, times: list[float]) -> None:
    """What is not kept yet; all of a mesh in turns, of which each run's least seconds count."""
    for name, law in LAWS.items():
        for mesh in MESHES:
            wanted = {_kept(folder, name, mesh, *words): changes for *words, changes in _runs(law)}
            for number, changes in enumerate(law.reference):
                kept = _kept(folder, name, mesh, f"reference {number}")
                if not kept.exists():
                    np.savez(kept, **measured(_scene(law, mesh, changes), times))
            missing = {kept: changes for kept, changes in wanted.items() if not kept.exists()}
            found: dict[Path, dict[str, Array]] = {}
            for _ in range(TURNS):
                for kept, changes in missing.items():
                    one = measured(_scene(law, mesh, changes), times)
                    if kept not in found or one["seconds"] < found[kept]["seconds"]:
                        found[kept] = one
            for kept, one in found.items():
                np.savez(kept, **one)
                print(f"{kept.stem}: {float(one['seconds']):.2g} s", flush=True)


@dataclass(frozen=True)
class Ended:
    """A run: its steps, Newton iterations, seconds, and typical error in degrees."""

    number: int
    iterations: int
    seconds: float
    degrees: float


def _ended(folder: Path, name: str, mesh: tuple[int, int]) -> dict[tuple[str, str], Ended]:
    """All runs of a law on a mesh by predictor and steps."""
    law, found = LAWS[name], {}
    parts = [np.load(_kept(folder, name, mesh, f"reference {k}"))["angles"] for k in range(len(law.reference))]
    angles = sum(weight * part for weight, part in zip(law.weights, parts, strict=True))
    for predictor, words, _ in _runs(law):
        with np.load(_kept(folder, name, mesh, predictor, words)) as kept:
            numbers = int(kept["rows"]), int(kept["iterations"]), float(kept["seconds"])
            found[predictor, words] = Ended(*numbers, typical(kept["angles"] - angles))
    return found


def rows(folder: Path) -> str:
    """The table of the page."""
    lines = []
    for name, law in LAWS.items():
        for mesh, elements in MESHES.items():
            found, label = _ended(folder, name, mesh), f"{law.words}, {elements}"
            for words in dict.fromkeys(words for _, words, _ in _runs(law)):
                plain, predicted = (found[predictor, words] for predictor in PREDICTORS)
                cells = [label, words.removeprefix("step "), str(predicted.number), f"{predicted.degrees:.2g}"]
                cells += [f"{one.iterations} | {one.seconds:.2g}" for one in (plain, predicted)]
                lines.append(f"| {' | '.join([*cells, *_shares(found, words)])} |")
                label = ""
    return "\n".join(lines)


def _shares(found: Mapping[tuple[str, str], Ended], words: str) -> list[str]:
    """Of seconds and of iterations of equal steps of the same error: predicted chosen steps alone, both, neither."""
    if words.startswith("step"):
        return ["", "", ""]
    plain, predicted = PREDICTORS
    pairs = ((predicted, plain), (predicted, predicted), (plain, plain))
    return [_share(found[chosen, words], [one for key, one in found.items() if _is_equal(key, equal)])
            for chosen, equal in pairs]  # fmt: skip


def _is_equal(key: tuple[str, str], predictor: str) -> bool:
    return key[0] == predictor and key[1].startswith("step")


def _share(one: Ended, equal: list[Ended]) -> str:
    seconds = of_equal_error(one.degrees, [(other.degrees, other.seconds) for other in equal])
    iterations = of_equal_error(one.degrees, [(other.degrees, float(other.iterations)) for other in equal])
    return f"{one.seconds / seconds:.2f}, {one.iterations / iterations:.2f}"
