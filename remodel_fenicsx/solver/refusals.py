"""Why there is no further step: kinds of refusals, each with its own advice, told apart at the last solved state."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.solver.inertia import FactorisationFailed, Inertia, of_the_unloaded_body
from remodel_fenicsx.solver.newton import GuardedNewton, SolveFailure

log = logging.getLogger(__name__)

NEARLY_LOCKED = 0.98  # r/L, where a prescribed motion makes chains longer
LOCKED = 0.999  # r/L under any load
CRUSHED = 0.02  # J
NEARLY_CRITICAL = 0.1  # lowest eigenvalue over its unloaded value
ALONG_THE_MODE = 0.5  # cosine between the last change of the displacement and the mode
NEARLY_SOLVED = 1e3  # residual over tolerance
LOOSEST = 1e-4  # residual over the forces at the nodes that is worth going on with


@dataclass(frozen=True)
class Refusal:
    """Why there is no further step.

    Attributes
    ----------
    kind
        What it is called; empty where no cause is seen.
    advice
        What helps against it.
    finding
        By what it was recognised in this case.
    """

    kind: str
    advice: str
    finding: str = ""

    def __str__(self) -> str:
        if not self.kind:
            return self.advice
        return f"{self.kind} ({self.finding}): {self.advice}" if self.finding else f"{self.kind}: {self.advice}"


TOO_LARGE = Refusal("", "try a smaller time.step, a slower ramp or lower loads")
LIMIT_POINT = Refusal(
    "limit point",
    "the load approaches the largest that the body can carry, and the displacement grows without bound; lower the "
    "load, or prescribe a displacement in its place",
)
BIFURCATION = Refusal(
    "bifurcation",
    "the body buckles or loses its symmetry; lower the load, hold the body by supports, "
    'or stop before it with solver.unstable = "stop"',
)
CHAIN_LOCKING = Refusal(
    "chain locking",
    "chains cannot become longer than material.contour_length; prescribe less elongation, or load more slowly",
)
KINEMATIC_LOCKING = Refusal(
    "kinematic locking",
    "supports and loads leave elements without volume; prescribe a smaller motion, or refine the mesh",
)
SOLVER_TOLERANCE = Refusal(
    "solver tolerance",
    "the residual does not fall below the tolerance; try a larger solver.maximum_iterations, or a smaller time.step",
)
SEVERAL_SOLUTIONS = Refusal(
    "several solutions", "this solution does not continue the last one; try a slower ramp, or lower loads"
)
UNSTABLE = Refusal("lost stability", 'lower the load, or go on beyond it with solver.unstable = "warn"')


def diagnosed(
    newton: GuardedNewton, failure: SolveFailure | None, direction: NDArray[np.float64] | None = None
) -> Refusal:
    """The kind of refusal, from the present state: the last one that was solved.

    Parameters
    ----------
    newton
        What could not solve further; loads and cells of its equilibrium are those of the present unknowns.
    failure
        How the smallest part failed; None if it was solved, but far from here.
    direction
        Change of the unknowns over the last part that was solved, where there was one.
    """
    extension = newton.equilibrium.extension()
    if not extension.admissible:
        return TOO_LARGE
    longest, prescribed = extension.max_chain_extension, newton.equilibrium.prescribed_values()
    moved = newton.equilibrium.comm.allreduce(bool(np.any(np.nan_to_num(prescribed))), MPI.LOR)
    if longest > (NEARLY_LOCKED if moved else LOCKED):
        place = ", ".join(f"{c:.4g}" for c in extension.worst_point)
        return replace(CHAIN_LOCKING, finding=f"r/L = {longest:.6g} at ({place}) in the last state that was solved")
    if extension.min_jacobian < CRUSHED:
        return replace(KINEMATIC_LOCKING, finding=f"J = {extension.min_jacobian:.3g} in the last state that was solved")
    inertia = Inertia(newton.equilibrium)
    try:
        found = _of_the_tangent(inertia, direction)
        # beyond a limit point a residual may come near the tolerance too, at a state far away
        if failure is None or found.kind == LIMIT_POINT.kind:
            return found
        return _of_the_tolerance(failure) or found
    except FactorisationFailed as reason:
        log.info("why the step was not solved could not be found out: %s", reason)
        return TOO_LARGE
    finally:
        inertia.close()


def _of_the_tolerance(failure: SolveFailure) -> Refusal | None:
    """Where not much is left of the residual."""
    if not 1.0 < failure.residual_over_tolerance < NEARLY_SOLVED:
        return None
    found = replace(SOLVER_TOLERANCE, finding=f"{failure.residual_over_tolerance:.3g} times the tolerance is left")
    if failure.relative_residual > LOOSEST:
        return found
    enough = 10.0 ** np.ceil(np.log10(2 * failure.relative_residual))  # twice: it is not the same in every iteration
    return replace(found, advice=f"{found.advice}; solver.relative_tolerance = {enough:g} would accept this state")


def _of_the_tangent(inertia: Inertia, direction: NDArray[np.float64] | None) -> Refusal:
    negative, mode = inertia.negative_eigenvalues(), inertia.lowest()
    at_start, unloaded = of_the_unloaded_body(inertia)
    place = ", ".join(f"{c:.4g}" for c in mode.place)
    finding = (
        f"the lowest eigenvalue of the tangent is {mode.eigenvalue:.3g}, and {unloaded:.3g} in the unloaded body; its "
    )
    finding += f"mode is largest at ({place})"
    if negative > at_start:
        return replace(BIFURCATION, finding=finding)
    if mode.eigenvalue > NEARLY_CRITICAL * unloaded:
        return TOO_LARGE
    along = direction is not None and inertia.cosine(mode, direction) > ALONG_THE_MODE
    return replace(LIMIT_POINT if along else BIFURCATION, finding=finding)
