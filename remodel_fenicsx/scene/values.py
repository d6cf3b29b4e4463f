"""The values of a scene as they were read, before its tables check them: format, shape, and numbers for units."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from remodel_fenicsx.body import Shape
from remodel_fenicsx.schema.tables import Table, allowed, fault
from remodel_fenicsx.schema.units import LENGTH_UNIT, LENGTH_UNITS, STRESS_UNIT, in_units
from remodel_fenicsx.settings import STRESS_UNITS, Material

FORMAT = 2  # of recorded scenes: raised where a reader of the one before would not understand them
RENAMED = {"mesh.cell": "mesh.element", "loads.stretch": "loads.elongation", "solver.profile": "solver.method"}
"""Dotted key of an earlier format -> the key that has taken its place, for the error."""


def in_present_format(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values with the present format number: what is read without a fault is a scene of the present format.

    Raises
    ------
    PydanticCustomError
        A `fault` if a newer version wrote them, before anything is said about the keys that are new in it.
    """
    written = values.get("format")
    if not isinstance(written, int) or isinstance(written, bool) or written < 1:
        return dict(values)  # none, or a fault that the field's own error describes
    if written > FORMAT:
        rule = f"written by a newer version of remodel_fenicsx; this one reads formats up to {FORMAT}"
        raise fault(rule, "format", written)
    return {**values, "format": FORMAT}


def known_shape(geometry: Any, shapes: Collection[str]) -> str:
    """The shape that is asked for. Without it nothing else can be judged: preset, loads and units depend on it.

    Raises
    ------
    PydanticCustomError
        A `fault` if it is missing or unknown.
    """
    if not isinstance(geometry, Mapping):
        raise fault("must be a table", "geometry", geometry)
    rule = "allowed are " + ", ".join(map(repr, shapes))
    if "shape" not in geometry:
        raise fault(f"missing; {rule}", "geometry.shape", None)
    shape = geometry["shape"]
    if not isinstance(shape, str) or shape not in shapes:
        raise fault(rule, "geometry.shape", shape)
    return shape


def in_own_units(
    values: Mapping[str, Any], scene: type[Table], shape: type[Shape], load: type[Table]
) -> dict[str, Any]:
    """The values, those of preset and shape among them, with numbers in the scene's units in place of "5 mm".

    Parameters
    ----------
    values
        Of the whole scene.
    scene, shape, load
        The table classes of the scene, of its geometry and of a load.

    Raises
    ------
    PydanticCustomError
        A `fault` as of `in_units`.
    """
    units = _units(values, shape)
    result: dict[str, Any] = in_units(values, scene, units)
    if "geometry" in result:
        result["geometry"] = in_units(result["geometry"], shape, units, "geometry")
    if isinstance(loads := result.get("loads"), Mapping):
        result["loads"] = {
            name: in_units(entry, load, units, f"loads.{name}", {"value": shape.loads[name].dimension})
            for name, entry in loads.items()
        }
    return result


def _units(values: Mapping[str, Any], shape: type[Table] | None = None) -> dict[str, str | None]:
    """The scene's own units by the keys that choose them."""
    units: dict[str, str | None] = {LENGTH_UNIT: None}
    for key, table, known in ((STRESS_UNIT, Material, tuple(STRESS_UNITS)), (LENGTH_UNIT, shape, LENGTH_UNITS)):
        if table is None:
            continue
        table_name, name = key.split(".")
        chosen, field = values.get(table_name), table.model_fields[name]
        unit = chosen.get(name, field.default) if isinstance(chosen, Mapping) else field.default
        if unit not in known and unit is not None:
            raise fault(allowed(field), key, unit)
        units[key] = unit
    return units
