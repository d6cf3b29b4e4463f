"""When Newton's method has converged: a residual below a tolerance that no rounding error can pass."""

from __future__ import annotations

from remodel_fenicsx.settings import Solver
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.state.parameters import stress_rounding

FORCE_ROUNDINGS = 8.0  # how many times the rounding of assembled forces a residual may be
ROUNDED_STRAINS = 2.0  # the same of the rounding of displacements; on thin walls 0.07 to 0.96 were measured
PRESCRIBED_TOLERANCE = (
    1e-10  # of the body's size: how far a prescribed displacement may be missed; no force measures it
)
PRESCRIBED_ROUNDING = 1e-13  # of the body's size: prescribed values that are met to rounding
# Of the nodal forces: residual of a part that others follow. A part may be 1/256 of a step, and the next one is held
# against its direction: of 1e-3, which quasi-Newton steps stop just below, some were taken for jumps
INTERMEDIATE_TOLERANCE = 1e-5
# Above this r/L the rounding of one point may be more than this share of the nodal forces. A residual below it is then
# accepted only when an iteration leaves more than this share of it
NEARLY_STRAIGHT, COARSE, STAGNATION = 0.99, 1e-8, 0.25


class Convergence:
    """|R| <= absolute_tolerance + relative_tolerance |nodal forces|, not below the rounding of assembled forces.

    Parameters
    ----------
    equilibrium
        Whose residual it is.
    settings
        The tolerances.

    Attributes
    ----------
    force_scale
        Norm of the nodal forces, reactions included, at the present state: a scale that does not vanish in a hold.
    prescribed_gap
        Largest distance of a prescribed value from its target, relative to the body's size.
    max_chain_extension, displacement
        r/L and the largest unknown of the last admissible state.
    intermediate
        Whether the solution is only the start of a further one: then it may be coarser.
    """

    def __init__(self, equilibrium: Equilibrium, settings: Solver):
        self.equilibrium, self.settings = equilibrium, settings
        quadrature = equilibrium.quadrature
        areas, gradients = quadrature.largest_areas, quadrature.gradients
        self._area = quadrature.norm(areas)
        self._area_of_gradients = quadrature.norm(areas * gradients)  # per displacement
        self.force_scale = self.max_chain_extension = self.displacement = 0.0
        self.prescribed_gap, self.intermediate = float("inf"), False
        self.begin()

    def begin(self) -> None:
        """A solve begins: parameters may be others from solve to solve, not within one."""
        self._largest = self.equilibrium.parameters.largest()
        self.extended(self.max_chain_extension)

    def extended(self, max_chain_extension: float) -> None:
        """An admissible state has this largest r/L."""
        self.max_chain_extension = max_chain_extension
        self._stress_rounding = stress_rounding(self._largest, max_chain_extension)

    def reached(self, norm: float, previous: float) -> bool:
        """Whether a residual of this norm is accepted; `previous`: that of the iteration before, infinite at first.

        Near L the rounding of the worst point may be far above that of all others, and the largest displacement is not
        that of all elements. What is below such a rounding is accepted only when it goes no further down.
        """
        if self.prescribed_gap > PRESCRIBED_TOLERANCE:
            return False
        if self.intermediate and norm <= INTERMEDIATE_TOLERANCE * self.force_scale:
            return True
        tolerance = self.tolerance()
        if norm > tolerance:
            return False
        requested = self.settings.absolute_tolerance + self.settings.relative_tolerance * self.force_scale
        coarse = self.max_chain_extension > NEARLY_STRAIGHT and tolerance > COARSE * self.force_scale
        certain = requested if coarse else self.tolerance(rounded_strains=0.0)
        return norm <= certain or norm > STAGNATION * previous

    def goal(self) -> float:
        """Norm of the residual at which the solve ends, about."""
        coarse = INTERMEDIATE_TOLERANCE * self.force_scale if self.intermediate else 0.0
        return max(coarse, self.tolerance())

    def tolerance(self, rounded_strains: float = ROUNDED_STRAINS) -> float:
        """In the unit of force: relative to the nodal forces, not below the rounding of forces that cancel there.

        Stresses are rounded, and so are displacements: over a thin element that is a strain of eps |u|/h.
        """
        relative = self.settings.relative_tolerance * self.force_scale
        area = FORCE_ROUNDINGS * self._area + rounded_strains * self.displacement * self._area_of_gradients
        return self.settings.absolute_tolerance + max(relative, self._stress_rounding * area)
