"""Cells, collagen content and further load cases share one life cycle in a step: `Remodels`."""

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
"""Values of something that remodels, at all points, in the form that its class chooses."""


class Remodels:
    """Take part in a step as something that remodels; a subclass overrides what it needs.

    Values are flattened over the quadrature points, in a form that the subclass chooses. As
    components they are an array (n, components), whose differences have a meaning.

    Attributes
    ----------
    name
        Of what is remembered of it in the state.
    components
        How many numbers it has at a point; 0 of what has no values of its own.
    changes
        Whether its values change in time.
    slowest, fastest
        Smallest rate above 0, and largest one, 1/time.
    depends_on_path
        Whether the steady state depends on the load path.
    tissue
        The tissue with what it brings.
    watchers
        Make watchers of its own, or None, of a scene and a stepper.

    Examples
    --------
    demos/extensions/decaying_collagen.py has a whole one. Of a simulation:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> [part.name for part in Simulation(preset_scene("kuhl-holzapfel-2007", "cube")).stepper.remodels]
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

    def begin_with(self, values: Callable[[str], Array]) -> None:
        """Take what files of an earlier run have, by name, (elements, points, ...)."""

    # ------------------------------------------------------------ a step
    def before(self, time: float, order: int) -> None:
        """Take the values for the equilibrium at a time, by the last rates or extrapolated."""

    def settle(self, time: float, again: bool) -> Work:
        """Follow a solved equilibrium; `again`: a second one of this step."""
        return Work()

    def after(self, time: float) -> float:
        """Remodel after a solved step, and return the power."""
        return 0.0

    def set_part(self, fraction: float) -> None:
        """Take a part of what has changed since the last equilibrium."""

    def close(self) -> None:
        """Free the objects that PETSc has made."""

    # ------------------------------------------------------------ time discretisation error
    def row(self) -> Values:
        """Return the values of the solved state."""

    def better(self) -> Values:
        """Return, after a step, values by a better rule; None where there are none."""

    def set(self, values: Values) -> None:
        """Replace the values at all points."""

    def as_components(self, values: Values) -> Array:
        """Return values as components."""
        return np.asarray(values)

    def moved(self, values: Values, change: Array) -> Values:
        """Return values after a change of their components."""
        return values

    def passed(self, values: Values, time: float, residual: float) -> Values:
        """Return what the present state makes of values up to a time."""
        return values

    def apart(self, values: Values, other: Values) -> float:
        """Return a distance of two values over the body, degrees."""
        return 0.0

    # ------------------------------------------------------------ steady state
    def left(self, time: float, residual: float) -> float:
        """Return the largest relative change up to a time."""
        return 0.0

    def to_the_limit(self, time: float, duration: float, residual: float) -> Array:
        """Return the change to its limit, or over a duration, (elements, points, ...)."""
        return np.zeros((0, 0))

    def size(self, change: Array) -> float:
        """Return the largest relative size of such a change."""
        return 0.0

    def follow(self, change: Array, factor: float, time: float, residual: float) -> None:
        """Take a multiple of such a change."""

    def begin_path(self) -> None:
        """Begin a path to the steady state."""

    def without_rest(self, waiting: float) -> str:
        """Return why it reaches no steady state, or nothing; `waiting`: under constant loads."""
        return ""

    def rested(self, time: float) -> None:
        """Begin at a time what waits for the steady state that is reached."""
