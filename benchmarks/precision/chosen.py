"""Steps chosen by a tolerance against equal ones on the artery's wall: to the paper's end, and held to t = 1000."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.precision.kept import EVERY_TANGENT, Found, Kept, Run, measured
from docs.making.pages import lines
from remodel_fenicsx.scene.scene import Scene, preset_scene

Changes = Mapping[str, Any]

TO_THE_END = [5.0, 25.0, 45.0, 65.0, 85.0, 105.0, 125.0, 145.0, 150.0]
HELD = [*TO_THE_END, 200.0, 300.0, 500.0, 700.0, 1000.0]
WALL = {"cells.initial": "isotropic", "model.kinematics": "radial"}
FINE = {"mesh.refinement": 2, "mesh.degree": 2}  # the front is resolved there
PRINTED, CONSISTENT = "kuhl-holzapfel-2007", "consistent"
IMPLICIT = {"remodeling.coupling": "implicit"}
TOLERANCES = (2.0, 1.0, 0.5, 0.25)
SMALL = 1e-4  # degrees: no error


@dataclass(frozen=True)
class Exact:
    """Runs whose weighted sum is the exact result."""

    runs: tuple[Changes, ...]
    weights: tuple[float, ...]


IN_TIME = Exact(({**IMPLICIT, "time.step": 5.0, "time.tolerance": 1.0},), (1.0,))  # eq. (11) has no error in time then


def extrapolated(step: float) -> Exact:
    """From two steps, of a method of second order."""
    return Exact(({"time.step": step}, {"time.step": step / 2}), (-1 / 3, 4 / 3))


@dataclass(frozen=True)
class Way:
    """A way of marching on one mesh.

    Attributes
    ----------
    words
        For the page.
    preset, changes
        Of its scenes.
    runs
        Changes of time by what the page calls them.
    exact
        What tells the exact result.
    turns
        How often all are run; the least seconds count.
    """

    words: str
    preset: str
    changes: Changes
    runs: Mapping[str, Changes]
    exact: Exact
    times: list[float]
    turns: int = 1

    def scene(self, changes: Changes) -> Scene:
        """The wall of isotropic cells."""
        values = {**WALL, "time.end": self.times[-1], **self.changes, **changes}
        return preset_scene(self.preset, "tube").with_values(values)


def runs(steps: tuple[float, ...], tolerances: tuple[float, ...] = TOLERANCES, **more: Any) -> dict[str, Changes]:
    """Equal steps and chosen ones."""
    chosen = {f"tolerance {value:g}": {"time.tolerance": value, **more} for value in tolerances}
    return {f"{step:g}": {"time.step": step} for step in steps} | chosen


# ---------------------------------------------------------------- the ways
PREDICTORS = ("none", "autoregressive")
MESHES = {(2, 2): "refinement 2, degree 2", (1, 1): "refinement 1, degree 1"}
LAWS = {
    "printed": ("printed", PRINTED, runs((5.0, 2.5, 1.0, 0.5, 0.25)), IN_TIME),
    "consistent": ("`consistent`", CONSISTENT, runs((5.0, 2.5, 1.0, 0.5)), extrapolated(0.5)),
}
ENDED = {
    (name, mesh, predictor): Way(
        f"{words}, {elements}", preset,
        {"mesh.refinement": mesh[0], "mesh.degree": mesh[1], "solver.predictor": predictor},
        asked, exact, TO_THE_END, turns=4,
    )
    for name, (words, preset, asked, exact) in LAWS.items()
    for mesh, elements in MESHES.items()
    for predictor in PREDICTORS
}  # fmt: skip
PLAIN, PREDICTED = FINE | EVERY_TANGENT, FINE | EVERY_TANGENT | {"solver.predictor": "autoregressive"}
STEPS, ONE = runs((5.0, 2.5, 1.0)), runs((), TOLERANCES[:1], **{"time.step": 5.0})
HOLDS = {
    "printed": Way("printed: eq. (11), staggered", PRINTED, PLAIN, STEPS, IN_TIME, HELD),
    "predicted": Way("the same, equal steps with the predictor too", PRINTED, PREDICTED, STEPS, IN_TIME, HELD),
    "implicit": Way("eq. (11), `implicit`", PRINTED, PLAIN | IMPLICIT, ONE, IN_TIME, HELD),
    "consistent": Way("`tensor`, `extrapolated`", CONSISTENT, PLAIN, STEPS, extrapolated(1.0), HELD),
}
EQUAL = {"implicit": "printed"}  # whose equal steps the chosen ones are held against, where it is not the way itself


# ---------------------------------------------------------------- runs
def run(kept: Kept, part: str) -> None:
    """What is not kept yet of `end` or `hold`."""
    for name, way in ways(part).items():
        exact = {f"reference {number}": changes for number, changes in enumerate(way.exact.runs)}
        asked = {words: changes for words, changes in (way.runs | exact).items() if f"{name}-{words}" not in kept}
        best: dict[str, Run] = {}
        for turn in range(way.turns):
            for words, changes in asked.items():
                if turn and words in exact:  # nobody asks what it costs
                    continue
                one = measured(way.scene(changes), way.times)
                if words not in best or one["seconds"] < best[words]["seconds"]:
                    best[words] = one
        for words, one in best.items():
            kept.keep(f"{name}-{words}", one)


def ways(part: str) -> dict[str, Way]:
    """Of a part, by the beginning of their files' names."""
    if part == "hold":
        return {f"hold-{name}": way for name, way in HOLDS.items()}
    return {f"end-{name}-{mesh[0]}-degree-{mesh[1]}-{predictor}": way for (name, mesh, predictor), way in ENDED.items()}


def found(kept: Kept, part: str) -> Iterator[dict[str, Found]]:
    """All runs of each way."""
    for name, way in ways(part).items():
        parts = [kept[f"{name}-reference {number}"] for number in range(len(way.exact.runs))]
        weighted = list(zip(way.exact.weights, parts, strict=True))
        angles, lengths = (sum(weight * run[key] for weight, run in weighted) for key in ("angles", "lengths"))
        yield {words: kept.found(f"{name}-{words}", np.asarray(angles), np.asarray(lengths)) for words in way.runs}


# ---------------------------------------------------------------- the tables
def share(one: Found, equal: Mapping[str, Found], error: str, cost: str) -> float:
    """Its cost over that of equal steps of the same error, along straight lines in logarithms."""
    pairs = [(getattr(other, error), getattr(other, cost)) for words, other in equal.items() if words[0].isdigit()]
    errors, costs = np.log(np.array(sorted(pairs), dtype=float)).T
    place = float(np.log(getattr(one, error)))
    k = int(np.clip(np.searchsorted(errors, place) - 1, 0, len(errors) - 2))
    slope = (costs[k + 1] - costs[k]) / (errors[k + 1] - errors[k])
    return float(getattr(one, cost) / np.exp(costs[k] + slope * (place - errors[k])))


def end_rows(kept: Kept) -> str:
    """Of the page: without the predictor and with it; chosen steps over equal ones: predicted alone, both, neither."""
    return lines(_end_rows(dict(zip(ENDED, found(kept, "end"), strict=True))))


def _end_rows(results: Mapping[Any, dict[str, Found]]) -> Iterator[list[str]]:
    for name, mesh, predictor in results:
        if predictor != PREDICTORS[0]:
            continue
        plain, predicted = (results[name, mesh, predictor] for predictor in PREDICTORS)
        pairs = ((predicted, plain), (predicted, predicted), (plain, plain))
        for number, (words, one) in enumerate(predicted.items()):
            cells = ["" if number else ENDED[name, mesh, predictor].words, words, str(one.rows), f"{one.typical:.2g}"]
            for each in (plain[words], one):
                cells += [str(each.iterations), f"{each.seconds:.2g}"]
            for mine, equal in pairs:
                both = [f"{share(mine[words], equal, 'typical', cost):.2f}" for cost in ("seconds", "iterations")]
                cells.append("" if words[0].isdigit() else ", ".join(both))
            yield cells


def hold_rows(kept: Kept) -> str:
    """Of the page."""
    return lines(_hold_rows(dict(zip(HOLDS, found(kept, "hold"), strict=True))))


def _hold_rows(results: Mapping[str, dict[str, Found]]) -> Iterator[list[str]]:
    for name, runs_of in results.items():
        equal = results[EQUAL.get(name, name)]
        for number, (words, one) in enumerate(runs_of.items()):
            errors = [one.typical, one.largest, one.percent] if one.largest > SMALL else [0, 0, 0]
            cells = ["" if number else HOLDS[name].words, words, str(one.rows), str(one.iterations)]
            cells += [f"{value:.2g}" for value in (one.seconds, *errors)]
            yield cells + [_of_equal_error(one, words, equal, error) for error in ("typical", "largest")]


def _of_equal_error(one: Found, words: str, equal: Mapping[str, Found], error: str) -> str:
    if words[0].isdigit():
        return ""
    return "none has it" if getattr(one, error) < SMALL else f"{share(one, equal, error, 'seconds'):.2f}"
