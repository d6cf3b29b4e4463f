"""Whether the chains lie in the wall, where the fibre angle is measured."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.state.memory import Numbers
from remodel_fenicsx.system.terminal import NOTICE

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

MOST = 0.5  # of the chains


class RadialChains(Watcher):
    """Says once that more than half of the chains point out of the wall: the columns' angles are those of the others.

    A notice and no warning: the results are right, they have to be read otherwise.

    Parameters
    ----------
    stepper
        Whose solved states are looked at.
    radial_share
        Of dimensions, axes and places, as `Shape.radial_share`.
    """

    def __init__(self, stepper: Stepper, radial_share: Callable[[Array, Array, Array], Array]):
        self.state, self.radial_share = stepper.state, radial_share
        self._numbers = Numbers(stepper.state, "radial_chains", {"share": 0.0, "said": 0})

    def solved(self, step: Step) -> None:
        """Measure, until it was said."""
        if not self._numbers["said"]:
            cells, quadrature = self.state.cells, self.state.cells.quadrature
            share = self.radial_share(cells.dimension_values, cells.axis_values, quadrature.coordinates)
            self._numbers["share"] = quadrature.mean(share)

    def committed(self, step: Step) -> None:
        """Say it."""
        if self._numbers["said"] or self._numbers["share"] <= MOST:
            return
        self._numbers["said"] = True
        if self.state.comm.rank == 0:
            log.log(
                NOTICE,
                "time %g: more than half of the chains point out of the wall (radial_share %.2g); the fibre angles are "
                "those of the others",
                step.time,
                self._numbers["share"],
            )
