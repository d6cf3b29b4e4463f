"""Life cycle in a step that cells, turnover and further load cases share: `Remodels`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.solver.continuation import Work

if TYPE_CHECKING:
    from remodel_fenicsx.model.energy import Tissue
    from remodel_fenicsx.evolution.stepper import Stepper, Watcher
    from remodel_fenicsx.scene.scene import Scene


Values: TypeAlias = Any  # type: ignore[explicit-any]
"""Values of a remodeling process at all points; its class defines the type."""


class Remodels:
    """Base class of a remodeling process; a subclass overrides the methods that it needs.

    A process has values at all n quadrature points of this rank, of a type that the subclass
    defines. `as_components` returns them as an array (n, components) whose differences are
    meaningful. A change by `change_to_limit` is an array (elements, points, ...), such as
    (elements, points, 3, 3) for the cells.

    With `changes` a subclass overrides `before` or `after`, `set_fraction` and `remaining_change`.
    For an estimated time discretisation error it sets `components`, and overrides `solved_values`,
    `higher_order`, `set`, `as_components`, `with_change`, `after_pass` and `distance_between`
    together. For a steady state with `components` it also overrides `change_to_limit`, `size` and
    `apply_change`.

    Attributes
    ----------
    name
        Prefix of names in the state.
    components
        Number of components at a point. With 0 no time discretisation error is estimated, and the
        path to the steady state is not extrapolated.
    changes
        Whether the values change in time.
    slowest, fastest
        Smallest positive rate and largest rate, 1/time.
    depends_on_path
        Whether the steady state depends on the load path.
    tissue
        The tissue with additional parameters; None if the process adds no parameters.
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
        """Set the values for the equilibrium at the end of a step.

        Parameters
        ----------
        time
            End of the step.
        order
            Order of the coupling. For 1 the values follow one step late, by the last rates and the
            last duration; for 2 by rates that are extrapolated to the middle of this step.
        """

    def settle(self, time: float, again: bool) -> Work:
        """Update the values after a solved equilibrium, and return additional solver work.

        Parameters
        ----------
        time
            End of the step.
        again
            Whether it is the second equilibrium of this step.

        Returns
        -------
        Work
            Solver work of the process.
        """
        return Work()

    def after(self, time: float) -> float:
        """Remodel after a solved step, and return the released power.

        Parameters
        ----------
        time
            End of the step.

        Returns
        -------
        float
            Stored energy per time that the process releases at frozen deformation; positive if the
            stored energy decreases. It is added to the column `remodeling_power`.
        """
        return 0.0

    def set_fraction(self, fraction: float) -> None:
        """Set the values to a fraction, from 0 to 1, of their change since the last equilibrium."""

    def close(self) -> None:
        """Free the PETSc objects of the values."""

    # ------------------------------------------------------------ time discretisation error
    def solved_values(self) -> Values:
        """Return the values of the solved state."""

    def higher_order(self) -> Values:
        """Return the values of a higher-order rule after a step; None if there is no such rule."""

    def set(self, values: Values) -> None:
        """Replace the values at all points."""

    def as_components(self, values: Values) -> Array:
        """Return values as components, (n, components)."""
        return np.asarray(values)

    def with_change(self, values: Values, change: Array) -> Values:
        """Return values after a change (n, components) of their components."""
        return values

    def after_pass(self, values: Values, time: float, residual: float) -> Values:
        """Return values after a pass up to a time, with the stress of the present state.

        Parameters
        ----------
        values
            Values at the state's time.
        time
            End of the pass.
        residual
            Residual norm with which the state was accepted.
        """
        return values

    def distance_between(self, values: Values, other: Values) -> float:
        """Return one number for the distance of two values over the body, in degrees."""
        return 0.0

    # ------------------------------------------------------------ steady state
    def remaining_change(self, time: float, residual: float) -> float:
        """Return the largest relative change that remains up to a time.

        A process with `changes` must override it.
        """
        return 0.0

    def change_to_limit(self, time: float, duration: float, residual: float) -> Array:
        """Return the change to the limit under the present stress, (elements, points, ...).

        Parameters
        ----------
        time
            End of a pass that is long enough to reach the limit.
        duration
            Duration of the change for a process that has rates but no pass to a limit.
        residual
            Residual norm with which the state was accepted.
        """
        return np.zeros((0, 0))

    def size(self, change: Array) -> float:
        """Return the largest relative size of a change (elements, points, ...)."""
        return 0.0

    def apply_change(self, change: Array, factor: float, time: float, residual: float) -> None:
        """Apply a multiple of the change of `change_to_limit`."""

    def begin_path(self) -> None:
        """Reset the monitors for a new path to the steady state."""

    def steady_state_problem(self, waiting: float) -> str:
        """Return why there is no steady state, as text; an empty string if there may be one.

        Parameters
        ----------
        waiting
            Time under constant loads so far.
        """
        return ""

    def start_at_steady_state(self, time: float) -> None:
        """Start at a time if the process waits for the first steady state."""
