"""Whether other starts lead to another equilibrium of the cells."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.loading import LoadValues
from remodel_fenicsx.evolution.homeostasis import Homeostasis
from remodel_fenicsx.evolution.parts import StepFailure
from remodel_fenicsx.evolution.state import State
from remodel_fenicsx.fem import coefficients
from remodel_fenicsx.system.terminal import NOTICE
from remodel_fenicsx.tissue.cells import structure_tensor

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

SAME = 1e-6  # of r0^2: states whose structure tensors differ by less are one
SEED = 1


@dataclass(frozen=True)
class Other:
    """Where another start has led.

    Attributes
    ----------
    start
        Its name.
    distance
        Largest norm of the difference of A over all points, over r0^2; NaN where nothing was found.
    failure
        Why nothing was found, or empty.
    """

    start: str
    distance: float
    failure: str = ""

    def __str__(self) -> str:
        if self.failure:
            return f"from {self.start} cells no equilibrium was found: {self.failure}"
        if self.distance <= SAME:
            return f"from {self.start} cells to the same equilibrium (A within {self.distance:.1g} r0^2)"
        return f"from {self.start} cells to another equilibrium: A differs by up to {self.distance:.2g} r0^2"


def _isotropic(state: State, found: Array, r0: Array) -> Array:
    return np.broadcast_to(r0[..., None] / np.sqrt(3.0), found.shape)


def _exchanged(state: State, found: Array, r0: Array) -> Array:
    """The lengths that were found, each on the next axis: fibres where there are none, none where they are."""
    return np.roll(found, 1, axis=-1)


def _random(state: State, found: Array, r0: Array) -> Array:
    """Others in each element, by its number: the same on any number of ranks."""
    domain = state.loading.domain
    drawn = np.abs(np.random.default_rng(SEED).standard_normal((domain.number_of_elements, 3)))
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    return np.asarray(r0[..., None] * drawn[domain.element_number][:, None, :])


STARTS: dict[str, Callable[[State, Array, Array], Array]] = {
    "isotropic": _isotropic,
    "exchanged": _exchanged,
    "random": _random,
}
"""Lengths (elements, points, 3) on the axes of the state that was found, from the state, its lengths and r0."""


def other_starts(coupling: Homeostasis, loads: LoadValues) -> Iterator[Other]:
    """Go to the equilibrium from other cells, by passes; the state is the found one again afterwards.

    Parameters
    ----------
    coupling
        Its state is the equilibrium that was found.
    loads
        Those at the end.
    """
    state, quadrature = coupling.state, coupling.state.cells.quadrature
    found, cells = state.snapshot(), state.cells
    lengths, axes = cells.dimension_values.copy(), cells.axis_values.copy()
    r0 = coefficients.point_values(coupling.equilibrium.tissue.end_to_end_length, quadrature)
    structure = structure_tensor(lengths, axes)
    unloaded: dict[str, Any] = {name: 0.0 for name in found.loads}
    still = {**found.arrays, state.unknown.name: np.zeros_like(found.arrays[state.unknown.name])}
    try:
        coupling.only_passes = True
        for name, start in STARTS.items():
            state.restore(replace(found, arrays=still, loads=unloaded, time=0.0, number=0))
            cells.set(start(state, lengths, r0), axes)
            state.settle_cells()
            try:
                coupling.solve(found.time, loads)
            except StepFailure as failure:
                yield Other(name, np.nan, str(failure))
                continue
            distance = np.linalg.norm(cells.structure_tensor() - structure, axis=(-1, -2)) / r0**2
            yield Other(name, quadrature.maximum(distance))
    finally:
        coupling.only_passes = False
        state.restore(found)


def check_uniqueness(coupling: Homeostasis, loads: LoadValues) -> list[Other]:
    """`other_starts`, each said in log and terminal: as a warning where it does not lead to the same equilibrium."""
    found = []
    for other in other_starts(coupling, loads):
        if coupling.state.comm.rank == 0:
            log.log(NOTICE if other.distance <= SAME else logging.WARNING, "uniqueness: %s", other)
        found.append(other)
    return found
