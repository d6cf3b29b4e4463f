"""Turnover against balances of energy and mass, and against its differential equations at a held stretch."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from remodel_fenicsx import Simulation
from remodel_fenicsx.evolution.stepper import Step, Watcher
from remodel_fenicsx.model.laws import TURNOVER_RATES, TurnoverRule
from tests.evolution.test_turnover_bodies import TURNOVER, grown
from tests.runs import columns, made, simulated
from tests.values import isotropic, ramped

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
        content, natural = TurnoverRule(
            TURNOVER["time"], 1.1, 1.0, TURNOVER_RATES["tension"]
        ).at_length(tissue, length)

        def energy(time: float) -> np.ndarray:
            m, rho = tissue.content * np.exp(time * content), tissue.natural_length * np.exp(
                time * natural
            )
            return np.asarray(
                replace(tissue, content=m, natural_length=rho).strain_energy(F, cells)
            )

        h, integral = 1e-4, simulation.quadrature.integral
        values = {
            "turnover": (energy(-h) - energy(h)) / (2 * h),
            "production": tissue.content * content,
        }
        shape = simulation.quadrature.shape
        row = {name: float(integral(value.reshape(shape))) for name, value in values.items()}
        self.rows.append(
            {"time": step.time, "content_integral": integral(tissue.content.reshape(shape)), **row}
        )


@cache
def balances(step: float, coupling: str) -> dict[str, float]:
    """Sums of powers over a time in which no load changes, by the trapezoidal rule; what the body has at its ends."""
    remodeling = {"turnover": TURNOVER, "coupling": coupling, "kappa": KAPPA}
    names = ["content", "inner_radius", "stored_energy", "remodeling_power", "turnover_power"]
    of = grown(
        time={"end": 24.0, "step": step},
        output={"fields": False, "columns": names},
        remodeling=remodeling,
    )
    with made(of) as simulation:
        powers = Powers(simulation)
        rows = [dict(each.row) for each in simulation.steps([powers])]
    table = columns(rows) | columns(powers.rows)
    np.testing.assert_allclose(table["turnover_power"], table["turnover"], rtol=1e-5, atol=1e-6)
    held = table["time"] >= HELD
    table = {name: values[held] for name, values in table.items()}
    decay = (
        KAPPA * step
    )  # a pass makes (1 - exp(-kappa dt)) of the way to its target: its rate is that at its start
    cells = table["remodeling_power"] * decay / (1 - np.exp(-decay))
    lumen = np.pi * table["inner_radius"] ** 2 * 2.0 * 1.1
    found = {name: np.trapezoid(table[name], table["time"]) for name in ("turnover", "production")}
    found["cells"] = np.trapezoid(cells, table["time"])
    ends = {
        "energy": table["stored_energy"],
        "work": 1.2 * lumen,
        "content": table["content_integral"],
    }
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


# ---------------------------------------------------------------- a held stretch
def held_stretch(
    force: float, step: float, coupling: str = "staggered"
) -> tuple[float, list[dict[str, float]]]:
    """r/r0 of isotropic cells that do not turn, in a matrix so stiff that chains leave it as it is; rows."""
    values = isotropic(
        None, "point", geometry={"shape": "cube"}, loads=ramped(step, force=force * 1e8),
        material={"lame_lambda": 1e8, "lame_mu": 1e8, "chain_density": 1e20, "repulsion": "log"},
        remodeling={"law": "tensor", "kappa": 0.0, "coupling": coupling, "turnover": TURNOVER},
        time={"end": 20.0 + step, "step": step}, output={"columns": ["content", "natural_length"]},
    )  # fmt: skip
    with simulated(values) as (simulation, rows):
        F = simulation.state.deformation_gradient()[0]
    return float(np.sqrt((F**2).sum() / 3)), rows


@pytest.mark.parametrize("force", [1.2, 0.2], ids=["long chains", "short chains"])
def test_a_held_stretch_turns_over_as_its_differential_equations(force: float) -> None:
    """ln m and ln rho of a single point, integrated by scipy; of first order in the step."""
    T, k, deposited, L = TURNOVER["time"], TURNOVER["gain"], TURNOVER["deposition_stretch"], 1.594

    def tension(stretch: float) -> float:
        return 1 / (1 - stretch / L) ** 2 / 4 - 1 / 4 + stretch / L  # of a wormlike chain, r0 = 1

    def equation(_: float, y: np.ndarray) -> list[float]:
        stretch = chains / np.exp(y[1])
        growth = k / T * min(max(tension(stretch) / tension(deposited) - 1, -1), 1)
        return [growth, (1 / T + max(growth, 0)) * (stretch / deposited - 1)]

    errors = []
    for step in (1.0, 0.5):
        chains, rows = held_stretch(force, step)
        # the rates of a row change the next one
        expected = np.exp(
            solve_ivp(equation, (0, 20.0), [0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]
        )
        found = np.array([rows[-1][name] for name in ("content", "natural_length")])
        errors.append(np.abs(found - expected))
    assert np.all(np.abs(expected - 1) > 0.02)
    np.testing.assert_allclose(errors[0] / errors[1], 2.0, atol=0.25)
    assert np.all(errors[1] < 0.01)
