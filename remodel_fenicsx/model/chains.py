"""Chain laws: the free energy of one collagen chain over its end-to-end length.

Pure arithmetic on numbers, arrays or UFL expressions. All lengths are in link lengths of the chain (paper, Remark 1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

BOLTZMANN_CONSTANT = 1.381e-23  # J/K, as printed in the paper


def wormlike_energy(end_to_end_length: Any, contour_length: Any) -> Any:
    """Energy of a wormlike chain over k theta / A_p (eq. 1)."""
    x = end_to_end_length / contour_length
    return contour_length / 4 * (2 * x**2 + 1 / (1 - x) - x)


def wormlike_stiffness(end_to_end_length: Any, contour_length: Any) -> Any:
    """Secant stiffness g(r) = 1/L + 1/(4 r (1-r/L)^2) - 1/(4 r) of eq. (7): d(wormlike_energy)/dr = g r."""
    # Written with the pole at r = 0 cancelled, so that short chains lose no digits.
    x = end_to_end_length / contour_length
    return (1 + (2 - x) / (4 * (1 - x) ** 2)) / contour_length


@dataclass(frozen=True)
class Chain:
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

    energy: Callable[[Any, Any], Any]
    stiffness: Callable[[Any, Any], Any]
    locks: bool = True

    def force(self, end_to_end_length: Any, contour_length: Any, persistence_length: Any, k_theta: Any = 1.0) -> Any:
        """Force that holds the ends of one chain apart: k theta / A_p times the derivative of its energy (eq. 2).

        Parameters
        ----------
        end_to_end_length, contour_length, persistence_length
            r, L and A_p, in one unit of length; numbers, arrays or UFL.
        k_theta
            Boltzmann's constant times the temperature: an energy. With 1 the force is in k theta over that length.
        """
        return k_theta / persistence_length * self.stiffness(end_to_end_length, contour_length) * end_to_end_length


WORMLIKE = Chain(wormlike_energy, wormlike_stiffness)
CHAINS: dict[str, Chain] = {"wormlike": WORMLIKE}
