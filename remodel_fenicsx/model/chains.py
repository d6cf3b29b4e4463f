"""Chain laws: the free energy of one collagen chain over its end-to-end length.

Pure arithmetic on numbers, arrays or UFL expressions. All lengths are in link lengths of the chain (paper, Remark 1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, Self, TypeAlias, TypeVar


UflOrArray: TypeAlias = Any  # type: ignore[explicit-any]
"""A UFL expression, an array over points or a number: what the formulas of the model take alike. UFL has no types."""

Result = TypeVar("Result", covariant=True)


class Formula(Protocol[Result]):
    """A function of such values; parts with parameters of their own take these too, by keyword."""

    def __call__(self, *values: UflOrArray, **parameters: UflOrArray) -> Result: ...


BOLTZMANN_CONSTANT = 1.381e-23  # J/K, as printed in the paper


def wormlike_energy(end_to_end_length: UflOrArray, contour_length: UflOrArray) -> UflOrArray:
    """Energy of a wormlike chain over k theta / A_p (eq. 1)."""
    x = end_to_end_length / contour_length
    return contour_length / 4 * (2 * x**2 + 1 / (1 - x) - x)


def wormlike_stiffness(end_to_end_length: UflOrArray, contour_length: UflOrArray) -> UflOrArray:
    """Secant stiffness g(r) = 1/L + 1/(4 r (1-r/L)^2) - 1/(4 r) of eq. (7): d(wormlike_energy)/dr = g r."""
    # Written with the pole at r = 0 cancelled, so that short chains lose no digits.
    x = end_to_end_length / contour_length
    return (1 + (2 - x) / (4 * (1 - x) ** 2)) / contour_length


@dataclass(frozen=True)
class Parameter:
    """A number of a part's own: a key of the table in which a scene names the part.

    Attributes
    ----------
    default
        What it is where a scene does not say it.
    meaning
        In one sentence.
    above
        It must be greater than this; None: any finite number will do.

    Examples
    --------
    >>> from remodel_fenicsx.extend import Parameter
    >>> Parameter(0.5, "Length of a link, in those of the paper.", above=0.0).default
    0.5
    """

    default: float
    meaning: str
    above: float | None = None


NO_PARAMETERS: Mapping[str, Parameter] = MappingProxyType({})
NO_VALUES: Mapping[str, UflOrArray] = MappingProxyType({})


class WithParameters:
    """A part whose functions may take parameters of its own, by keyword; their values come from `of`."""

    functions: ClassVar[tuple[str, ...]]
    parameters: Mapping[str, Parameter]

    def of(self, values: Mapping[str, UflOrArray]) -> Self:
        """The part with these values of its parameters: numbers, arrays or UFL.

        Parameters
        ----------
        values
            By the names of `parameters`.
        """
        if not values:
            return self
        functions = {name: getattr(self, name) for name in self.functions}
        bound = {name: partial(function, **values) for name, function in functions.items() if function}
        return replace(self, values=values, **bound)  # type: ignore[type-var]


@dataclass(frozen=True)
class Chain(WithParameters):
    """A law of a single chain: its energy and force (paper, eq. 2).

    Both functions take numbers, arrays or UFL; lengths are in link lengths.

    Attributes
    ----------
    energy
        energy(r, L) over k theta / A_p, in link lengths.
    stiffness
        Its secant stiffness g(r, L): d(energy)/dr = g r.
    locks
        Whether a chain cannot become longer than L. Where it can, nothing is held below L, and r0 may be above it.
    parameters
        Numbers of its own, keys of `[material]`. Both functions take them by their names.
    values
        Of its parameters (`of`).

    Examples
    --------
    The wormlike chain of the paper, and a spring that never locks:

    >>> from remodel_fenicsx.extend import CHAINS, Chain
    >>> wormlike = CHAINS["wormlike"]
    >>> round(wormlike.force(1.0, contour_length=2.125, persistence_length=1.82), 4)
    0.6113
    >>> CHAINS["spring"] = Chain(lambda r, L: 0.35 * r**2, lambda r, L: 0.7, locks=False)
    >>> round(CHAINS["spring"].force(1.0, contour_length=2.125, persistence_length=1.82), 4)
    0.3846
    >>> del CHAINS["spring"]
    """

    energy: Callable[[UflOrArray, UflOrArray], UflOrArray]
    stiffness: Callable[[UflOrArray, UflOrArray], UflOrArray]
    locks: bool = True
    parameters: Mapping[str, Parameter] = field(default=NO_PARAMETERS, compare=False)
    values: Mapping[str, UflOrArray] = field(default=NO_VALUES, compare=False)
    functions = ("energy", "stiffness")

    def force(
        self,
        end_to_end_length: UflOrArray,
        contour_length: UflOrArray,
        persistence_length: UflOrArray,
        k_theta: UflOrArray = 1.0,
    ) -> UflOrArray:
        """Force that holds the ends of one chain apart: k theta / A_p times the derivative of its energy (eq. 2).

        Parameters
        ----------
        end_to_end_length, contour_length, persistence_length
            r, L and A_p, in one unit of length; numbers, arrays or UFL.
        k_theta
            Boltzmann's constant times the temperature: an energy. With 1 the force is in k theta over that length.
        """
        return k_theta / persistence_length * self.stiffness(end_to_end_length, contour_length) * end_to_end_length


CHAINS: dict[str, Chain] = {"wormlike": Chain(wormlike_energy, wormlike_stiffness)}
