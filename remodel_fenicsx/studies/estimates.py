"""The errors of settings from what all of them give: the table of a trade, and what it rests on.

What ever finer settings tend to is known by Richardson's extrapolation, where their results show an order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.studies.ladder import KINEMATIC, Setting, is_reduced

Array = NDArray[np.float64]

UNKNOWN_SHARE = 0.5  # of an error: what is left unknown may be so much of it
NO_ERROR = 1e-6  # degrees: what solves leave is less, what elements and steps leave more
SPREAD = 2.0  # noise of the mean over the seeds that an error must be above
RATIOS = (1.35, 40.0)  # of differences of one halving and the next that are those of an order
ALIGNED = 0.5  # cosine of the angle between two differences, as vectors, that shrink along one way


# ---------------------------------------------------------------- an order, and what is left with it
@dataclass(frozen=True)
class SweepLimit:
    """What a sweep of one factor tends to.

    Attributes
    ----------
    beyond
        What is left from its finest member to the limit; zero where no order shows.
    order
        Power of the step or of the size of the elements; NaN where none shows.
    last
        Difference of the finest two.
    """

    beyond: Array
    order: float
    last: Array

    @property
    def trusted(self) -> bool:
        """Whether an order shows."""
        return bool(np.isfinite(self.order))


def limit(results: Sequence[Array]) -> SweepLimit:
    """The limit of results of settings that are each half of the one before, the finest last.

    Differences d of results Q fall by a ratio q = 2^p from halving to halving; what is left is d / (q - 1). An order
    shows where the differences shrink along one way: by a ratio in RATIOS, ALIGNED.
    """
    if len(results) < 3:
        last = results[-1] - results[-2] if len(results) == 2 else np.full_like(results[-1], np.nan)
        return SweepLimit(np.zeros_like(results[-1]), np.nan, last)
    before, last = results[-2] - results[-3], results[-1] - results[-2]
    size_before, size = typical(before), typical(last)
    if size == 0:
        return SweepLimit(np.zeros_like(last), np.inf, last)
    ratio = size_before / size
    cosine = float(np.nansum(before * last) / max(np.nansum(before**2) ** 0.5 * np.nansum(last**2) ** 0.5, 1e-300))
    if not RATIOS[0] < ratio < RATIOS[1] or cosine < ALIGNED:
        return SweepLimit(np.zeros_like(last), np.nan, last)
    return SweepLimit(np.asarray(last / (ratio - 1), dtype=np.float64), float(np.log2(ratio)), last)


def typical(values: Array) -> float:
    """Root mean square of what is known."""
    return float(np.sqrt(np.nanmean(values**2)))


def pareto(costs: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which of some settings no other one beats in cost and error."""
    pairs = list(zip(costs, errors, strict=True))
    return [
        np.isfinite(error) and not any((c <= cost and e < error) or (c < cost and e <= error) for c, e in pairs)
        for cost, error in pairs
    ]


# ---------------------------------------------------------------- the table
@dataclass(frozen=True)
class Result:
    """What a setting gives: means over its seeds.

    Attributes
    ----------
    setting
        Which.
    angles
        Fibre angles through the body at the times that are compared, (times, places), degrees.
    lengths
        Radii or stretch there, (times, columns).
    seconds
        Of the processor in the steps of one run.
    wall_seconds
        That have passed in them.
    noise
        Standard error of the mean of the angles over the seeds, root mean square; 0 of one seed.
    single
        Angles and lengths of the first seed alone.
    """

    setting: Setting
    angles: Array
    lengths: Array
    seconds: float
    wall_seconds: float
    noise: float
    single: tuple[Array, Array]


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes
    ----------
    result
        The setting and what it gives.
    angle_error
        Estimated error of the fibre angle, degrees, root mean square over places and times.
    length_error
        The same of radii or stretch: the largest relative one.
    on_front
        Whether no other row is as good for less.
    doubt
        Why the estimate is not to be trusted; empty where it is.
    """

    result: Result
    angle_error: float
    length_error: float
    on_front: bool = False
    doubt: str = ""


@dataclass(frozen=True)
class Trade:
    """The table, and what it rests on.

    Attributes
    ----------
    rows
        The cheapest first.
    notes
        Sentences on what was seen: orders, doubts.
    left_out
        Names of settings that the budget was too small for.
    failed
        Last words of runs that failed, by name.
    """

    rows: list[Row]
    notes: list[str]
    left_out: list[str]
    failed: dict[str, str]


@dataclass(frozen=True)
class _Guess:
    """Of the exact result: what settings of one coupling tend to.

    Attributes
    ----------
    angles, lengths
        As in `Result`.
    unknown
        Degrees that stay unknown where a sweep shows no order; infinite where a factor was not varied.
    beyond
        Degrees from the finest setting to it.
    notes
        What it rests on.
    """

    angles: Array
    lengths: Array
    unknown: float
    beyond: float
    notes: list[str]


def estimated(results: Sequence[Result]) -> tuple[list[Row], list[str]]:
    """Rows with errors against the best guess of the exact result, and what it rests on.

    Settings of each coupling make a guess; the best one has the least before it, and the least unknown. What is not
    known of it, where a sweep shows no order, counts as an error too.
    """
    notes = _about_steps_on_the_same_cells(results)
    results = _on_the_mean(results)
    fixed = [result for result in results if result.setting.step is not None]
    by_coupling = {
        name: [result for result in fixed if result.setting.way[1] == name]
        for name in dict.fromkeys(result.setting.way[1] for result in fixed)
    }
    guesses = {name: _guess(same) for name, same in by_coupling.items()}
    if not guesses:
        return [Row(result, np.nan, np.nan, doubt="nothing to compare with") for result in results], notes
    name, best = min(guesses.items(), key=lambda item: float(np.hypot(item[1].unknown, item[1].beyond)))
    notes += best.notes
    for other, guess in guesses.items():
        if other != name and np.isfinite(guess.unknown):
            apart = typical(guess.angles - best.angles)
            notes.append(f"couplings: the limits of {other!r} and {name!r} are {apart:.2g} degrees apart")
    rows = [_row(result, best) for result in results]
    rows.sort(key=lambda row: row.result.seconds)
    on_front = pareto([row.result.seconds for row in rows], [row.angle_error for row in rows])
    notes += _about_kinematics(results)
    return [replace(row, on_front=is_best) for row, is_best in zip(rows, on_front, strict=True)], notes


def _guess(fixed: Sequence[Result]) -> _Guess:
    """What settings with fixed steps, and one coupling, tend to."""
    finest = min(fixed, key=_fineness)
    angles, lengths, unknown, notes = finest.angles, finest.lengths, 0.0, []
    sweeps = {"time": _time_sweep(fixed)}
    if not KINEMATICS[finest.setting.mesh[0]].homogeneous:
        sweeps["mesh"] = _mesh_sweep(fixed)
    for factor, (sweep, words) in sweeps.items():
        if not sweep:
            notes.append(f"{factor}: fewer than two settings were run, so its error is in no estimate")
            unknown = np.inf
            continue
        found, found_lengths = limit([r.angles for r in sweep]), limit([r.lengths for r in sweep])
        # what the sweep has still before it where the finest of all stands
        ahead = next((r for r in sweep if _same_level(r, finest, factor)), sweep[-1])
        angles = angles + found.beyond + sweep[-1].angles - ahead.angles
        lengths = lengths + found_lengths.beyond + sweep[-1].lengths - ahead.lengths
        notes.append(_words(factor, words, found))
        if not found.trusted:
            unknown = max(unknown, typical(found.last)) if np.isfinite(found.last).any() else np.inf
    return _Guess(angles, lengths, unknown, typical(angles - finest.angles), notes)


def _row(result: Result, guess: _Guess) -> Row:
    error, unknown = typical(result.angles - guess.angles), guess.unknown
    if np.isfinite(unknown):
        error = float(np.hypot(error, unknown))
    length = float(np.nanmax(np.abs(result.lengths / guess.lengths - 1)))
    doubt = ""
    if unknown > UNKNOWN_SHARE * error:
        doubt = "no order seen" if np.isfinite(unknown) else "a factor was not varied"
    if SPREAD * result.noise > error:
        doubt = f"noise of random cells {result.noise:.2g}"
    return Row(result, error, length, doubt=doubt)


def _on_the_mean(results: Sequence[Result]) -> list[Result]:
    """Settings of one seed moved by what the mean over the seeds is beside it, on the mesh that they share."""
    several = {result.setting.mesh: result for result in results if len(result.setting.seeds) > 1}
    found = []
    for result in results:
        other = several.get(result.setting.mesh)
        if other is not None and len(result.setting.seeds) == 1:
            angles = result.angles + other.angles - other.single[0]
            lengths = result.lengths + other.lengths - other.single[1]
            result = replace(result, angles=angles, lengths=lengths, noise=other.noise)
        found.append(result)
    return found


def _fineness(result: Result) -> tuple[float, ...]:
    """Smaller is finer: the size of elements over their degree, and the step."""
    _, refinement, degree = result.setting.mesh
    return (result.setting.step or np.inf) / (refinement * degree**2), not is_reduced(result.setting)


def _time_sweep(results: Sequence[Result]) -> tuple[list[Result], str]:
    """A chain of halved steps on one mesh: of chains that may tell an order that on the finest mesh."""
    chains = []
    for mesh in sorted({result.setting.mesh for result in results}, key=lambda mesh: mesh[1] * mesh[2] ** 2):
        same = [r for r in results if r.setting.mesh == mesh]
        chains.append(_halved({r.setting.step: r for r in same if r.setting.step is not None}))
    found = _last_of_the_longest(chains)
    return found, f"steps {', '.join(f'{r.setting.step:g}' for r in found)} on {_mesh_in_words(found)}"


def _mesh_sweep(results: Sequence[Result]) -> tuple[list[Result], str]:
    """A chain of doubled refinements: of chains that may tell an order that of the highest degree, with small steps."""
    chains = []
    fixed = [(r.setting.step, r) for r in results if r.setting.step is not None]
    kinds = {(r.setting.mesh[2], -step, r.setting.mesh[0]) for step, r in fixed}
    for degree, negative, kinematics in sorted(kinds):
        same = [r for step, r in fixed if step == -negative and r.setting.mesh[::2] == (kinematics, degree)]
        chains.append(_halved({1.0 / r.setting.mesh[1]: r for r in same}))
    found = _last_of_the_longest(chains)
    refinements = ", ".join(str(r.setting.mesh[1]) for r in found)
    return found, f"refinements {refinements} of degree {found[-1].setting.mesh[2] if found else 0}"


def _last_of_the_longest(chains: Sequence[list[Result]]) -> list[Result]:
    """The last chain of three or more, or of two; nothing where there is none."""
    for length in (3, 2):
        if long := [chain for chain in chains if len(chain) >= length]:
            return long[-1]
    return []


def _mesh_in_words(found: Sequence[Result]) -> str:
    return f"refinement {found[-1].setting.mesh[1]}, degree {found[-1].setting.mesh[2]}" if found else "no mesh"


def _halved(by_size: dict[float, Result]) -> list[Result]:
    """The longest chain of sizes that are each half of the one before, the finest last."""
    chains = []
    for size in by_size:
        chain = [size]
        while (finer := next((s for s in by_size if same_time(2 * s, chain[-1])), None)) is not None:
            chain.append(finer)
        chains.append(chain)
    longest = max(chains, key=lambda chain: (len(chain), -chain[-1]), default=[])
    return [by_size[size] for size in longest]


def _same_level(result: Result, finest: Result, factor: str) -> bool:
    if factor == "time":
        return result.setting.step == finest.setting.step
    return result.setting.mesh[1:] == finest.setting.mesh[1:]


def _words(factor: str, words: str, found: SweepLimit) -> str:
    if typical(found.last) < NO_ERROR:
        return f"{factor}: no error ({words}): the last two differ by {typical(found.last):.2g} degrees"
    if found.trusted:
        return f"{factor}: order {found.order:.2g} ({words}); the finest is {typical(found.beyond):.2g} degrees off"
    return (
        f"{factor}: no order seen ({words}), the last two differ by {typical(found.last):.2g} degrees: the estimates "
        "are differences to the finest, and no better than that"
    )


def _about_steps_on_the_same_cells(results: Sequence[Result]) -> list[str]:
    """What steps alone cost, where the noise of random cells hides it: all of them have the first seed's cells."""
    if not any(result.noise for result in results):
        return []
    by_mesh: dict[tuple[str, int, int], list[Result]] = {}
    for result in results:
        by_mesh.setdefault(result.setting.mesh, []).append(replace(result, angles=result.single[0]))
    same = max(by_mesh.values(), key=len)  # the mesh on which most steps were tried
    sweep = _halved({result.setting.step: result for result in same if result.setting.step is not None})
    if len(sweep) < 2:
        return []
    found = limit([result.angles for result in sweep])
    exact, finest = sweep[-1].angles + found.beyond, sweep[-1].setting
    costs = ", ".join(
        f"{r.setting.steps_in_words} {typical(r.angles - exact):.2g}" for r in same if r.setting is not finest
    )
    last = "an order shows" if found.trusted else f"no order shows, {finest.steps_in_words} counts as exact"
    return [f"steps alone, on the same cells ({_mesh_in_words(sweep)}; {last}), cost in degrees: {costs}"]


def _about_kinematics(results: Sequence[Result]) -> list[str]:
    """Whether the whole body does what a part of it does."""
    notes = []
    for result in results:
        if result.setting.factor != KINEMATIC or is_reduced(result.setting):
            continue
        alike = [r for r in results if is_reduced(r.setting) and r.setting.mesh[1:] == result.setting.mesh[1:]]
        part = next((r for r in alike if (r.setting.step, r.setting.way[1])
                     == (result.setting.step, result.setting.way[1])), None)  # fmt: skip
        if part is not None:
            apart = typical(result.angles - part.angles)
            several = "; where finer meshes do not bring them together the body has several solutions"
            notes.append(
                f"kinematics: {result.setting.mesh[0]} and {part.setting.mesh[0]} on alike elements are {apart:.2g} "
                f"degrees apart{several if apart > NO_ERROR else ''}"
            )
    return notes
