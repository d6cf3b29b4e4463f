"""What a solve ends with: its work, or the reason why it has failed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from remodel_fenicsx.evolution.equilibrium import Extension


@dataclass(frozen=True)
class Solution:
    """Work of a solve."""

    newton_iterations: int
    linear_iterations: int
    residual: float = 0.0
    """Norm of the out-of-balance nodal forces that was accepted."""
    tangents: int = 0
    """How many were assembled."""
    extension: Extension | None = None
    """Of the solution."""

    def after(self, failure: SolveFailure) -> Solution:
        """With the work of an attempt that had failed before."""
        newton = self.newton_iterations + failure.newton_iterations
        linear = self.linear_iterations + failure.linear_iterations
        return replace(
            self, newton_iterations=newton, linear_iterations=linear, tangents=self.tangents + failure.tangents
        )


class SolveFailure(RuntimeError):
    """SNES did not find an admissible equilibrium; the unknowns before the call are restored."""

    def __init__(
        self,
        reason: str,
        newton_iterations: int,
        linear_iterations: int,
        extension: Extension,
        residual_over_tolerance: float = np.inf,
        tangents: int = 0,
        relative_residual: float = np.inf,
    ):
        super().__init__(reason)
        self.relative_residual = relative_residual
        self.tangents = tangents
        self.residual_over_tolerance = residual_over_tolerance
        self.reason = reason
        self.newton_iterations = newton_iterations
        self.linear_iterations = linear_iterations
        self.extension = extension
