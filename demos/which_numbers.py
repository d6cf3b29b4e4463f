"""Numbers of this model from those of papers: k1, k2, kappa and c of Holzapfel, Gasser and Ogden, or from a table.

    ./with-fenicsx python3 demos/which_numbers.py --k1 2.4 --k2 0.84 --kappa 0.2 --c 3.0 --angle 40 --up-to 1.3
    ./with-fenicsx python3 demos/which_numbers.py --table test.csv

The first one computes nominal stresses of an incompressible sheet under equal stretches along x and y, and pulled along
x alone, by W = c/2 (I1 - 3) + sum_i k1/(2 k2) (exp(k2 E_i^2) - 1), E_i = kappa (I1 - 3) + (1 - 3 kappa)(I_i - 1), with
two families at +-angle to x. The second one reads columns stretch_x and nominal_stress_x (and stretch_y,
nominal_stress_y; without them the sheet is free along y). Least squares find chain_density and contour_length, of a
table lame_mu too where --c is not given. The cells are A/r0^2 = kappa I + (1 - 3 kappa) <a a>, the same dispersion.
The first line says what is assumed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares

from remodel_fenicsx.extend import CHAINS
from remodel_fenicsx.parts import Material
from remodel_fenicsx.scene.presets import aligned_stiffness
from remodel_fenicsx.schema.units import convention_doubt
from remodel_fenicsx.schema.text import read_columns

Array = NDArray[np.float64]
Stress = Callable[[Array], Array]  # lambda_i dW/dlambda_i of three stretches with product 1
CHAIN = CHAINS["wormlike"]
POINTS = 25
MOST, NEAREST = (
    300.0,
    1 - 1e-6,
)  # of an exponent, and of r/L: beyond, searches leave what a computer can say
DECADES, SMALL_STRETCH = (
    6.0,
    1.01,
)  # of stresses over those near 1 that one tissue may have: 1 kPa and 1 GPa
# ends of the logarithms of c, of L over the longest chain less 1, and of mu; stresses over the largest one
ENDS = np.array([[-14.0, -7.0, -12.0], [14.0, 5.0, 7.0]])
UNSEEN = 1e-4  # of the sum of squares, and of the largest stress: what nobody measures
NAMES = ("chain_density", "contour_length", "lame_mu")
COLUMNS = ("stretch_x", "stretch_y", "nominal_stress_x", "nominal_stress_y")


def of_papers(k1: float, k2: float, cells: Array, kappa: float, c: float) -> Stress:
    """Of the energy above; two families have the same I, for the stretches are along x and y."""

    def stress(stretches: Array) -> Array:
        squared = stretches**2
        strain = float(cells @ squared - 1)  # kappa (I1 - 3) + (1 - 3 kappa) (I_i - 1)
        return np.asarray(
            c * squared + 4 * k1 * strain * np.exp(min(k2 * strain**2, MOST)) * cells * squared
        )

    return stress


def of_chains(modulus: float, length: float, cells: Array, mu: float) -> Stress:
    """Of this model: mu l_i^2 + c A_i (g l_i^2 - g0), with r0 = 1."""

    def stress(stretches: Array) -> Array:
        squared = stretches**2
        lengths = min(float(np.sqrt(cells @ squared)), NEAREST * length), 1.0
        stiffness = [float(CHAIN.stiffness(r, length)) for r in lengths]
        return np.asarray(mu * squared + modulus * cells * (stiffness[0] * squared - stiffness[1]))

    return stress


def nominal(stress: Stress, x: float, y: float | None) -> Array:
    """P_x and P_y of a sheet, which is free through its thickness, and along y where no stretch is given."""

    def of(y: float) -> Array:
        parts = stress(np.array([x, y, 1 / (x * y)]))
        return np.asarray((parts[:2] - parts[2]) / [x, y])

    return of(brentq(lambda y: of(y)[1], 0.2, 5.0) if y is None else y)


def fitted(
    rows: Sequence[tuple[float, float | None]], wanted: Array, cells: Array, mu: float | None
) -> tuple[Array, Array]:
    """c, L and mu by least squares of stresses (rows, 2), NaN where there is none; and the misfit of each column.

    ValueError where an unknown is at its end, or could be: such a number is no result.
    """
    known, size = np.isfinite(wanted), float(np.nanmax(np.abs(wanted)))
    places = np.array([(x, y or x**-0.5, 1 / (x * (y or x**-0.5))) for x, y in rows])
    longest = float(np.sqrt((places**2 @ cells).max()))

    def numbers(unknowns: Array) -> Array:
        c, room, own = np.exp(unknowns)
        return np.array([size * c, longest * (1 + room), size * own if mu is None else mu])

    def error(unknowns: Array) -> Array:
        c, length, own = numbers(unknowns)
        stresses = np.array([nominal(of_chains(c, length, cells, own), x, y) for x, y in rows])
        return np.where(known, stresses - wanted, 0.0) / size

    starts = [
        least_squares(lambda u: error(u).ravel(), [c, room, -1.0], bounds=ENDS)
        for c in (-3.0, 0.0)
        for room in (-1.0, 1.0)
    ]
    best = min(starts, key=lambda found: float(found.cost))
    for k, name in enumerate(NAMES[: 3 if mu is None else 2]):
        for end in ENDS[:, k]:
            moved = np.where(np.arange(3) == k, end, best.x)
            if (
                np.sum(error(moved) ** 2) / 2
                <= (1 + UNSEEN) * best.cost + known.sum() * UNSEEN**2 / 2
            ):
                raise ValueError(f"the stresses do not determine {name}: {'any smaller' if end < 0 else 'any larger'} "
                                 f"number than {numbers(best.x)[k]:.2g} fits as well")  # fmt: skip
    shares = [
        np.sqrt(np.mean(error(best.x)[known[:, i], i] ** 2)) if known[:, i].any() else np.nan
        for i in (0, 1)
    ]
    return numbers(best.x), np.array(shares)


def read(path: Path) -> tuple[list[tuple[float, float | None]], Array]:
    """Stretches and nominal stresses of a table."""
    found = read_columns(path.read_bytes(), path.name, COLUMNS, {}, ())
    if not {"stretch_x", "nominal_stress_x"} <= set(found):
        raise ValueError(f"{path}: needs the columns stretch_x and nominal_stress_x")
    empty = np.full(len(found["stretch_x"]), np.nan)
    for name in {"stretch_x", "stretch_y"} & {*found}:
        if (least := float(found[name].min())) <= 0:
            raise ValueError(f"{path}: a stretch is {least}: it must be above 0")
        if words := convention_doubt(name, found[name]):
            raise ValueError(f"{path}: {name} {words}")
    across = [None] * len(empty) if "stretch_y" not in found else found["stretch_y"].tolist()
    stresses = [found[name] if name in found else empty for name in COLUMNS[2:]]
    return list(zip(found["stretch_x"].tolist(), across, strict=True)), np.stack(stresses, axis=1)


def last_of_tissue(curve: Callable[[float], Array], up_to: float) -> float:
    """The largest stretch at which stresses are `DECADES` over those at `SMALL_STRETCH`, or up_to where none is."""
    small = np.abs(curve(SMALL_STRETCH)).max()

    def beyond(stretch: float) -> float:
        return float(np.log10(np.abs(curve(stretch)).max() / small) - DECADES)

    return up_to if beyond(up_to) <= 0 else float(brentq(beyond, SMALL_STRETCH, up_to))


def in_words(c: float, length: float, mu: float, cells: Array, unit: str) -> str:
    """A scene's tables, and the readings of docs/concepts.md."""
    stiffness = c * aligned_stiffness(CHAIN, 1.0, length)
    density = c / Material(chain_density=1.0, stress_unit=unit).network_modulus  # type: ignore[arg-type]
    return f"""[material]
stress_unit = "{unit}"
lame_mu = {mu:.4g}
lame_lambda = {100 * max(mu, stiffness):.4g}          # 100 times matrix or chains: nearly incompressible
chain_density = {density:.4e}     # initial stiffness of aligned chains {stiffness:.4g} {unit}
contour_length = {length:.4f}       # locking stretch of aligned chains {length:.4g}

[cells]
axes = "global"
initial = {[float(f"{value:.8f}") for value in np.sqrt(cells / cells.sum())]}"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Print them."""
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    for name, text, default in (
        ("k1", "of the paper, a stress", None), ("k2", "of the paper", None), ("c", "of the matrix, its mu", None),
        ("kappa", "dispersion, 0 (aligned) to 1/3 (isotropic)", 1 / 3), ("angle", "of the families to x, degrees", 0.0),
        ("up-to", "largest stretch", 1.2),
    ):  # fmt: skip
        parser.add_argument(f"--{name}", type=float, default=default, help=text)
    parser.add_argument("--table", type=Path, help="a csv of stretches and nominal stresses")
    parser.add_argument(
        "--unit", choices=("Pa", "kPa", "MPa"), default="kPa", help="of all stresses"
    )
    given = parser.parse_args(arguments)
    if not 0 <= given.kappa <= 1 / 3:
        parser.error(f"--kappa {given.kappa:g}: must be from 0 to 1/3")
    turn = np.radians(given.angle)
    cells = given.kappa + (1 - 3 * given.kappa) * np.array(
        [np.cos(turn) ** 2, np.sin(turn) ** 2, 0.0]
    )
    assumed = f"cells of dispersion kappa = {given.kappa:.3g}{' (isotropic)' if given.kappa == 1 / 3 else ''}, "
    assumed += f"families at +-{given.angle:g} degrees to x; a volume that stays"
    if given.table is None:
        if (
            None in (given.k1, given.k2, given.c)
            or min(given.k1, given.k2, given.c) <= 0
            or not 1 < given.up_to <= 3
        ):
            parser.error("needs --k1, --k2 and --c above 0 and --up-to from 1 to 3, or --table")
        stress = of_papers(given.k1, given.k2, cells, given.kappa, given.c)
        curves = [lambda x: nominal(stress, x, x), lambda x: nominal(stress, x, None)]
        if (last := min(last_of_tissue(curve, given.up_to) for curve in curves)) < given.up_to:
            highest = max(np.abs(curve(given.up_to)).max() for curve in curves)
            parser.error(f"--up-to {given.up_to:g}: its stresses reach {highest:.2g} {given.unit}, more than "
                         f"{DECADES:g} decades over those at {SMALL_STRETCH:g}; give at most {last:.4g}")  # fmt: skip
        stretches = np.linspace(1.0, given.up_to, POINTS)[1:].tolist()
        rows = [*((x, x) for x in stretches), *((x, None) for x in stretches)]
        wanted = np.array([nominal(stress, x, y) for x, y in rows])
    else:
        try:
            rows, wanted = read(given.table)
        except (OSError, ValueError) as error:
            parser.error(f"--table: {error}")
        if rows[0][1] is None:
            assumed += "; no stress along y"
        sizes = np.nanmax(np.abs(wanted), axis=1)
        small = np.median(sizes[np.argsort([abs(x - 1) for x, _ in rows])[:3]])  # of noise too
        if 0 < (limit := small * 10**DECADES) < sizes.max():
            last = max(
                (x for (x, _), size in zip(rows, sizes, strict=True) if size <= limit), default=1.0
            )
            parser.error(f"--table: stresses reach {sizes.max():.2g} {given.unit}, more than {DECADES:g} decades over "
                         f"those of the smallest stretches; leave out rows beyond stretch_x = {last:.4g}")  # fmt: skip
    wanted[[y is None for _, y in rows], 1] = np.nan  # 0, whatever the numbers
    try:
        numbers, misfit = fitted(rows, wanted, cells, given.c)
    except ValueError as error:
        more = "" if given.c else "--c, "
        parser.error(
            f"{error}, with {assumed}; give {more}other cells (--kappa, --angle) or larger stretches"
        )
    print(f"# Assumed: {assumed}.\n{in_words(*numbers, cells, given.unit)}")
    words = [
        f"{100 * share:.2g} % along {axis}"
        for axis, share in zip("xy", misfit, strict=True)
        if np.isfinite(share)
    ]
    print(f"\nmisfit, root mean square over the largest stress: {', '.join(words)}")


if __name__ == "__main__":
    main()
