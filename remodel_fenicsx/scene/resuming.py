"""What of a scene may change where its run goes on from a checkpoint."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.schema.tables import SceneError, shown
from remodel_fenicsx.settings import Load

# what decides no number of the steps done, or only how they were solved
FREE = ("format", "name", "preset", "profile", "output", "solver", "loads", "time.end")
SAME_LOAD = 1e-12  # relative difference of two loads that are the same


def check_continuation(old: Scene, new: Scene, time: float) -> None:
    """Check that the physics of a scene is that of the run so far, until `time`.

    End time, output, solver and the loads after `time` may change.

    Raises
    ------
    SceneError
        One line: the first key that differs, and what it was.
    """
    rule = f"a resumed run may change time.end, output, solver, and loads after its checkpoint at {time:g}"
    before, now = (dict(_values(scene.model_dump(mode="json"))) for scene in (old, new))
    for key in [*before, *(key for key in now if key not in before)]:
        if before.get(key) != now.get(key):
            was = shown(before[key]) if key in before else "not there"
            raise SceneError(f"{key} = {shown(now.get(key))}: was {was}; {rule}")
    for name in new.geometry.loads:
        first, second = old.loads.get(name), new.loads.get(name)
        for moment in sorted({0.0, time, *_times(first), *_times(second)}):
            old_value, value = (0.0 if one is None else one.value * one.factor(moment) for one in (first, second))
            if moment <= time and abs(old_value - value) > SAME_LOAD * max(abs(old_value), abs(value)):
                raise SceneError(f"loads.{name} = {value:g} at time {moment:g}: was {old_value:g}; {rule}")
    if new.last_time < time:
        raise SceneError(f"time.end = {shown(new.time.end)}: must be at least {time:g}, where the checkpoint is")


def _times(load: Load | None) -> list[float]:
    return [] if load is None else [time for time, _ in load.ramp]


def _values(table: Mapping[str, Any], key: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of all values that must stay."""
    for name, value in table.items():
        path = f"{key}.{name}" if key else name
        if path in FREE:
            continue
        if isinstance(value, Mapping):
            yield from _values(value, path)
        else:
            yield path, value
