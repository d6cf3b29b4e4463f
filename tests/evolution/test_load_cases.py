"""[[cases]]: load cases of a cycle, solved with the same cells, which follow their mean."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from remodel_fenicsx import SceneError, Simulation
from remodel_fenicsx.evolution.coupling import Staggered
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.laws import Drive, largest_tension, mean_target, mean_tensor
from remodel_fenicsx.model.tensor_law import Target, target
from remodel_fenicsx.report import write_report
from remodel_fenicsx.running import resume
from remodel_fenicsx.scene import scene_from_dict
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.studies.fit import fit
from remodel_fenicsx.studies.stability import stability
from tests.reference.radial import CIRCUMFERENTIAL, RadialMaterial, Tube, cauchy_stress, structure
from tests.runs import columns, columns_of, goes_on, last_row, made, rows_of, simulated
from tests.values import ANGLES, TENSION, assert_close, isotropic, ramped

TURNOVER = {"time": 40.0, "deposition_stretch": 1.1, "gain": 1.0} | TENSION
GROWING = [
    {"law": "tensor", "coupling": coupling, "turnover": TURNOVER}
    for coupling in ("staggered", "extrapolated")
]
LAWS = [("tensor", "extrapolated"), ("tensor", "relaxed"), ("explicit", "staggered")]
HALVES = [{"weight": 0.5}, {"weight": 0.5}]
COUNTED = ("newton_iterations", "linear_iterations", "seconds")
OF_EACH = ("pressure", "axial_elongation", "inner_radius", "stored_energy", "max_chain_extension")
TURNS = 1e-9  # relative: rounding, after steps that hand it on


def pulse(a: float) -> list[dict[str, Any]]:
    """Diastole and systole about the same mean pressure."""
    return [
        {"weight": 2 / 3, "loads": {"pressure": 1 - a}},
        {"weight": 1 / 3, "loads": {"pressure": 1 + 2 * a}},
    ]


def artery(
    cases: Any = (), end: float = 30.0, columns: Any = (), pressure: float = 4.8, **tables: Any
) -> Any:
    """The paper's artery on one radius."""
    values = isotropic(
        "consistent",
        mesh={"refinement": 4, "degree": 2},
        loads=ramped(24.0, pressure=pressure, elongation=0.1),
        time={"end": end, "step": 2.0},
        output={"fields": False, "columns": list(columns)},
        cases=list(cases) or None,
    )
    return values | tables


def rest(cases: Any = (), **changes: Any) -> np.ndarray:
    """Angles inside, half-way and outside, once the cells rest; by itself of the tissue of docs/load_cases.md."""
    tables = {"time": {"end": 396.0, "step": 12.0}, "material": {"repulsion": "length"}} | changes
    row = last_row(artery(cases, columns=ANGLES, **tables))
    return np.array([row[name] for name in ANGLES])


@cache
def rest_of_the_mean() -> np.ndarray:
    """Without cases."""
    return rest()


# ---------------------------------------------------------------- cases that are none
@pytest.mark.parametrize(
    "remodeling", [*({"law": law, "coupling": coupling} for law, coupling in LAWS), *GROWING]
)
def test_one_case_is_none_to_the_last_bit(remodeling: dict[str, Any]) -> None:
    plain, one = (
        rows_of(artery(cases, end=20.0, remodeling=remodeling)) for cases in ((), [{"weight": 1.0}])
    )
    assert_close(columns(one), columns(plain), {*plain[0]} - {"seconds"}, atol=0.0, equal_nan=True)
    assert one[0].keys() == plain[0].keys()


@cache
def alone(law: str, coupling: str) -> list[dict[str, float]]:
    """Rows without cases."""
    return rows_of(artery((), remodeling={"law": law, "coupling": coupling}))


@pytest.mark.parametrize("mean", ["tensor", "target", "largest"])
@pytest.mark.parametrize("law, coupling", LAWS)
def test_two_equal_halves_are_none_to_rounding(law: str, coupling: str, mean: str) -> None:
    if mean == "target" and law != "tensor":
        pytest.skip("it has no target")
    remodeling = {"law": law, "coupling": coupling}
    plain, halves = alone(law, coupling), rows_of(
        artery(HALVES, remodeling=remodeling | {"mean": mean})
    )
    found, expected = columns(halves), columns(plain)
    assert_close(found, expected, expected.keys() - {*COUNTED}, TURNS, TURNS, equal_nan=True)
    second = {name: found[f"{name}@2"] for name in OF_EACH}
    assert_close(second, expected, OF_EACH, TURNS, TURNS)
    assert not [name for name in plain[0] if "@" in name]
    assert (
        not {"time@2", "fibre_angle_inner@2", "seconds@2", "remodeling_power@2"} & halves[0].keys()
    )


# ---------------------------------------------------------------- cases that differ
def test_against_an_independent_program() -> None:
    """Two states on one radius, solved and remodeled by a program that shares no code (law tensor, staggered)."""
    weights, factors, end, step, kappa = (2 / 3, 1 / 3), (0.7, 1.6), 60.0, 2.0, 0.025
    tube = Tube(1.0, 3.0, 12, RadialMaterial())
    radii = [tube.nodes.copy() for _ in factors]
    squares = np.full((len(tube.points), 3), 1 / 3)
    old = [(squares, 0.0, 1.0) for _ in factors]
    rows = []
    for time in np.arange(step, end + step / 2, step):
        share, stresses = min(time / 24.0, 1.0), []
        for k, factor in enumerate(factors):
            new = (squares, 4.8 * share * factor, 1 + 0.1 * share)
            radii[k], old[k] = tube.advance(radii[k], old[k], new), new
            stresses.append(cauchy_stress(tube.stretches(radii[k], new[2]), squares, tube.material))
        rows.append([value for r in radii for value in (r[0], r[-1])])
        mean = sum(weight * stress for weight, stress in zip(weights, stresses, strict=True))
        squares = structure(squares, mean, kappa * step, 1.0)
    cases = [{"weight": w, "loads": {"pressure": f}} for w, f in zip(weights, factors, strict=True)]
    with made(artery(cases, end, remodeling={"coupling": "staggered"})) as simulation:
        found = [step.row for step in simulation.steps()]
        names = ("inner_radius", "outer_radius", "inner_radius@2", "outer_radius@2")
        np.testing.assert_allclose(
            [[row[name] for name in names] for row in found], rows, rtol=5e-4
        )
        assert found[-1]["inner_radius@2"] > found[-1]["inner_radius"] + 0.05
        order = np.argsort(simulation.quadrature.coordinates[..., 0].ravel())
        cells, local = simulation.cells, simulation.cells.local_axes.axes
        radial = local[..., 0, :]
        around = np.einsum("epa,epab,epb->ep", radial, cells.structure_tensor(), radial).ravel()[
            order
        ]
        depth = simulation.quadrature.coordinates[..., 0].ravel()[order]
        expected = np.interp(depth, tube.points, squares[:, CIRCUMFERENTIAL])
        np.testing.assert_allclose(around, expected, atol=5e-3)


def test_which_case_is_first_changes_no_cell() -> None:
    first, second = pulse(0.4)
    one, two = rows_of(artery([first, second])), rows_of(artery([second, first]))
    for row, other in zip(one, two, strict=True):
        for name in (*ANGLES, "inner_radius@2", "pressure@2"):
            assert other[name.removesuffix("@2")] == pytest.approx(
                row[name], rel=TURNS, abs=TURNS, nan_ok=True
            )
    assert one[-1]["pressure@2"] == pytest.approx(1.8 * 4.8) and one[-1][
        "pressure"
    ] == pytest.approx(0.6 * 4.8)


def test_a_step_has_the_loads_of_the_case_that_a_watcher_sees() -> None:
    with made(artery(pulse(0.4))) as simulation:
        step = next(simulation.steps())
        further = simulation.stepper.load_cases[1].seen(step)
    assert further.loads["pressure"] == pytest.approx(3 * step.loads["pressure"]) != 0.0


def test_a_pulse_is_seen_as_its_mean() -> None:
    """The figures of docs/load_cases.md: a normal pulse does not count, axial excursions and the largest tension do."""
    mean = rest_of_the_mean()
    assert rest(pulse(0.1))[1] - mean[1] == pytest.approx(0.6, abs=0.3)
    assert rest(pulse(0.33))[1] - mean[1] == pytest.approx(6.1, abs=1.0)
    assert rest(pulse(0.2)) - mean == pytest.approx([0.0, 2.5, 0.5], abs=0.5)
    axial = [
        {"weight": 0.5, "loads": {"elongation": 0.0}},
        {"weight": 0.5, "loads": {"elongation": 2.0}},
    ]
    assert rest(axial)[1] - mean[1] > 6.0
    assert rest(axial, remodeling={"mean": "target"})[1] - mean[1] == pytest.approx(-14.8, abs=1.0)


def test_the_largest_tension_of_a_pulse_is_that_of_systole() -> None:
    """More pressure is more tension at every point: as if systole never ended."""
    largest = rest(pulse(0.1), remodeling={"mean": "largest"})
    assert largest == pytest.approx(rest(pressure=1.2 * 4.8), abs=1e-6)
    assert largest[1] < rest_of_the_mean()[1] - 5.0


@pytest.mark.parametrize("law, coupling", LAWS)
def test_chosen_steps_look_at_all_cases(law: str, coupling: str) -> None:
    """Equal halves take the steps of none; a pulse has an error as asked for."""
    tables = {
        "remodeling": {"law": law, "coupling": coupling},
        "time": {"end": 30.0, "step": 2.0, "tolerance": 1.0},
    }
    plain, halves = rows_of(artery((), **tables)), rows_of(artery(HALVES, **tables))
    names = ("time", "time_error", "inner_radius", *ANGLES)
    assert_close(columns(halves), columns(plain), names, 1e-8, 1e-8, equal_nan=True)
    chosen, fine = rows_of(artery(pulse(0.33), **tables)), artery(pulse(0.33), **tables)
    unloaded = [{"weight": 0.5, "loads": {"pressure": 0.0, "elongation": 0.0}}, {"weight": 0.5}]
    early = tables | {"time": tables["time"] | {"end": 14.0}}
    either = (columns_of(artery(order, **early)) for order in (unloaded, unloaded[::-1]))
    assert_close(*either, ("time", "time_error"), 1e-5)  # whichever is the first
    fine["time"] = {"end": 30.0, "step": 0.5}
    short = rows_of(fine)
    for name in ("inner_radius", "outer_radius@2", "fibre_angle_outer"):
        assert chosen[-1][name] == pytest.approx(
            short[-1][name], rel=5e-3, abs=0.5 if "angle" in name else 0.0
        ), name


def test_the_equilibrium_of_a_cycle_is_that_of_a_long_march() -> None:
    """At once: cells that belong to the mean of the stresses of all cases."""
    remodeling = {"law": "explicit", "coupling": "staggered"}
    march = last_row(artery(pulse(0.33), remodeling=remodeling, time={"end": 480.0, "step": 8.0}))
    row = last_row(artery(pulse(0.33), remodeling=remodeling, time={"end": "equilibrium"}))
    assert_close(
        row, march, (*ANGLES, "inner_radius", "inner_radius@2", "outer_radius@2"), 2e-3, 0.05
    )
    assert row["inner_radius@2"] > row["inner_radius"] + 0.02


def test_turnover_has_the_mean_rates_of_all_cases() -> None:
    """In the second row ln m is the mean of what each case alone has: the first had the same cells."""
    columns = ["content", "natural_length", "inner_radius", *ANGLES]
    tables = {"remodeling": GROWING[0], "columns": columns}
    changes = []
    for cases in (pulse(0.33), *([case | {"weight": 1.0}] for case in pulse(0.33))):
        with simulated(artery(cases, end=4.0, **tables)) as (simulation, _):
            changes.append(
                [
                    np.log(simulation.stepper.process("turnover")._values(name))
                    for name in columns[:2]
                ]
            )
    both, diastole, systole = np.array(changes)
    np.testing.assert_allclose(both, 2 / 3 * diastole + 1 / 3 * systole, atol=1e-12)
    assert np.abs(systole - diastole).max() > 1e-4


# ---------------------------------------------------------------- means of drives
def drives(turns: Rotation) -> list[Drive]:
    """Two states of three points; each deformed body turned by a rotation of its own."""
    random = np.random.default_rng(1)
    F = np.eye(3) + 0.2 * random.standard_normal((2, 3, 3, 3))
    stress = random.standard_normal((2, 3, 3, 3))
    stress = stress + np.swapaxes(stress, -1, -2)
    Q = turns.as_matrix()
    return [
        Drive(
            q @ f,
            q @ s @ q.T,
            DRIVERS["cauchy"],
            FRAMES["material"],
            1e-9,
            np.ones((3, 3)),
            1.0,
            1.0,
        )
        for q, f, s in zip(Q, F, stress, strict=True)
    ]


def test_the_mean_is_objective_and_weighted() -> None:
    """However the bodies of the cases are turned in space."""
    weights = (0.3, 0.7)
    none = Rotation.from_rotvec(np.zeros((2, 3)))
    turned = Rotation.from_rotvec([[0.3, 2.0, -1.0], [1.0, 0.2, 0.4]])
    one, two = (mean_tensor(drives(turns), weights) for turns in (none, turned))
    np.testing.assert_allclose(two.tensor, one.tensor, atol=1e-12)
    assert one.driver.material and one.driver.is_stress
    for pick in (0, 1):
        alone = mean_tensor(drives(none), np.eye(2)[pick])
        F, stress = drives(none)[pick].deformation_gradient, drives(none)[pick].tensor
        u, _, v = np.linalg.svd(F)
        R = u @ v
        np.testing.assert_allclose(alone.tensor, np.swapaxes(R, 1, 2) @ stress @ R, atol=1e-12)


def test_the_largest_tension_is_taken_point_by_point() -> None:
    states = [drive._replace(driver=DRIVERS["pk2"]) for drive in drives(Rotation.identity(2))]
    found = largest_tension(states, (0.9, 0.1)).tensor
    tops = np.array([np.linalg.eigvalsh(state.tensor)[:, -1] for state in states])
    assert {0, 1} == {*tops.argmax(axis=0)}
    for point, case in enumerate(tops.argmax(axis=0)):
        np.testing.assert_array_equal(found[point], states[case].tensor[point])


def test_the_mean_of_targets_has_their_shares() -> None:
    """One case without tension takes no part."""
    pulled = target(np.diag([1.0, 0.5, -0.1])[None], 1e-9)
    nothing = Target(np.zeros((1, 3, 3)), np.zeros(1))
    mean = mean_target([pulled, nothing], (0.25, 0.75))
    np.testing.assert_allclose(mean.direction, pulled.direction, atol=1e-15)
    assert mean.switch == pytest.approx(0.25 * pulled.switch)


# ---------------------------------------------------------------- runs
def test_a_run_goes_on_with_all_cases(tmp_path: Path) -> None:
    found = goes_on(artery(pulse(0.4), 20.0), tmp_path, 10.0)
    page = write_report(tmp_path / "whole").read_text()
    rows = dict(re.findall(r"<tr><th>(Load case [^<]*)</th><td>([^<]*)</td>", page))
    assert [rows[f"Load case {number}"] for number in (1, 2)] == [
        "weight 0.666667",
        "weight 0.333333",
    ]
    assert [rows[f"Load case {number} loads"] for number in (1, 2)] == [
        "pressure 0.6",
        "pressure 1.8",
    ]
    assert "inner_radius@2" in found.history
    with pytest.raises(SceneError):
        resume(found.path, ["cases=[]"])


def test_a_case_that_is_not_solved_takes_the_step_back() -> None:
    """In all cases; the message names it."""
    values = artery(
        [{"weight": 0.9}, {"weight": 0.1, "loads": {"elongation": 40.0}}],
        remodeling={"law": "none", "coupling": "staggered"},
    )
    with made(values | {"solver": {"maximum_halvings": 1}}) as simulation:
        states, before = list(simulation.state.each_case().values()), []
        with pytest.raises(StepFailure, match="load case 2"):
            for step in simulation.steps():
                before = [
                    (state.unknown.x.array.copy(), dict(state.loading.values), state.time)
                    for state in states
                ]
    for state, (unknown, loads, time) in zip(states, before, strict=True):
        np.testing.assert_array_equal(state.unknown.x.array, unknown)
        assert (state.loading.values, state.time) == (loads, time)
    assert before[0][1] != before[1][1] and before[0][2] > 0


def test_what_threatens_one_case_is_said_of_it(caplog: pytest.LogCaptureFixture) -> None:
    """A case of shortening, in which the whole tube would buckle; in the first it is pulled."""
    thin = {"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.1, "length": 40.0}
    cases = [{"weight": 0.5}, {"weight": 0.5, "loads": {"elongation": -1.0}}]
    rows_of(artery(cases, end=24.0, pressure=0.03, geometry=thin, mesh={"degree": 2}))
    found = [line for line in caplog.messages if "expected buckling" in line]
    assert len(found) == 1 and ", load case 2: expected buckling" in found[0]


# ---------------------------------------------------------------- refusals


def test_studies_of_one_load_case_refuse_several(tmp_path: Path) -> None:
    """Their derivatives are those of a single state."""
    scene = scene_from_dict(artery(HALVES))
    for study in (
        lambda: fit(scene, tmp_path / "data.toml"),
        lambda: stability(scene, tmp_path / "run"),
    ):
        with pytest.raises(SceneError, match="^cases: "):
            study()
    assert not list(tmp_path.iterdir())
    with pytest.raises(SceneError, match="coupling"):
        Simulation(scene, coupling=Staggered)
