"""Life cycle in a step that cells, turnover and further load cases share: `Remodels`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.solver.continuation import Work

if TYPE_CHECKING:
    from remodel_fenicsx.model.energy import Tissue
    from remodel_fenicsx.evolution.stepper import Stepper, Watcher
    from remodel_fenicsx.scene.scene import Scene

Array = NDArray[np.float64]

Values: TypeAlias = Any  # type: ignore[explicit-any]
"""Values of a remodeling process at all points; its class defines the type."""


class Remodels:
    """Base class of a remodeling process; a subclass overrides the methods that it needs.

    Values are flattened over the quadrature points, with a type that the subclass defines. As
    components they are an array (n, components) whose differences are meaningful.

    Attributes
    ----------
    name
        Prefix of names in the state.
    components
        Number of components at a point; 0 without values, for which neither a time discretisation
        error is estimated nor the tail of the steady state extrapolated.
    changes
        Whether the values change in time.
    slowest, fastest
        Smallest positive rate and largest rate, 1/time.
    depends_on_path
        Whether the steady state depends on the load path.
    tissue
        The tissue with additional parameters; None if it stays.
    watchers
        Functions of a scene and a stepper that return a watcher or None.

    Examples
    --------
    demos/extensions/decaying_collagen.py has a complete example. The remodeling processes of a
    simulation:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> [part.name for part in simulation.stepper.remodels]
    ['cells']
    """

    name = ""
    components = 0
    changes = False
    slowest: float = 0.0
    fastest: float = 0.0
    depends_on_path = False
    tissue: Tissue | None = None
    watchers: Sequence[Callable[[Scene, Stepper], Watcher | None]] = ()

    def set_initial(self, values: Callable[[str], Array]) -> None:
        """Set the initial values from fields of an earlier run by name, (elements, points, ...)."""

    # ------------------------------------------------------------ a step
    def before(self, time: float, order: int) -> None:
        """Set the values for the equilibrium at a time, by the last rates or extrapolated."""

    def settle(self, time: float, again: bool) -> Work:
        """Update after a solved equilibrium; `again` if it is the second one of this step."""
        return Work()

    def after(self, time: float) -> float:
        """Remodel after a solved step, and return the released power."""
        return 0.0

    def set_part(self, fraction: float) -> None:
        """Apply a fraction of the change since the last equilibrium."""

    def close(self) -> None:
        """Free the PETSc objects of the values."""

    # ------------------------------------------------------------ time discretisation error
    def row(self) -> Values:
        """Return the values of the solved state."""

    def higher_order(self) -> Values:
        """Return the values of a higher-order rule after a step, or None."""

    def set(self, values: Values) -> None:
        """Replace the values at all points."""

    def as_components(self, values: Values) -> Array:
        """Return values as components, (n, components)."""
        return np.asarray(values)

    def moved(self, values: Values, change: Array) -> Values:
        """Return values after a change of their components."""
        return values

    def passed(self, values: Values, time: float, residual: float) -> Values:
        """Return the values after a pass with the present state up to a time."""
        return values

    def apart(self, values: Values, other: Values) -> float:
        """Return the distance of two values over the body, in degrees."""
        return 0.0

    # ------------------------------------------------------------ steady state
    def left(self, time: float, residual: float) -> float:
        """Return the largest relative change up to a time. Every process needs it."""
        return 0.0

    def to_the_limit(self, time: float, duration: float, residual: float) -> Array:
        """Return the change to the limit, or over a duration, (elements, points, ...)."""
        return np.zeros((0, 0))

    def size(self, change: Array) -> float:
        """Return the largest relative size of a change (elements, points, ...)."""
        return 0.0

    def follow(self, change: Array, factor: float, time: float, residual: float) -> None:
        """Apply a multiple of the change of `to_the_limit`."""

    def begin_path(self) -> None:
        """Reset the monitors for a new path to the steady state."""

    def without_rest(self, waiting: float) -> str:
        """Return why there is no steady state after a time under constant loads, or nothing."""
        return ""

    def rested(self, time: float) -> None:
        """Start at a time, if the process waits for the steady state."""
