"""Regions of kappa k1, k2 and 0 are, point by point, bodies of k1, k2 and none: every law with every coupling.

A network of next to no stiffness: the deformation is that of the matrix alone, whatever the cells do.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Scene
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.schema.settings import COUPLINGS
from remodel_fenicsx.simulation import Simulation
from tests.runs import made, simulated
from tests.values import ramp_to

PAIRS = [
    (law, coupling)
    for law, kind in LAWS.items()
    for coupling in ("staggered", "relaxed", "extrapolated")
    if kind.stops_at_zero_kappa
    and (kind.target is not None or not COUPLINGS[coupling].needs_a_target)
]
FIRST, SECOND = 0.08, 0.02
LAYERS: dict[str, Any] = {
    "intima": {"outer_radius": 1.7},
    "media": {"outer_radius": 2.4},
    "adventitia": {},
}
RAMP = [[0.0, 0.0], [2.0, 1.0], [5.0, 0.5]]


def scene(kappas: tuple[float, float, float], law: str, coupling: str, **changes: Any) -> Scene:
    """A tube of three layers on one radius; loads that turn the cells, and fall."""
    regions = [
        {"remodeling": {"kappa": kappa}} | layer
        for kappa, layer in zip(kappas, LAYERS.values(), strict=True)
    ]
    made = Scene(
        geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 1.0},
        regions=dict(zip(LAYERS, regions)), material={"chain_density": 1e10},
        cells={"initial": [0.5, 0.7, 0.26**0.5]}, model={"kinematics": "radial"},
        loads={"pressure": {"value": 1.0, "ramp": RAMP}, "elongation": {"value": 0.1, "ramp": RAMP}},
        remodeling={"law": law, "coupling": coupling}, time={"end": 5.0}, output={"columns": ["time_error"]},
    )  # fmt: skip
    return made.with_values(changes)


@lru_cache
def solved(
    *arguments: Any, changes: tuple[tuple[str, Any], ...] = ()
) -> tuple[np.ndarray, np.ndarray, Simulation]:
    """A at all points of the last row, (elements, points, 3, 3); which elements are of which layer; the simulation."""
    with simulated(scene(*arguments, **dict(changes))) as (simulation, _):
        domain = simulation.domain
        cells = simulation.state.equilibrium_cells
        layers = np.array([domain.element_region == domain.regions[name] for name in LAYERS])
        return cells.structure_tensor(), layers, simulation


def one_better(simulation: Simulation) -> np.ndarray:
    """A of the cells with which the last row is compared; zero of a law without errors in time."""
    better, shape = simulation.stepper.coupling.higher_order_cells, simulation.quadrature.shape
    return (
        np.zeros((*shape, 3, 3))
        if better is None
        else structure_tensor(*better[:2]).reshape(*shape, 3, 3)
    )


@pytest.mark.parametrize("law, coupling", PAIRS)
def test_each_region_has_its_own_kappa(law: str, coupling: str) -> None:
    """Without kappa cells stay, axes included, as under the law `none`."""
    all_three, layers, simulation = solved((FIRST, SECOND, 0.0), law, coupling)
    better, alone = one_better(simulation), [
        solved((kappa,) * 3, law, coupling) for kappa in (FIRST, SECOND)
    ]
    for layer, (found, _, one) in zip(layers, alone):
        np.testing.assert_allclose(all_three[layer], found[layer], rtol=0, atol=1e-8)
        np.testing.assert_allclose(better[layer], one_better(one)[layer], rtol=0, atol=1e-8)
        assert np.abs(alone[0][0] - alone[1][0])[layer].max() > 0.03
    stays, before = layers[2], solved((FIRST, SECOND, 0.0), "none", "staggered")[0]
    np.testing.assert_allclose(all_three[stays], before[stays], rtol=0, atol=1e-12)
    lengths = np.sort(simulation.state.cells.dimension_values[stays])
    np.testing.assert_allclose(
        lengths, np.broadcast_to([0.5, 0.26**0.5, 0.7], lengths.shape), rtol=0, atol=1e-12
    )
    remodeling = simulation.stepper.remodeling
    assert (remodeling.fastest, remodeling.slowest) == (FIRST, SECOND)  # who stays is no slower one


def test_chosen_steps_hold_the_error_of_both_regions() -> None:
    """With a tolerance: both layers together are as near to short steps as it asks."""
    both, _, simulation = solved(
        (0.4, SECOND, SECOND), "tensor", "extrapolated", changes=(("time.tolerance", 0.5),)
    )
    fine, _, _ = solved(
        (0.4, SECOND, SECOND), "tensor", "extrapolated", changes=(("time.step", 0.05),)
    )
    remodeling = simulation.stepper.remodeling
    assert (remodeling.fastest, remodeling.slowest) == (0.4, SECOND)
    difference = np.sqrt(np.mean(np.sum((both - fine) ** 2, axis=(-1, -2))))
    assert np.degrees(difference) < 0.5 and simulation.state.number < 100


def test_no_step_is_longer_than_the_fastest_region_allows() -> None:
    """kappa dt of an explicit rule, wherever it is largest."""
    held = {"time.tolerance": 40.0, "time.end": 30.0}
    with made(scene((0.4, SECOND, SECOND), "tensor", "extrapolated", **held)) as chosen:
        lengths = np.diff([0.0, *(step.time for step in chosen.steps())])
        longest = chosen.stepper.coupling.traits.max_scaled_step / 0.4
    assert 0.5 * longest < lengths.max() <= longest * (1 + 1e-9)


def test_the_equilibrium_waits_for_the_slowest_region() -> None:
    """At once from two kappas, or from one: the same rest, which depends on no kappa."""
    changes = (("time.end", "equilibrium"), ("output.columns", []), ("cells.initial", "isotropic"))
    changes += tuple((f"loads.{load}.ramp", ramp_to(2.0)) for load in ("pressure", "elongation"))
    both, _, simulation = solved(
        (FIRST, FIRST / 50, FIRST / 50), "tensor", "staggered", changes=_hashable(changes)
    )
    same, _, _ = solved((FIRST,) * 3, "tensor", "staggered", changes=_hashable(changes))
    np.testing.assert_allclose(both, same, rtol=0, atol=2e-3)
    assert simulation.scene.last_time == pytest.approx(2.0 + 1000.0 / (FIRST / 50))


def _hashable(changes: Any) -> tuple[tuple[str, Any], ...]:
    return tuple(
        (key, tuple(map(tuple, value)) if isinstance(value, list) else value)
        for key, value in changes
    )


def test_a_body_whose_law_never_changes_cells_takes_any_kappa() -> None:
    before, _, simulation = solved((FIRST, SECOND, 0.0), "none", "staggered")
    assert not simulation.stepper.remodeling.law.remodels and np.ptp(before, axis=0).max() < 1e-12
