"""Remodeling that is faster where it is warmer: kappa as a function of temperature, in the paper's law.

    remodel-fenicsx run demos/cube.toml --with demos/extensions/kappa_by_temperature.py \\
        --set remodeling.law=arrhenius --set material.temperature=300 --set remodeling.activation_energy=60000

Eq. (11) has kappa exp(-E/R (1/theta - 1/theta_0)) in place of kappa, of each region with its own temperature theta.
The file brings two keys of [remodeling], E in J/mol and theta_0 in K; `remodeling.kappa` is that at theta_0.
"""

from __future__ import annotations

import math
from dataclasses import replace

from remodel_fenicsx.extend import LAWS, Parameter

GAS_CONSTANT = 8.314  # J/(mol K)


def arrhenius(
    kappa: float, temperature: float, activation_energy: float, reference_temperature: float
) -> float:
    """The kappa that acts at a temperature."""
    colder = 1 / temperature - 1 / reference_temperature
    return kappa * math.exp(-activation_energy / GAS_CONSTANT * colder)


LAWS["arrhenius"] = replace(
    LAWS["explicit"],
    speed=arrhenius,
    parameters={
        "activation_energy": Parameter(50e3, "E, in J/mol."),
        "reference_temperature": Parameter(
            310.0, "Temperature theta_0 at which kappa is as given, in K.", exclusive_minimum=0
        ),
    },
)
