"""What a solve ends with: its work, or the reason why it has failed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from remodel_fenicsx.solver.equilibrium import Extension

FAR = 2.0
"""`Solution.reach` from which on a way is looked at again in parts. The paper's bodies have at most 1.25, a tube
without chains that comes near its largest pressure in one step 2.9, a jump over a limit point 3.9 and more."""

NEAR, MANY = 0.5, 12  # chains near their contour length make ends nearer too, but within 11 iterations


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
    reach: float = 0.0
    """Distance of the solution from the start over the length of the first Newton step; 0 where it is too short to
    matter."""

    @property
    def is_far(self) -> bool:
        """Whether it may lie on another branch: much farther than the tangent at the start points, or much nearer after
        many iterations, as from a start at which the tangent is almost singular."""
        return self.reach > FAR or (0.0 < self.reach < NEAR and self.newton_iterations > MANY)

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

    def count(self, earlier: SolveFailure | Solution) -> None:
        """With the work of a solve before."""
        self.newton_iterations += earlier.newton_iterations
        self.linear_iterations += earlier.linear_iterations
        self.tangents += earlier.tangents


# by PETSc's SNESConvergedReason; numbers, for the names differ between its versions
FAILURES = {
    -3: "the linear solver failed",
    -4: "forces or parameters are too large or too small for floating-point numbers",
    -6: "the line search found no better state",
    -9: "the residual grew beyond all bounds",
}
MOST_ITERATIONS = -5


def failure_text(reason: int, iterations: int, extension: Extension) -> str:
    """Why SNES has ended; where it did not fail itself, the state is not admissible."""
    if reason >= 0:
        return f"reached r/L = {extension.max_chain_extension:.4f}, J = {extension.min_jacobian:.4g}"
    if reason == MOST_ITERATIONS:
        return f"no equilibrium within {iterations} Newton iterations"
    return FAILURES.get(reason, f"SNES stopped with reason {reason}")
