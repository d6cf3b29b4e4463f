"""Steps chosen by a tolerance against equal ones on the wall of the artery, held to t = 1000."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.precision.whole import EVERY_TANGENT
from remodel_fenicsx.scene.scene import Scene, preset_scene

Array = NDArray[np.float64]
Measured = Callable[[Scene, list[float]], dict[str, Array]]

TIMES = [5.0, 25.0, 45.0, 65.0, 85.0, 105.0, 125.0, 145.0, 150.0, 200.0, 300.0, 500.0, 700.0, 1000.0]
STEPS, TOLERANCES = (5.0, 2.5, 1.0), (2.0, 1.0, 0.5, 0.25)
MESH = {"mesh.refinement": 2, "mesh.degree": 2, "model.kinematics": "radial"}  # the front is resolved there
SMALL = 1e-4  # degrees: no error


@dataclass(frozen=True)
class Way:
    """A way of marching, and what of it tells the exact result.

    Attributes
    ----------
    words
        For the page.
    preset, changes
        Of its scenes.
    equal
        The way whose equal steps chosen ones are compared with, by name.
    reference
        Changes of runs that are combined with `weights` to the exact result.
    """

    words: str
    preset: str
    changes: Mapping[str, Any]
    equal: str
    reference: tuple[Mapping[str, Any], ...]
    weights: tuple[float, ...]


IMPLICIT = {"remodeling.coupling": "implicit"}
EXACT = ({**IMPLICIT, "time.step": 5.0, "time.tolerance": 1.0},)  # eq. (11) has then no error in time
RICHARDSON = ({"time.step": 1.0}, {"time.step": 0.5})
PREDICTED = {"solver.predictor": "autoregressive"}
PRINTED = "kuhl-holzapfel-2007"
WAYS = {
    "printed": Way("printed: eq. (11), staggered", PRINTED, {}, "printed", EXACT, (1.0,)),
    "predicted": Way("the same, equal steps with the predictor too", PRINTED, PREDICTED, "predicted", EXACT, (1.0,)),
    "implicit": Way("eq. (11), `implicit`", PRINTED, IMPLICIT, "printed", EXACT, (1.0,)),
    "consistent": Way("`tensor`, `extrapolated`", "consistent", {}, "consistent", RICHARDSON, (-1 / 3, 4 / 3)),
}


def scene(way: Way, changes: Mapping[str, Any]) -> Scene:
    """The wall of isotropic cells."""
    values = {"cells.initial": "isotropic", "time.end": TIMES[-1], **MESH, **way.changes, **changes}
    return preset_scene(way.preset, "tube").with_values({**EVERY_TANGENT, **values})


def runs(name: str) -> dict[str, Mapping[str, Any]]:
    """The settings of a way, by what the page calls them: equal steps only where others are compared with them."""
    first = {"time.step": 5.0} if name == "implicit" else {}
    steps = {f"{step:g}": {"time.step": step} for step in STEPS} if WAYS[name].equal == name else {}
    tolerances = TOLERANCES[:1] if name == "implicit" else TOLERANCES
    return steps | {f"tolerance {value:g}": {"time.tolerance": value, **first} for value in tolerances}


def run(folder: Path, measured: Measured) -> None:
    """What is not kept yet."""
    for name, way in WAYS.items():
        wanted = dict(runs(name)) | {f"reference {k}": changes for k, changes in enumerate(way.reference)}
        for words, changes in wanted.items():
            kept = _kept(folder, name, words)
            if not kept.exists():
                found = measured(scene(way, changes), TIMES)
                np.savez(kept, **found)
                print(f"{name:12} {words}: {float(found['seconds']):.2g} s", flush=True)


def _kept(folder: Path, name: str, words: str) -> Path:
    return folder / f"hold-{name}-{words.replace(' ', '-')}.npz"


@dataclass(frozen=True)
class Held:
    """One run.

    Attributes
    ----------
    seconds, rows, iterations
        Of the processor; steps; Newton iterations.
    typical, largest
        Error of the fibre angle, degrees: root mean square over places and times, and over places at the worst time.
    percent
        Largest relative error of the radii.
    """

    seconds: float
    rows: int
    iterations: int
    typical: float
    largest: float
    percent: float


def held(folder: Path, name: str) -> dict[str, Held]:
    """All runs of a way."""
    way = WAYS[name]
    parts = [np.load(_kept(folder, name, f"reference {k}")) for k in range(len(way.reference))]
    angles = sum(weight * part["angles"] for weight, part in zip(way.weights, parts, strict=True))
    lengths = sum(weight * part["lengths"] for weight, part in zip(way.weights, parts, strict=True))
    found = {}
    for words in runs(name):
        with np.load(_kept(folder, name, words)) as kept:
            apart = np.sqrt(np.mean((kept["angles"] - angles) ** 2, axis=1))
            percent = 100 * float(np.max(np.abs(kept["lengths"] / lengths - 1)))
            whole = (float(kept["seconds"]), int(kept["rows"]), int(kept["iterations"]))
            found[words] = Held(*whole, float(np.sqrt(np.mean(apart**2))), float(apart.max()), percent)
    return found


def of_equal_error(error: float, equal: list[tuple[float, float]]) -> float:
    """Seconds of equal steps of an error, from the measured (error, seconds) along straight lines in logarithms."""
    errors, seconds = np.log(np.array(sorted(equal))).T
    place = float(np.log(error))
    k = int(np.clip(np.searchsorted(errors, place) - 1, 0, len(errors) - 2))
    slope = (seconds[k + 1] - seconds[k]) / (errors[k + 1] - errors[k])
    return float(np.exp(seconds[k] + slope * (place - errors[k])))


def rows(folder: Path) -> str:
    """The table of the page."""
    lines = []
    for name, way in WAYS.items():
        equal = held(folder, way.equal)
        for number, (words, one) in enumerate(held(folder, name).items()):
            shares = "| | |"
            if words.startswith("tolerance"):
                shares = f"| {_share(one, equal, 'typical')} | {_share(one, equal, 'largest')} |"
            errors = [one.typical, one.largest, one.percent] if one.largest > SMALL else [0, 0, 0]
            cells = ["" if number else way.words, words, str(one.rows), str(one.iterations), f"{one.seconds:.2g}"]
            lines.append(f"| {' | '.join(cells + [f'{error:.2g}' for error in errors])} {shares}")
    return "\n".join(lines)


def _share(one: Held, equal: Mapping[str, Held], which: str) -> str:
    """Its seconds over those of equal steps with the same error."""
    error = getattr(one, which)
    if error < SMALL:
        return "none has it"
    pairs = [(getattr(other, which), other.seconds) for words, other in equal.items() if words[0].isdigit()]
    return f"{one.seconds / of_equal_error(error, pairs):.2f}"
