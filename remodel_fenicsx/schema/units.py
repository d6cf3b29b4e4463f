"""Numbers with units, such as "100 mmHg", and numbers that seem to use another convention.

pint converts numbers exactly to the units of a scene. A warning names numbers that look like
percent, strains, radians or diameters. This module knows only the two keys that select a scene's
units: material.stress_unit and geometry.length_unit.
"""

from __future__ import annotations

import functools
import re
import tokenize
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from remodel_fenicsx.schema.tables import OneOf, validation_error, format_value

if TYPE_CHECKING:  # importing pint takes half a second, and most scenes have no units
    from pydantic.json_schema import JsonSchemaValue
    import pint

STRESS_UNIT, LENGTH_UNIT = "material.stress_unit", "geometry.length_unit"
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
LENGTH_UNITS = tuple(METRES)
LARGEST_NUMBER = 1e60  # a product of four such numbers does not overflow
NUMBER_TOO_LARGE = f"too large a number; must be at most {LARGEST_NUMBER:g}"
_UNITS: ContextVar[Mapping[str, str | None] | None] = ContextVar(
    "units", default=None
)  # units of the scene that is being validated

# Type of geometry.length_unit, for every shape.
LengthUnit = Annotated[
    str | None,
    OneOf(METRES),
    Field(
        description="Unit of every length of the scene. It is required only if lengths or forces "
        "have units; without it lengths are in any one unit.",
    ),
]

# A number, and a unit without brackets: pint would evaluate nested powers, which may never end.
_TERM = r"°?[^\W\d_]\w*(?:\s*(?:\^|\*\*)\s*[+-]?[0-9]{1,2}(?![0-9]))?"
_UNIT = re.compile(rf"(?:/\s*)?{_TERM}(?:\s*[*/·]\s*{_TERM}|\s+{_TERM})*")
_NUMBER, _REST = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?", r"[^\s0-9.].*"
_QUANTITY = re.compile(rf"((?>{_NUMBER}))\s*({_REST})")
QUANTITY = rf"{_NUMBER}\s*{_REST}"
"""A number with a unit as a regular expression of JSON Schema, which has no atomic groups."""


@dataclass(frozen=True)
class Dimension:
    """Dimension of a number of a scene, an annotation of its field: ``Annotated[float, LENGTH]``.

    Parameters
    ----------
    name
        Name in errors and in the reference.
    example
        A value with a unit.
    powers
        The unit of the number: powers of units, each the name of a unit or the key that selects it.

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

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self.number, handler(source))

    def number(self, value: object, key: str = "") -> Any:
        """Convert a text with a unit to a number in the units of the scene being validated.

        Parameters
        ----------
        value
            Value in the scene: a number, or a text with a unit.
        key
            Key of the value relative to the table being validated.

        Returns
        -------
        float
            Number in the scene's unit. A value that is not a text is returned unchanged.

        Raises
        ------
        PydanticCustomError
            If the text is not a number with a unit of this dimension, or if the scene does not set
            the unit.
        """
        units = _UNITS.get()
        if not isinstance(value, str) or units is None:
            return value
        rule = f"a unit of {self.name} as in {format_value(self.example)}"
        match = _QUANTITY.fullmatch(value.strip())
        if match is None:
            raise validation_error(f"must be a number, or one with {rule}", key, value)
        source = _unit(match[2])
        powers = {units.get(name, name): power for name, power in self.powers}
        # The metre replaces a unit of length that is not set, so that a wrong dimension is reported
        # first.
        target = _unit(" * ".join(f"{unit or 'm'}**{power}" for unit, power in powers.items()))
        if source is None or target is None or source.dimensionality != target.dimensionality:
            raise validation_error(
                f"{format_value(match[2])} is no unit of {self.name}; must be {rule}", key, value
            )
        if unset := [name for name, _ in self.powers if units.get(name, name) is None]:
            remedy = f"set {unset[0]} (m, cm, mm or um), or omit the unit"
            raise validation_error(
                f"a unit of {self.name} needs the scene's unit of length: {remedy}", key, value
            )
        number = float(match[1])  # rejects exponents that would make a fraction of a billion digits
        if abs(number) > LARGEST_NUMBER:
            raise validation_error(NUMBER_TOO_LARGE, key, value)
        return float(
            _registry().Quantity(Fraction(match[1]) if number else 0, source).to(target).magnitude
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return {"anyOf": [handler(schema), schema_with_unit(self)]}


def schema_with_unit(dimension: Dimension) -> JsonSchemaValue:
    """Return the JSON schema of a number with a unit."""
    return {"type": "string", "pattern": rf"^\s*{QUANTITY}\s*$", "examples": [dimension.example]}


STRESS = Dimension("stress", "2.4 kPa", ((STRESS_UNIT, 1),))
LENGTH = Dimension("length", "5 mm", ((LENGTH_UNIT, 1),))
AREA = Dimension("area", "10 mm^2", ((LENGTH_UNIT, 2),))
FORCE = Dimension("force", "300 mN", ((STRESS_UNIT, 1), (LENGTH_UNIT, 2)))
TENSION = Dimension("force per length", "20 N/m", ((STRESS_UNIT, 1), (LENGTH_UNIT, 1)))
TEMPERATURE = Dimension("temperature", "37 degC", (("K", 1),))
FOUNDATION = Dimension("stress per length", "10 kPa/mm", ((STRESS_UNIT, 1), (LENGTH_UNIT, -1)))
NUMBER_DENSITY = Dimension("number per volume", "2e21 / m^3", (("m", -3),))


def is_quantity(text: str) -> bool:
    """Return whether a text is a number followed by a possible unit."""
    match = _QUANTITY.fullmatch(text)
    return match is not None and _UNIT.fullmatch(match[2].rstrip()) is not None


@contextmanager
def scene_units(units: Mapping[str, str | None]) -> Iterator[None]:
    """Convert numbers with units to these units of a scene while the block validates them."""
    token = _UNITS.set(units)
    try:
        yield
    finally:
        _UNITS.reset(token)


def dimension_of(field: FieldInfo) -> Dimension | None:
    """Return the dimension with which a field is annotated, or None."""
    return next((entry for entry in field.metadata if isinstance(entry, Dimension)), None)


def factor_to_scene(unit: str, dimension: Dimension) -> float:
    """Return the factor from another unit to the scene's unit (`scene_units`) of a dimension."""
    try:
        return float(dimension.number(f"1 {unit}"))
    except PydanticCustomError as error:
        raise ValueError(error.message()) from error


def _unit(text: str) -> pint.Unit | None:
    """Parse a unit, or return None."""
    import pint

    if _UNIT.fullmatch(text) is None:
        return None
    try:
        return _registry().parse_units(re.sub("^/", "1 /", text.replace("·", "*")))
    except (pint.PintError, ValueError, tokenize.TokenError):  # undefined, or not parseable
        return None


@functools.cache
def _registry() -> pint.UnitRegistry:
    import pint

    # Fractions keep every factor exact: 5 mm are 5 mm. Only the result is rounded, to a float.
    return pint.UnitRegistry(non_int_type=Fraction)


# ---------------------------------------------------------------- numbers in another convention
# One table for scenes and measurements.

Array = NDArray[np.float64]


class Doubt(NamedTuple):
    """Warning that numbers of a quantity seem to use another convention."""

    quantity: str  # regular expression of its key or column, with the unit of a column in brackets
    # Of magnitudes and those expected: the model's, 1 mmHg for a pressure, or NaN.
    holds: Callable[[Array, Array], object]
    words: str


WITHOUT_LOAD = (
    "{high:.4g} at the smallest load or time is {ratio:.3g} times the scene's {expected:.4g} "
    "without load"
)

# Only the first entry that holds is reported. Comparisons with NaN do not hold.
CONVENTIONS = (
    Doubt(
        "elongation",
        lambda x, _: x.max() > 3.0,
        "reaches {high:.4g}: percent? An elongation of 10 % is 0.1",
    ),
    # A table of stretches begins at 1 within the measurement error.
    Doubt(
        "elongation",
        lambda x, _: x.min() > 0.98,
        "reaches {high:.4g}: a stretch? A stretch of 1.1 is an elongation of 0.1, "
        "an engineering strain",
    ),
    Doubt(
        "stretch",
        lambda x, _: x.max() > 10.0,
        "reaches {high:.4g}: percent? A stretch of 110 % is 1.1",
    ),
    # Soft tissue is compressed to a stretch of 0.5 at most.
    Doubt(
        "stretch",
        lambda x, _: x.min() < 0.4,
        "begins at {low:.4g}: strains? A stretch of 1 is the reference length",
    ),
    # Circumferential fibres have angles of 0.1 and less. The model's angles may be small too.
    Doubt(
        r"\b(\w*_)?angle",
        lambda x, model: 0.1 < x.max() <= 3.15 and not model.max() <= 3.15,
        "{high:.3g} at most: radians? Angles must be in degrees",
    ),
    Doubt(
        "temperature",
        lambda x, _: not 250.0 <= x.min() <= x.max() <= 400.0,  # neither frozen nor cooked
        "{high:.4g} is hardly an absolute temperature in K; 37 degC are 310.15",
    ),
    # In the median, arteries are tested at 50 to 130 mmHg and veins at 5 to 50. Taken as Pa, 130
    # are 1 mmHg; taken as kPa, 35 are 260.
    Doubt(
        "pressure",
        lambda x, mmhg: 0.0 < np.median(x / mmhg) < 1.0 or np.median(x / mmhg) > 250.0,
        "{ratio:.3g} mmHg in the median, not within 1 and 250: another unit? See units",
    ),
    # Lengths are compared under the smallest load, with the scene's without pressure or forces but
    # with its elongation and opening angle: the guessed tissue hardly matters.
    Doubt(
        r"\(length\)",  # units of length differ by a factor of ten or more
        lambda x, model: abs(np.log(x / model)) > np.log(5.0),
        f"{WITHOUT_LOAD}; another unit than geometry.length_unit? Check units",
    ),
    # Diameters are twice the radii, or more. By its smallest load, even if this is the diastolic
    # one, an artery gets less than 1.6 times as wide.
    Doubt(
        r"radius \(length\)",
        lambda x, model: abs(np.log(x / model)) > np.log(1.7),
        f"{WITHOUT_LOAD}; are they diameters? Check also units and the size of the scene",
    ),
)


def convention_doubt(quantity: str, values: ArrayLike, model: ArrayLike = np.nan) -> str:
    """Return a warning that numbers seem to use another convention, or an empty string."""
    numbers, expected = np.abs(np.atleast_1d(values)), np.maximum(
        np.abs(np.atleast_1d(model)), 1e-300
    )
    for doubt in CONVENTIONS:
        if re.search(doubt.quantity, quantity) and doubt.holds(numbers, expected):
            ratio, most = np.median(numbers / expected), expected.max()
            return doubt.words.format(
                low=numbers.min(), high=numbers.max(), ratio=ratio, expected=most
            )
    return ""
