"""Turnover against balances of energy and mass."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from remodel_fenicsx import Simulation
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.model.laws import TURNOVER_RATES, TurnoverRule
from tests.evolution.test_turnover_bodies import TURNOVER, grown
from tests.runs import made

KAPPA = 0.1
HELD = 8.0  # from here on no load changes


# ---------------------------------------------------------------- balances
class Powers(Watcher):
    """At each solved state: what turnover releases at frozen F and cells, by differences of W, and what it makes."""

    def __init__(self, simulation: Simulation):
        self.simulation, self.rows = simulation, list[dict[str, float]]()

    def solved(self, step: Step) -> None:
        """Energy and content, by points."""
        simulation, state = self.simulation, self.simulation.state
        tissue, F = simulation.stepper.remodeling.parameters.at_points(), state.elastic_gradient()
        cells = [simulation.cells.point_cells]
        length = np.sqrt(simulation.cells.kernels.squared_length(F, cells[0]))
        content, natural = TurnoverRule(TURNOVER["time"], 1.1, 1.0, TURNOVER_RATES["tension"]).at_length(tissue, length)

        def energy(time: float) -> np.ndarray:
            m, rho = tissue.content * np.exp(time * content), tissue.natural_length * np.exp(time * natural)
            return np.asarray(replace(tissue, content=m, natural_length=rho).strain_energy(F, cells))

        h, integral = 1e-4, simulation.quadrature.integral
        values = {"turnover": (energy(-h) - energy(h)) / (2 * h), "production": tissue.content * content}
        shape = simulation.quadrature.shape
        row = {name: float(integral(value.reshape(shape))) for name, value in values.items()}
        self.rows.append({"time": step.time, "content_integral": integral(tissue.content.reshape(shape)), **row})


@cache
def balances(step: float, coupling: str) -> dict[str, float]:
    """Sums of powers over a time in which no load changes, by the trapezoidal rule; what the body has at its ends."""
    remodeling = {"turnover": TURNOVER, "coupling": coupling, "kappa": KAPPA}
    names = ["content", "inner_radius", "stored_energy", "remodeling_power", "turnover_power"]
    of = grown(time={"end": 24.0, "step": step}, output={"fields": False, "columns": names}, remodeling=remodeling)
    with made(of) as simulation:
        powers = Powers(simulation)
        rows = [dict(each.row) for each in simulation.steps([powers])]
    table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    table |= {name: np.array([row[name] for row in powers.rows]) for name in powers.rows[0]}
    np.testing.assert_allclose(table["turnover_power"], table["turnover"], rtol=1e-5, atol=1e-6)
    held = table["time"] >= HELD
    table = {name: values[held] for name, values in table.items()}
    decay = KAPPA * step  # a pass makes (1 - exp(-kappa dt)) of the way to its target: its rate is that at its start
    cells = table["remodeling_power"] * decay / (1 - np.exp(-decay))
    lumen = np.pi * table["inner_radius"] ** 2 * 2.0 * 1.1
    found = {name: np.trapezoid(table[name], table["time"]) for name in ("turnover", "production")}
    found["cells"] = np.trapezoid(cells, table["time"])
    ends = {"energy": table["stored_energy"], "work": 1.2 * lumen, "content": table["content_integral"]}
    found |= {name: values[-1] - values[0] for name, values in ends.items()}
    return {name: float(value) for name, value in found.items()}


def test_energy_is_neither_made_nor_lost() -> None:
    """Change of the stored energy = work of the pressure - what cells release - what turnover releases.

    What is left is of first order in the step.
    """
    left = []
    for step in (1.0, 0.5):
        found = balances(step, "staggered")
        assert min(abs(found[name]) for name in ("energy", "work", "cells", "turnover")) > 0.3
        left.append(found["energy"] - found["work"] + found["cells"] + found["turnover"])
    assert left[0] / left[1] == pytest.approx(2.0, abs=0.3)
    assert abs(2 * left[1] - left[0]) < 0.01


@pytest.mark.parametrize(("coupling", "order"), [("staggered", 1), ("extrapolated", 2)])
def test_collagen_is_neither_made_nor_lost(coupling: str, order: int) -> None:
    """The integral of m changes by that of its net production; what is left is of the coupling's order in the step."""
    left = []
    for step in (1.0, 0.5):
        found = balances(step, coupling)
        left.append(found["content"] - found["production"])
    assert left[0] / left[1] == pytest.approx(2.0**order, rel=0.1)
    assert abs(2**order * left[1] - left[0]) < 4e-3 * found["content"] and found["content"] > 2.0
