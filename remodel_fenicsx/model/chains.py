"""Chain laws: the free energy of one collagen chain as a function of its end-to-end length.

Pure arithmetic on numbers, arrays or UFL expressions. All lengths are in link lengths of the chain
(paper, Remark 1).
"""

from __future__ import annotations

from remodel_fenicsx._renamed import with_old_names
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, Self, TypeAlias, TypeVar


UflOrArray: TypeAlias = Any  # type: ignore[explicit-any]
"""UFL expression, array over points or number; UFL has no types for its expressions."""

Result = TypeVar("Result", covariant=True)


class Formula(Protocol[Result]):
    """Function of UFL or arrays; components with additional parameters get these by keyword."""

    def __call__(self, *values: UflOrArray, **parameters: UflOrArray) -> Result: ...


BOLTZMANN_CONSTANT = 1.381e-23  # J/K, as printed in the paper


def wormlike_energy(end_to_end_length: UflOrArray, contour_length: UflOrArray) -> UflOrArray:
    """Return the energy of a wormlike chain divided by k theta / A_p (eq. 1)."""
    x = end_to_end_length / contour_length
    return contour_length / 4 * (2 * x**2 + 1 / (1 - x) - x)


def wormlike_stiffness(end_to_end_length: UflOrArray, contour_length: UflOrArray) -> UflOrArray:
    """Return g(r) = 1/L + 1/(4 r (1-r/L)^2) - 1/(4 r) of eq. (7); d(wormlike_energy)/dr = g r."""
    # The pole at r = 0 is cancelled, so that short chains lose no digits.
    x = end_to_end_length / contour_length
    return (1 + (2 - x) / (4 * (1 - x) ** 2)) / contour_length


@with_old_names
@dataclass(frozen=True)
class Parameter:
    """Additional parameter of a component: a key of the table in which a scene names the component.

    Attributes
    ----------
    default
        Value if the scene does not set it.
    meaning
        Description in one sentence.
    exclusive_minimum
        Exclusive minimum; None allows any finite number.

    Examples
    --------
    >>> from remodel_fenicsx.extend import Parameter
    >>> Parameter(0.5, "Length of a link, in those of the paper.", exclusive_minimum=0.0).default
    0.5
    """

    default: float
    meaning: str
    exclusive_minimum: float | None = None


NO_PARAMETERS: Mapping[str, Parameter] = MappingProxyType({})
NO_VALUES: Mapping[str, UflOrArray] = MappingProxyType({})


@with_old_names
class WithParameters:
    """Component whose functions may take additional parameters, which `with_parameters` binds."""

    functions: ClassVar[tuple[str, ...]]
    parameters: Mapping[str, Parameter]

    def with_parameters(self, values: Mapping[str, UflOrArray]) -> Self:
        """Return the component with bound values of its parameters.

        Parameters
        ----------
        values
            Numbers, arrays or UFL by the names of `parameters`.
        """
        if not values:
            return self
        functions = {name: getattr(self, name) for name in self.functions}
        bound = {
            name: partial(function, **values) for name, function in functions.items() if function
        }
        return replace(self, values=values, **bound)  # type: ignore[type-var]


@dataclass(frozen=True)
class Chain(WithParameters):
    """Law of a single chain: energy and force (paper, eq. 2).

    Both functions take numbers, arrays or UFL; lengths are in link lengths.

    Attributes
    ----------
    energy
        energy(r, L) divided by k theta / A_p, in link lengths.
    stiffness
        Secant stiffness g(r, L): d(energy)/dr = g r.
    locks
        Whether a chain cannot become longer than L. If it does not lock, r has no upper limit, and
        r0 may exceed L.
    parameters
        Additional parameters, keys of `[material]`. Both functions take them by their names.
    values
        Values of the parameters (`with_parameters`).

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
        """Return the force of one chain, k theta / A_p times the energy's derivative (eq. 2).

        Parameters
        ----------
        end_to_end_length, contour_length, persistence_length
            r, L and A_p in the same unit of length; numbers, arrays or UFL.
        k_theta
            Boltzmann's constant times the temperature, an energy. With 1 the force is in k theta
            per unit of length.

        Returns
        -------
        number, array or UFL
            Force in the unit of `k_theta` over the unit of length.
        """
        return (
            k_theta
            / persistence_length
            * self.stiffness(end_to_end_length, contour_length)
            * end_to_end_length
        )


CHAINS: dict[str, Chain] = {"wormlike": Chain(wormlike_energy, wormlike_stiffness)}
