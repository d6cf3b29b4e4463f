"""Numbers with units, as "100 mmHg": turned into numbers in the units of a scene, exactly, by pint.

Of the keys of a scene it knows only the two that choose its units: material.stress_unit and geometry.length_unit.
"""

from __future__ import annotations

import functools
import math
import re
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel, Field, GetJsonSchemaHandler
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, PydanticCustomError

from remodel_fenicsx.schema.tables import allowed, fault, free_names, is_table, quoted, sections, shown

if TYPE_CHECKING:  # it takes half a second to start, and most scenes have no units
    import pint

STRESS_UNIT, LENGTH_UNIT = "material.stress_unit", "geometry.length_unit"
_LENGTH_UNITS = Literal["m", "cm", "mm", "um"]
LENGTH_UNITS: tuple[str, ...] = get_args(_LENGTH_UNITS)
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}

# the type of geometry.length_unit, for every shape
LengthUnit = Annotated[
    _LENGTH_UNITS | None,
    Field(
        description="Unit of every length of the scene. It is needed only where lengths or forces are given with "
        "units; without it lengths are in any one unit.",
    ),
]

# A number, and a unit without brackets: pint would work out towers of powers, which may take for ever.
_TERM = r"°?[^\W\d_]\w*(?:\s*(?:\^|\*\*)\s*[+-]?[0-9]{1,2}(?![0-9]))?"
_UNIT = re.compile(rf"(?:/\s*)?{_TERM}(?:\s*[*/·]\s*{_TERM}|\s+{_TERM})*")
_NUMBER, _REST = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?", r"[^\s0-9.].*"
_QUANTITY = re.compile(rf"((?>{_NUMBER}))\s*({_REST})")
QUANTITY = rf"{_NUMBER}\s*{_REST}"
"""A number with a unit as a regular expression of JSON Schema, which has no atomic groups."""


@dataclass(frozen=True)
class Dimension:
    """What a number of a scene measures: an annotation of its field, ``side: Annotated[float, LENGTH]``.

    Parameters
    ----------
    name
        As errors and the reference say it.
    example
        A value with a unit.
    powers
        The unit of the number: powers of units, each the name of a unit or the key that chooses it.

    Examples
    --------
    A force per volume, in the units of the scene:

    >>> from remodel_fenicsx.extend import LENGTH_UNIT, STRESS_UNIT, Dimension
    >>> Dimension("force per volume", "9.81 kN/m^3", ((STRESS_UNIT, 1), (LENGTH_UNIT, -1))).powers
    (('material.stress_unit', 1), ('geometry.length_unit', -1))
    """

    name: str
    example: str
    powers: tuple[tuple[str, int], ...]

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [handler(schema), schema_with_unit(self)]}


def schema_with_unit(dimension: Dimension) -> dict[str, Any]:
    """JSON schema of a number with a unit."""
    return {"type": "string", "pattern": rf"^\s*{QUANTITY}\s*$", "examples": [dimension.example]}


STRESS = Dimension("stress", "2.4 kPa", ((STRESS_UNIT, 1),))
LENGTH = Dimension("length", "5 mm", ((LENGTH_UNIT, 1),))
AREA = Dimension("area", "10 mm^2", ((LENGTH_UNIT, 2),))
FORCE = Dimension("force", "300 mN", ((STRESS_UNIT, 1), (LENGTH_UNIT, 2)))
TEMPERATURE = Dimension("temperature", "37 degC", (("K", 1),))
FOUNDATION = Dimension("stress per length", "10 kPa/mm", ((STRESS_UNIT, 1), (LENGTH_UNIT, -1)))
NUMBER_DENSITY = Dimension("number per volume", "2e21 / m^3", (("m", -3),))


def is_quantity(text: str) -> bool:
    """Whether a text is a number followed by something that could be its unit."""
    found = _QUANTITY.fullmatch(text)
    return found is not None and _UNIT.fullmatch(found[2].rstrip()) is not None


def in_units(
    values: Any,
    table: type[BaseModel],
    units: Mapping[str, str | None],
    key: str = "",
    dimensions: Mapping[str, Dimension | None] | None = None,
) -> Any:
    """The values of a table and of the tables in it, where "5 mm" has become a number."""
    if not isinstance(values, Mapping):
        return values
    result = dict(values)
    for name, value in values.items():
        field, path = table.model_fields.get(name), f"{key}.{quoted(str(name))}" if key else name
        kind: Any = free_names(table) if field is None else field.annotation
        if is_table(kind):
            result[name] = in_units(value, kind, units, path)
        elif get_origin(kind) is dict and is_table(inner := get_args(kind)[1]) and isinstance(value, Mapping):
            result[name] = {
                own: in_units(one, inner, units, f"{path}.{quoted(str(own))}") for own, one in value.items()
            }
        elif field is not None and float in (kind, *get_args(kind)) and isinstance(value, str):
            dimension = dimension_of(field) if dimensions is None else dimensions.get(name)
            result[name] = _number(value, field, dimension, units, path)
    return result


def dimension_of(field: FieldInfo) -> Dimension | None:
    """The dimension that a field is annotated with, if it is."""
    return next((entry for entry in field.metadata if isinstance(entry, Dimension)), None)


def keys_with_units(table: type[BaseModel]) -> Iterator[tuple[str, Dimension]]:
    """Dotted key and dimension of every annotated field in a table; a key of several variants comes once."""
    seen: set[str] = set()
    for key, _, inner in sections(table):
        for name, field in inner.model_fields.items():
            dimension, path = dimension_of(field), f"{key}.{name}"
            if dimension is not None and path not in seen:
                seen.add(path)
                yield path, dimension


def factor_to_scene(unit: str, dimension: Dimension, units: Mapping[str, str | None]) -> float:
    """How many of the scene's units one of another unit is."""
    try:
        return float(_number(f"1 {unit}", FieldInfo(annotation=float), dimension, units, "units"))
    except PydanticCustomError as error:
        raise ValueError(error.message()) from error


def _number(
    text: str, field: FieldInfo, dimension: Dimension | None, units: Mapping[str, str | None], key: str
) -> float | str:
    """The number that a text stands for, in the scene's unit."""
    rule, found = allowed(field), _QUANTITY.fullmatch(text.strip())
    if dimension is None:
        if found is None:
            return text
        raise fault(f"{rule}, without a unit", key, text)
    rule += f", or one with a unit of {dimension.name} as in {shown(dimension.example)}"
    if found is None:
        raise fault(rule, key, text)
    source = _unit(found[2])
    powers = {units.get(name, name): power for name, power in dimension.powers}
    # a unit of length stands in for one that was not chosen, to tell first whether it is a length at all
    target = _unit(" * ".join(f"{unit or 'm'}**{power}" for unit, power in powers.items()))
    if source is None or target is None or source.dimensionality != target.dimensionality:
        raise fault(f"{shown(found[2])} is no unit of {dimension.name}; {rule}", key, text)
    for name, _ in dimension.powers:
        if units.get(name, name) is None:
            remedy = f"set {name} (m, cm, mm or um), or leave the unit out"
            raise fault(f"a unit of {dimension.name} needs the scene's unit of length: {remedy}", key, text)
    try:
        number = float(found[1])  # sorts out the exponents that would make a fraction of a billion digits
        exact = Fraction(found[1]) if number and math.isfinite(number) else Fraction(number)
        return float(_registry().Quantity(exact, source).to(target).magnitude)
    except OverflowError:
        raise fault(f"too large a number; {rule}", key, text) from None


def _unit(text: str) -> pint.Unit | None:
    """The unit that a text names, or None."""
    import pint

    if _UNIT.fullmatch(text) is None:
        return None
    try:
        return _registry().parse_units(re.sub("^/", "1 /", text.replace("·", "*")))
    except (pint.PintError, ValueError, tokenize.TokenError):  # not defined, or not to be understood
        return None


@functools.cache
def _registry() -> pint.UnitRegistry:
    import pint

    # with fractions every factor is exact: 5 mm are 5 mm, and the one rounding is that to the nearest float
    return pint.UnitRegistry(non_int_type=Fraction)
