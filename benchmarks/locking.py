#!/usr/bin/env python3
"""Elements that lock and elements that do not: thick tube, Cook's membrane and the bar of the cardiac benchmark.

    ./with-fenicsx benchmarks/locking.py [--largest N]

Makes docs/locking.md from runs: without chains, in a bulk from soft to stiff, for every formulation; what a run says of
itself beside its error. N (default: all) leaves out meshes with more elements. A quarter of an hour on an idle core.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from remodel_fenicsx import Scene, Simulation
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.scene.presets import PROFILES
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.watch.warnings import LockingWarning, PressureNoise
from tests.locking_bodies import EXACT_TUBE, bar_scene, membrane_scene, registered, thick_tube
from tests.reference.radial import RadialMaterial, solve_radial
from tests.parts import tube

PAGE = Path(__file__).parents[1] / "docs" / "locking.md"
TIP = 4.17  # mm; S. Land et al. 2015, problem 1
HEXAHEDRA, TETRAHEDRA = "hexahedron", "tetrahedron"
DIRECT = {"solver.method": "direct"}  # a new tangent in each iteration: their number tells how hard a step is
COLUMNS_OF_CELLS = (*(f"fibre_angle_{place}" for place in ("inner", "middle", "outer")), "inner_radius", "outer_radius")
RATIOS_OF_CELLS = (8.8, 20.0, 50.0, 100.0, 300.0, 1e3, 1e4)
RATIOS = (5.0, 8.8, 20.0, 49.0, 100.0, 300.0, 1000.0)  # lambda/mu


class Result(NamedTuple):
    """Of a run: the number looked at (None: no equilibrium), Newton iterations, the warning's estimate, elements."""

    value: float | None
    iterations: int
    missing: float
    elements: int

    def error(self, exact: float) -> str:
        """In per cent."""
        return "no equilibrium" if self.value is None else f"{100 * (self.value / exact - 1):+.2f} %"


def result(scene: Scene, column: str, divisions: tuple[int, int, int] | None = None) -> Result:
    """Run a scene."""
    mesh, domain = scene.mesh, None
    if divisions is not None:
        domain = tube(1.0, 3.0, 1.0, 1, mesh.element, mesh.degree, MPI.COMM_SELF, divisions)
    simulation = Simulation(scene, MPI.COMM_SELF, domain)
    rows: list[dict[str, float]] = []
    try:
        for step in simulation.steps():
            rows.append(step.row)
        value: float | None = rows[-1][column]
    except StepFailure:
        value = None
    missing = sum(LockingWarning(simulation.stepper, FORMULATIONS[mesh.formulation].locks).missing())
    simulation.close()
    iterations = int(sum(row["newton_iterations"] for row in rows))
    return Result(value, iterations, missing, simulation.domain.number_of_elements)


# ---------------------------------------------------------------- the tables


def tube_rows(largest: int) -> Iterator[list[str]]:
    """Thick tube in plane strain, without chains: error of the inner displacement against the incompressible one."""
    meshes = [(HEXAHEDRA, 1, (16, 8)), (HEXAHEDRA, 1, (32, 16)), (HEXAHEDRA, 2, (8, 4)), (TETRAHEDRA, 1, (16, 8))]
    for element, degree, (around, through) in meshes:
        if around * through > largest:
            continue
        for name, formulation in FORMULATIONS.items():
            if not formulation.has(element, degree):
                continue
            cells = []
            for ratio in (1e2, 1e3, 1e4):
                scene = thick_tube(ratio, name).with_values({"mesh.element": element, "mesh.degree": degree})
                found = result(scene, "inner_radius", (around, through, 1))
                moved = found._replace(value=None if found.value is None else found.value - 1)
                cells.append(f"{moved.error(EXACT_TUBE)} ({100 * found.missing:.3g} %), {found.iterations}")
            yield [f"{element} {degree}", f"{around} x {through}", name, *cells]


def network_rows() -> Iterator[list[str]]:
    """The same tube with chains: displacement and selective on 16 x 8 against quadratic selective on 8 x 4."""
    for density, pressure in ((2e21, 2.4), (2e22, 7.2), (2e23, 72.0)):
        cells = []
        for ratio in (1e2, 1e3, 1e4):
            fine = thick_tube(ratio, "selective-integration", pressure, chain_density=density)
            exact = result(fine.with_values({"mesh.degree": 2}), "inner_radius", (8, 4, 1)).value
            for name in FORMULATIONS:
                found = result(fine.with_values({"mesh.formulation": name}), "inner_radius", (16, 8, 1))
                moved = None if found.value is None else found.value - 1
                error = found._replace(value=moved).error((exact or 0.0) - 1)
                cells.append(f"{error} ({100 * found.missing:.3g} %)")
        yield [f"{density:g}", f"{fine.material.network_modulus / 3.103:.3g}", f"{pressure:g}", *cells]


def radial_rows() -> Iterator[list[str]]:
    """Tubes on eight elements through the wall, kinematics `radial`: error against a reference that shares no code."""
    for radius in (1.1, 1.5, 3.0, 5.0, 10.0):
        for part in (0.05, 0.5):
            pressure = part * 3.103 * np.log(radius)
            exact = {ratio: reference_displacement(ratio, radius, pressure) for ratio in RATIOS}
            for degree in (1, 2):
                cells = []
                for ratio in RATIOS:
                    changes = {"geometry.outer_radius": radius, "model.kinematics": "radial", "mesh.degree": degree}
                    scene = thick_tube(ratio, "displacement", pressure).with_values(changes)
                    found = result(scene, "inner_radius")
                    moved = found._replace(value=None if found.value is None else found.value - 1)
                    cells.append(f"{moved.error(exact[ratio])} ({100 * found.missing:.3g} %)")
                yield [f"{radius:g}", f"{part:g}", str(degree), *cells]


def reference_displacement(ratio: float, outer_radius: float, pressure: float) -> float:
    """Of the inner face, by 400 quadratic elements of tests/reference/radial.py."""
    material = RadialMaterial(lame_lambda=3.103 * ratio, lame_mu=3.103, network_modulus=0.0)
    found = solve_radial(
        pressure, 0.0, 4.0, 4.0, law="none", outer_radius=outer_radius, elements=400, material=material
    )
    return float(found.inner_radii[-1]) - 1


def turning_rows() -> Iterator[list[str]]:
    """Tubes that remodel, kinematics `radial`: errors of angles and radii against a reference that shares no code."""
    for radius, pressure in ((1.3, 1.2), (2.0, 3.0), (3.0, 4.8)):
        exact = {ratio: reference_cells(ratio, radius, pressure) for ratio in RATIOS_OF_CELLS}
        for degree, name in product((1, 2), FORMULATIONS):
            yield [f"{radius:g}", str(degree), name, *(
                turning_cell(turning_tube(ratio, radius, pressure, degree, name), exact[ratio]) for ratio in exact
            )]  # fmt: skip


def profile_rows() -> Iterator[list[str]]:
    """The thickest of these tubes by profile: errors, and seconds of the processor in the steps."""
    for name, ratio in product(PROFILES, (8.8, 100.0, 1e3, 1e4)):
        tables = turning_tube(ratio, 3.0, 4.8, 1, "auto").model_dump(mode="json", exclude_unset=True)
        scene = scene_from_dict({**tables, "mesh": {}, "profile": name})
        start = time.process_time()
        found = turning_cell(scene, reference_cells(ratio, 3.0, 4.8, scene.mesh.refinement), watched=False)
        mesh = f"degree {scene.mesh.degree}, refinement {scene.mesh.refinement}"
        how = f"{mesh}, {scene.formulation}, {scene.remodeling.coupling}"
        yield [name, f"{ratio:g}", how, found, f"{time.process_time() - start:.1f}"]


def turning_tube(ratio: float, radius: float, pressure: float, degree: int, formulation: str) -> Scene:
    """Isotropic cells that turn by the law "tensor" for two times 1/kappa."""
    ramp = [[0, 0], [20, 1]]
    loads = {"pressure": {"value": pressure, "ramp": ramp}, "elongation": {"value": 0.1, "ramp": ramp}}
    return Scene(
        geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": radius, "length": 2.0},
        material={"lame_lambda": 3.103 * ratio}, cells={"initial": "isotropic"}, model={"kinematics": "radial"},
        mesh={"degree": degree, "formulation": formulation}, remodeling={"law": "tensor"}, loads=loads,
        time={"end": 80.0, "step": 2.5},
    )  # fmt: skip


def turning_cell(scene: Scene, exact: np.ndarray, watched: bool = True) -> str:
    """Largest errors at the end, and by how much the run finds tensions turned by noise."""
    simulation = Simulation(scene, MPI.COMM_SELF)
    watcher, turned = PressureNoise(simulation.stepper), 0.0
    for step in simulation.steps():
        turned = max(turned, watcher.degrees()) if watched else 0.0
    off = np.abs(np.array([step.row[name] for name in COLUMNS_OF_CELLS]) - exact)
    simulation.close()
    said = f" ({turned:.2g})" if watched and FORMULATIONS[scene.formulation].locks else ""
    return f"{off[:3].max():.2f}°, {100 * (off[3:] / exact[3:]).max():.2f} %{said}"


def reference_cells(ratio: float, radius: float, pressure: float, refinement: int = 1) -> np.ndarray:
    """Angles as means over the elements of the mesh, and radii, by 200 quadratic elements and steps of 0.5."""
    material, size = RadialMaterial(lame_lambda=3.103 * ratio, lame_mu=3.103), (radius - 1) / 8 / refinement
    found = solve_radial(pressure, 0.1, 20.0, 80.0, 0.5, law="tensor", outer_radius=radius, material=material)
    middle = (1 + radius) / 2
    places = ((1, 1 + size), (middle - size, middle + size), (radius - size, radius))
    angles = [found.mean_fibre_angle(*place) for place in places]
    return np.array([*angles, found.inner_radii[-1], found.outer_radii[-1]])


def membrane_rows(largest: int) -> Iterator[list[str]]:
    """Cook's membrane: rise of the corner by elements along a side."""
    for degree in (1, 2):
        for name in FORMULATIONS:
            cells = []
            for refinement in (1, 2, 4, 8):
                if degree * refinement > 8 or 16 * refinement**2 > largest:
                    cells.append("")
                    continue
                scene = membrane_scene(formulation=name, degree=degree, refinement=refinement).with_values(DIRECT)
                found = result(scene, "tip")
                cells.append("no equilibrium" if found.value is None else f"{found.value:.3f}, {found.iterations}")
            yield [f"hexahedron {degree}", name, *cells]


def bar_rows(largest: int) -> Iterator[list[str]]:
    """The bar of the cardiac benchmark: z of the tip."""
    for degree, refinement in ((1, 1), (1, 2), (2, 1)):
        elements = 80 * refinement**3
        if elements > largest:
            continue
        for name in FORMULATIONS:
            scene = bar_scene(formulation=name, degree=degree, refinement=refinement).with_values(DIRECT)
            found = result(scene, "tip")
            value = "no equilibrium" if found.value is None else f"{found.value:.3f}"
            yield [f"hexahedron {degree}", str(elements), name, value, found.error(TIP), str(found.iterations)]


def table(head: list[str], rows: Iterator[list[str]]) -> str:
    """As Markdown; says each row as it comes."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for row in rows:
        lines.append("| " + " | ".join(row) + " |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


PAGE_TEXT = """# Elements that lock, and elements that do not

A material that hardly changes its volume may be too much for its elements: they keep the volume
only by not deforming at all. This page measures which elements do so, on bodies whose answer is
known. docs/theory.md, Volumetric locking, has the formulation. docs/appendix_elements.md says how a
run sees it by itself.

## What to take

| body | take |
|---|---|
| any body without a preset, or with a profile | the default, `mesh.formulation = "auto"` |
| a preset's body with lambda/mu above 10 | `mesh.formulation = "auto"`: presets have the paper's elements |
| tetrahedra | degree 2. Linear ones have no remedy, and a run says so |
| large lambda/mu with the coupling `implicit` or an opening angle | degree 2, and elements so small that no run warns |

`auto` takes `selective-integration` where lambda/mu is above 10 (quadratic tetrahedra: 300), unless
the coupling `implicit`, a natural configuration or a matrix of one's own needs `displacement`. The
log and the scene as run have the name.

## Cells that turn

The cells take the stress at each quadrature point. In a stiff bulk the pressure there, lambda ln J,
is noise: displacements hardly see it, for its mean over an element is right, and the tensions that
turn the cells are wrong. Radii follow the cells.

Tubes of isotropic cells under pressure (1.2, 3 and 4.8) and an elongation of 0.1 remodel by the law
`tensor` for a time of 2/kappa, on eight elements through the wall. The columns are lambda/mu. Each
entry has the largest error of the three angles and that of the radii, against 200 quadratic
elements of a reference that shares no code.

In parentheses stands the angle by which the run itself finds the tensions turned by noise. A run
warns above 2 degrees, where lambda/mu is above 10.

{turning}

The profiles on the thickest of these tubes. The seconds are of the processor, with building the
simulation.

{profiles}

## Thick tube

Radii 1 and 3, plane strain, no chains, pressure 2 in four steps, mu = 3.103. The table has three
numbers for each mesh, formulation and lambda/mu:

1. the error of the inner displacement against {exact}, that of the incompressible tube (at
   lambda/mu = 100 the body itself moves {compressible} % more);
2. in parentheses what the run itself says is missing; the warning comes above 5 %;
3. the Newton iterations of all four steps.

{tube}

**With chains** (isotropic cells that do not remodel), on 16 x 8 linear hexahedra, against quadratic
ones on 8 x 4 with `selective-integration`. c is the network modulus.

{network}

The stiffer the network, the less the same lambda/mu locks. The estimate of a run knows this,
lambda/mu does not. (Sixteen plane sides are 2 % off by themselves.)

## What a run says of itself

Tubes of inner radius 1 and outer radius R_o, no chains, length held, kinematics `radial` with its
eight elements through the wall. The pressure is the given part of mu ln R_o, the one that bursts an
incompressible tube. The table has the error of the inner displacement against 400 quadratic
elements of `tests/reference/radial.py`, and in parentheses what the run says is missing.

{radial}

## Cook's membrane

A slab in plane strain is clamped on the left. 100 of dead force pull it upwards on the right;
mu = 80.194, lambda/mu = 1e4. The table has the rise of the upper right corner by elements on a
side, and the Newton iterations of all four steps.

{membrane}

## The bar of the cardiac mechanics benchmark

S. Land et al., Proc. R. Soc. A 471 (2015) 20150641, problem 1. The bar is 10 x 1 x 1 mm and clamped
at x = 0. Its law is transversely isotropic and exponential, with fibres along the bar;
lambda/C = 1e3. A pressure of 0.004 kPa acts on the deformed bottom. The participants of the
benchmark agree on a tip at z = {tip} mm.

The matrix energy and the shape are given from outside of the package (`tests/locking_bodies.py`).

{bar}

Made by `./with-fenicsx benchmarks/locking.py` with {versions}.
"""


def main() -> None:
    """Make the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--largest", type=int, default=10**9, help="leave out meshes of more elements; makes no page")
    largest = parser.parse_args().largest
    ratios = ["1e2", "1e3", "1e4"]
    both = [f"{name.split('-')[0]}, {ratio}" for ratio in ratios for name in FORMULATIONS]
    slab = thick_tube(1e2, "selective-integration").with_values({"mesh.degree": 2})
    compressible = (result(slab, "inner_radius", (8, 4, 1)).value or 0.0) - 1
    tables: dict[str, Any] = {
        "tube": table(
            ["elements", "around x through", "formulation", *(f"lambda/mu = {r}" for r in ratios)], tube_rows(largest)
        ),
        "radial": table(["R_o", "pressure", "degree", *(f"lambda/mu = {ratio:g}" for ratio in RATIOS)], radial_rows()),
        "turning": table(
            ["R_o", "degree", "formulation", *(f"{ratio:g}" for ratio in RATIOS_OF_CELLS)], turning_rows()
        ),
        "profiles": table(["profile", "lambda/mu", "as run", "off by", "seconds"], profile_rows()),
        "network": table(["chains per m^3", "c/mu", "pressure", *both], network_rows()),
    }
    with registered():
        tables["membrane"] = table(["elements", "formulation", "4", "8", "16", "32"], membrane_rows(largest))
        tables["bar"] = table(
            ["elements", "number", "formulation", "tip (mm)", "error", "iterations"], bar_rows(largest)
        )
    made_by = ", ".join(
        f"{name} {version}" for name, version in versions().items() if name in ("remodel_fenicsx", "dolfinx")
    )
    text = PAGE_TEXT.format(
        versions=made_by,
        exact=EXACT_TUBE,
        tip=TIP,
        compressible=f"{100 * (compressible / EXACT_TUBE - 1):.2f}",
        **tables,
    )
    if largest == 10**9:
        PAGE.write_text(text)


if __name__ == "__main__":
    main()
