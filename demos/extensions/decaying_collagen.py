"""Collagen that is lost at a constant rate and not replaced: something else that remodels, in one file.

    remodel-fenicsx run demos/cube.toml --with demos/extensions/decaying_collagen.py --set remodeling.decay.rate=0.01

The content m of the chains, relative to the start, follows dm/dt = -rate m at every point.
"""

from __future__ import annotations

import math
from dataclasses import replace

from pydantic import Field

from remodel_fenicsx import SceneError
from remodel_fenicsx.extend import REMODELS, Remodels, RemodelsKind, Table


class Decay(Table):
    """Collagen that is lost."""

    rate: float = Field(default=0.0, ge=0)
    """Rate of the loss, in 1/time. With 0 nothing is lost."""

    @property
    def is_on(self) -> bool:
        """Whether anything is lost."""
        return self.rate > 0


class DecayingContent(Remodels):
    """Content of the chains, which decays at a constant rate."""

    name, changes = "decay", True

    def __init__(self, state, tissue, remodeling):
        if tissue.content is not None:
            raise SceneError(
                f"remodeling.decay.rate = {remodeling.decay.rate}: must be 0 with remodeling.turnover"
            )
        self.state, self.slowest, self.fastest = state, remodeling.decay.rate, remodeling.decay.rate
        self.content = state.cells.quadrature.function("decaying_content", ())
        self.content.x.array[:] = self.last = self.next = 1.0
        state.remember(self.content)
        self.tissue = replace(tissue, content=self.content)

    def before(self, time, order):
        """Set the content at the end of the step."""
        self.last, self.next = (
            math.exp(-self.fastest * moment) for moment in (self.state.time, time)
        )
        self.set_fraction(1.0)

    def set_fraction(self, fraction):
        """Apply a fraction of the loss of the step."""
        self.content.x.array[:] = self.last + fraction * (self.next - self.last)

    def remaining_change(self, time, residual):
        """Return the relative loss that remains up to a time."""
        return 1.0 - math.exp(-self.fastest * (time - self.state.time))

    def steady_state_problem(self, waiting):
        """Return why the loss reaches no steady state."""
        return "collagen is lost at a constant rate: set time.end to a late time to follow the loss"


REMODELS["decay"] = RemodelsKind(Decay, DecayingContent)
