"""What remodels: the life of cells, collagen content and further load cases in a step, and their error in time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.solver.continuation import Work

if TYPE_CHECKING:
    from remodel_fenicsx.evolution.stepper import Stepper, Watcher
    from remodel_fenicsx.scene.scene import Scene

Array = NDArray[np.float64]


class Remodels:
    """Something that remodels beside the displacement; a subclass overrides what it has.

    Values are those of all points in one row, in a form that the subclass chooses; as components they are an array
    (n, components), in which differences are taken.

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
        Whether the values at rest depend on the path that leads there.
    tissue
        The tissue with what it brings.
    watchers
        Make watchers of its own, or None, of a scene and a stepper.
    """

    name = ""
    components = 0
    changes = False
    slowest: float = 0.0
    fastest: float = 0.0
    depends_on_path = False
    tissue: Any = None
    watchers: Sequence[Callable[[Scene, Stepper], Watcher | None]] = ()

    def begin_with(self, values: Callable[[str], Array]) -> None:
        """Take what files of an earlier run have, by name, (elements, points, ...)."""

    # ------------------------------------------------------------ a step
    def before(self, time: float, order: int) -> None:
        """Take the values for the equilibrium at a time: of the last rates, or extrapolated (order 2)."""

    def settle(self, time: float, again: bool) -> Work:
        """The state is in equilibrium; `again`: of this step a second time."""
        return Work()

    def after(self, time: float) -> float:
        """The step is solved: remodel, and return the power."""
        return 0.0

    def set_part(self, fraction: float) -> None:
        """Take a part of what has changed since the last equilibrium."""

    def close(self) -> None:
        """Free PETSc's objects."""

    # ------------------------------------------------------------ error in time
    def row(self) -> object:
        """Return the values of the solved state."""

    def better(self) -> object:
        """Return, after a step, values by a better rule; None where there are none."""

    def set(self, values: Any) -> None:
        """Take other values."""

    def as_components(self, values: Any) -> Array:
        """Return values as components."""
        return np.asarray(values)

    def moved(self, values: Any, change: Array) -> object:
        """Return values after a change of their components."""
        return values

    def passed(self, values: Any, time: float, residual: float) -> object:
        """Return what the present state makes of values up to a time."""
        return values

    def apart(self, values: Any, other: Any) -> float:
        """Return a distance of two values over the body, degrees."""
        return 0.0

    # ------------------------------------------------------------ rest
    def left(self, time: float, residual: float) -> float:
        """Return the largest relative change up to a time."""
        return 0.0

    def to_the_limit(self, time: float, duration: float, residual: float) -> Array:
        """Return the change to where it tends, or over a duration where it has no limit, (elements, points, ...)."""
        return np.zeros(())

    def size(self, change: Array) -> float:
        """Return the largest relative size of such a change."""
        return 0.0

    def follow(self, change: Array, factor: float, time: float, residual: float) -> None:
        """Take a multiple of such a change."""

    def begin_path(self) -> None:
        """A path to rest begins."""

    def without_rest(self, waiting: float) -> str:
        """Say, where it is so, that it does not come to rest; `waiting`: under constant loads, times its rate."""
        return ""

    def rested(self, time: float) -> None:
        """All is at rest before a time at which what waits for that begins."""
