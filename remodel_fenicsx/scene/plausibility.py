"""What a scene may say but hardly means: numbers in another unit than the others, told from ratios by decades."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from remodel_fenicsx.body import LoadKind, Shape
from remodel_fenicsx.schema.units import FORCE, STRESS
from remodel_fenicsx.settings import STRESS_UNITS, Load, Material, faces_of

# Decades in which a ratio may lie. Units differ by a thousand and more, choices seldom by a hundred.
NETWORK = (-2, 2)  # initial stiffness of the network over that of the matrix; the paper's bodies: 1.1 and 1.5
LOAD = (-4, 2)  # largest stress of a load over the stiffness of both; the paper's: 0.7 to 4.6. Weak loads are a choice
TEMPERATURES = (250.0, 400.0)  # K: of what is neither ice nor cooked


def doubts(
    material: Material, geometry: Shape, loads: Mapping[str, Load], end_to_end_length: float, end: float
) -> list[str]:
    """Lines on what is hardly meant; none on bodies of plausible tissue.

    Parameters
    ----------
    material, geometry, loads
        Of the scene.
    end_to_end_length
        r0, in link lengths.
    end
        Last time.
    """
    network = chain_stress(material, end_to_end_length)
    found, kinds = [*_of_material(material, network), *_of_lengths(geometry)], geometry.loads_on(faces_of(loads))
    for name, load in loads.items():
        found += _of_load(name, kinds[name], load.largest(end), material, geometry, network)
    return found


def chain_stress(material: Material, end_to_end_length: float) -> float:
    """c g(r0) r0^2, in stress_unit: whatever the unit of chain lengths; 0 without chains."""
    tissue = material.tissue(end_to_end_length)
    return float(tissue.repulsion_modulus * end_to_end_length**2) if tissue.chain is not None else 0.0


def largest_stress(kind: LoadKind, value: float, geometry: Shape) -> float | None:
    """Of a load: a stress itself, or a force over its area; None of an elongation."""
    if kind.dimension == FORCE:
        return value / geometry.loaded_area
    return value if kind.dimension == STRESS else None


def _of_material(material: Material, network: float) -> Iterator[str]:
    unit, lowest, highest = material.stress_unit, *TEMPERATURES
    ratio = network / material.lame_mu
    if network and (way := _beyond(ratio, NETWORK)):
        pascal = STRESS_UNITS[unit]
        density = f": {material.chain_density:g} of a scene in Pa is {material.chain_density * pascal:g} in {unit}"
        yield (
            f"material.chain_density = {material.chain_density:g}: the network (c g(r0) r0^2 = {network:.3g} {unit}) "
            f"is {_times(ratio)} {'softer' if way < 0 else 'stiffer'} than the matrix (lame_mu = "
            f"{material.lame_mu:.4g} {unit}); the density is in 1/m^3 in every scene{density if pascal > 1 else ''}"
        )
    if not lowest <= material.temperature <= highest:
        yield f"material.temperature = {material.temperature:g}: an absolute temperature in K; 37 degC are 310.15"


def _of_lengths(geometry: Shape) -> Iterator[str]:
    for key, words, ratio, decades in geometry.proportions:
        if _beyond(ratio, decades):
            value = getattr(geometry, key)
            unit = "all lengths are in one unit, geometry.length_unit"
            yield f"geometry.{key} = {value:g}: {words} is {ratio:.3g}; {unit}"


def _of_load(
    name: str, kind: LoadKind, value: float, material: Material, geometry: Shape, network: float
) -> Iterator[str]:
    key = f"loads.{name}.value"
    if kind.doubtful is not None and abs(value) >= kind.doubtful[0]:
        yield f"{key}: {value:g} at its largest; {kind.doubtful[1]}"
    stress = largest_stress(kind, value, geometry)
    if not stress:
        return
    ratio = abs(stress) / (material.lame_mu + network)
    if way := _beyond(ratio, LOAD):
        yield (
            f"{key}: a stress of {abs(stress):.3g} {material.stress_unit} at its largest, {_times(ratio)} "
            f"{'more' if way > 0 else 'less'} than the stiffness of matrix and network (lame_mu + c g(r0) r0^2 = "
            f"{material.lame_mu + network:.3g} {material.stress_unit}); all are in one unit, material.stress_unit"
        )


def _beyond(ratio: float, decades: tuple[int, int]) -> int:
    """-1 or 1 where it is below or above them, else 0."""
    return (ratio > 10.0 ** decades[1]) - (ratio < 10.0 ** decades[0])


def _times(ratio: float) -> str:
    """By what it differs from one: two digits, and decades."""
    factor = max(ratio, 1 / ratio)
    return f"{float(f'{factor:.2g}'):g} times ({math.log10(factor):.1f} decades)"
