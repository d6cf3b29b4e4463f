"""A freely jointed chain in place of the wormlike one, with a key of its own in [material].

    remodel-fenicsx run demos/cube.toml --with demos/extensions/freely_jointed_chain.py \\
        --set material.chain=freely-jointed --set material.links_per_persistence_length=0.5

Links of the length b turn freely against each other. With x = r/L and Cohen's approximation of the inverse Langevin
function, beta = x (3 - x^2)/(1 - x^2), its force is k theta beta / b. A chain law gives what is over k theta / A_p, so
that A_p/b is all that is left of both lengths. With one half the chain has the size of a wormlike chain, b = 2 A_p.
"""

from __future__ import annotations

from typing import Any

from remodel_fenicsx.extend import CHAINS, Chain, Parameter, ln


def energy(r: Any, L: Any, links_per_persistence_length: Any) -> Any:
    """Over k theta / A_p, in link lengths: A_p/b L (x^2/2 - ln(1 - x^2))."""
    x = r / L
    return links_per_persistence_length * L * (x**2 / 2 - ln(1 - x**2))


def stiffness(r: Any, L: Any, links_per_persistence_length: Any) -> Any:
    """g(r) with d(energy)/dr = g r."""
    x = r / L
    return links_per_persistence_length / L * (1 + 2 / (1 - x**2))


CHAINS["freely-jointed"] = Chain(
    energy,
    stiffness,
    parameters={
        "links_per_persistence_length": Parameter(
            0.5, "A_p/b, with the length b of a free link.", exclusive_minimum=0
        ),
    },
)
