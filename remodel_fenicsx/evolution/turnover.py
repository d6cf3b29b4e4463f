"""Turnover over a step: content and natural length of the collagen at all points of a state."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.energy import TURNED_OVER, Tissue
from remodel_fenicsx.model.turnover import TurnoverRates, rates
from remodel_fenicsx.settings import Turnover
from remodel_fenicsx.state.memory import Numbers
from remodel_fenicsx.state.parameters import Parameters, on_mesh
from remodel_fenicsx.state.state import State

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

LARGEST_TURNOVER = 0.5  # largest |change of ln rho| in a step: the prototype's; it does not act at rest
BEYOND_REST = 10.0  # factor of content or natural length from which on growth is hardly meant


def turned_over(tissue: Tissue, state: State) -> Tissue:
    """The tissue with content and natural length as functions of the state, 1 at the start."""
    made = {name: state.cells.quadrature.function(name, ()) for name in TURNED_OVER}
    for function in made.values():
        function.x.array[:] = 1.0
        state.remember(function)
    return replace(tissue, **made)


class TurnoverPass:
    """Changes content and natural length with the lengths of the solved state.

    Parameters
    ----------
    state
        Unknowns and the cells in equilibrium with them.
    tissue
        Of `turned_over`.
    settings
        Time, stretch of deposition and gain.
    """

    def __init__(self, state: State, tissue: Tissue, settings: Turnover):
        self.state, self.settings, self.quadrature = state, settings, state.cells.quadrature
        self.tissue = on_mesh(tissue, self.quadrature.mesh)
        self._parameters = Parameters(self.tissue, self.quadrature)
        self._numbers = Numbers(state, "turnover", {"said": 0})
        self.weights: Sequence[float] = (1.0,)  # of the load cases, that of `state` first

    def apply(self, duration: float) -> None:
        """A step with the rates of the solved state: m and rho change by exp(rate * duration).

        With several load cases: with the weighted mean of the rates in each.
        """
        parts = [self._rates(state) for state in (self.state, *self.state.others)]
        found = TurnoverRates(*(sum(w * values for w, values in zip(self.weights, part)) for part in zip(*parts)))
        changes = found.content * duration, np.clip(
            found.natural_length * duration, -LARGEST_TURNOVER, LARGEST_TURNOVER
        )
        for name, change in zip(TURNED_OVER, changes, strict=True):
            getattr(self.tissue, name).x.array[:] *= np.exp(change)
        self._warn()

    def _rates(self, state: State) -> TurnoverRates:
        """In one load case."""
        cells = state.equilibrium_cells
        squared = cells.kernels.squared_length(state.elastic_gradient(), cells.point_cells)
        given = self.settings.time or np.inf, self.settings.deposition_stretch, self.settings.gain
        return rates(self._parameters.at_points(), np.sqrt(squared), *given)

    def mean(self, name: str) -> float:
        """Volume mean of `content` or `natural_length`."""
        return float(self.quadrature.mean(self._values(name)))

    def _values(self, name: str) -> Array:
        values: Array = self.quadrature.values(getattr(self.tissue, name), ())
        return values

    def _warn(self) -> None:
        if self._numbers["said"]:
            return
        for name in TURNED_OVER:
            factor = np.exp(np.abs(np.log(self._values(name))))
            largest = self.quadrature.maximum(factor)
            if largest <= BEYOND_REST:
                continue
            self._numbers["said"] = 1
            place = ", ".join(f"{c:.3f}" for c in self.quadrature.place_of_largest(factor))
            if self.state.comm.rank == 0:
                log.warning(
                    "turnover: %s has changed by more than a factor of %g at (%s) in the step after time %g: growth "
                    "does not come to rest (mechanobiological instability, docs/turnover.md); try a larger "
                    "remodeling.turnover.gain or a thicker wall",
                    name.replace("_", " "),
                    BEYOND_REST,
                    place,
                    self.state.time,
                )
            return
