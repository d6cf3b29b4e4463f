"""Watchers that warn of the state of a run, without an influence on its results."""

# Except for `EquilibriumStability`, which ends a run if `solver.unstable` is "stop".

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from remodel_fenicsx._lazy import resolved
from remodel_fenicsx._renamed import with_old_names

if TYPE_CHECKING:
    from remodel_fenicsx.evolution.stepper import LoadCaseSolver, Stepper, Watcher
    from remodel_fenicsx.scene.scene import Scene


@with_old_names
@dataclass(frozen=True)
class WatcherKind:
    """Kind of watcher, registered by name.

    Attributes
    ----------
    maker
        Function of a scene and a stepper that returns a `Watcher`, or None if there is nothing to
        watch; or its dotted name.
    checks_each_case
        Whether it watches solved states only, so that each load case has its own watcher.

    Examples
    --------
    A watcher of every run, which counts its steps:

    >>> from remodel_fenicsx import Simulation, parts, preset_scene
    >>> from remodel_fenicsx.extend import WATCHERS, WatcherKind
    >>> class Counter(parts.Watcher):
    ...     steps = 0
    ...
    ...     def committed(self, step):
    ...         Counter.steps += 1
    >>> WATCHERS["counter"] = WatcherKind(lambda scene, stepper: Counter())
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 3.0})
    >>> for step in Simulation(scene).steps():
    ...     pass
    >>> Counter.steps
    3
    >>> del WATCHERS["counter"]
    """

    maker: Callable[[Scene, Stepper], Watcher | None] | str
    checks_each_case: bool = False

    def make(self, scene: Scene, stepper: LoadCaseSolver) -> Watcher | None:
        """Return the watcher of a stepper or load case, or None if there is nothing to watch.

        Parameters
        ----------
        scene
            The scene.
        stepper
            Its stepper, or another load case.
        """
        return resolved(self.maker)(scene, stepper)


_WARNINGS = "remodel_fenicsx.watch.warnings:"

WATCHERS = {
    "over-correction": WatcherKind(
        "remodel_fenicsx.watch.over_correction:OverCorrection.for_scene"
    ),
    "locking": WatcherKind(_WARNINGS + "LockingWarning.for_scene", checks_each_case=True),
    "buckling": WatcherKind(
        "remodel_fenicsx.watch.stability:BucklingWarning.for_scene", checks_each_case=True
    ),
    "volume": WatcherKind(_WARNINGS + "VolumeLoss.for_scene", checks_each_case=True),
    "pressure-noise": WatcherKind(_WARNINGS + "PressureNoise.for_scene"),
    "weak-tension": WatcherKind(_WARNINGS + "WeakTension.for_scene"),
    "radial-chains": WatcherKind(_WARNINGS + "RadialChains.for_scene"),
    "fronts": WatcherKind(_WARNINGS + "FrontsInLayers.for_scene"),
}
"""Watchers by name, in the order in which they see a step."""
