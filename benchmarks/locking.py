#!/usr/bin/env python3
"""Elements that lock and elements that do not: thick tube, Cook's membrane and the bar of the cardiac benchmark.

    ./with-fenicsx benchmarks/locking.py [--largest N]

Makes two tables of docs/what_may_go_wrong.md, and results/locking.md with all of them, from runs: without chains, in
a bulk from soft to stiff, for every formulation; what a run says of itself beside its error. N (default: all) leaves
out meshes with more elements. A quarter of an hour on an idle core.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from docs.making.pages import DOCS, between_marks, filled, made_with, markdown
from remodel_fenicsx import Scene
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.scene.presets import PROFILES
from remodel_fenicsx.scene.scene import scene_from_dict
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.watch.warnings import LockingWarning, PressureNoise
from tests.locking_bodies import EXACT_TUBE, bar_scene, membrane_scene, registered, thick_tube
from tests.reference.radial import RadialMaterial, solve_radial
from tests.parts import tube
from tests.runs import made

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
        """In per cent, and what the run says is missing."""
        return f"{self.off(exact)} ({100 * self.missing:.3g} %)"

    def off(self, exact: float) -> str:
        """In per cent."""
        return "no equilibrium" if self.value is None else f"{100 * (self.value / exact - 1):+.2f} %"


def result(
    scene: Scene, column: str = "inner_radius", divisions: tuple[int, int, int] | None = None, start: float = 1.0
) -> Result:
    """Run a scene: by how much its column differs from its start."""
    mesh, domain = scene.mesh, None
    if divisions is not None:
        domain = tube(1.0, 3.0, 1.0, 1, mesh.element, mesh.degree, MPI.COMM_SELF, divisions)
    rows: list[dict[str, float]] = []
    value: float | None = None
    with made(scene, domain) as simulation:
        with suppress(StepFailure):
            for step in simulation.steps():
                rows.append(step.row)
            value = rows[-1][column] - start
        missing = sum(LockingWarning(simulation.stepper, FORMULATIONS[mesh.formulation].locks).missing())
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
                found = result(scene, divisions=(around, through, 1))
                cells.append(f"{found.error(EXACT_TUBE)}, {found.iterations}")
            yield [f"{element} {degree}", f"{around} x {through}", name, *cells]


def network_rows() -> Iterator[list[str]]:
    """The same tube with chains: displacement and selective on 16 x 8 against quadratic selective on 8 x 4."""
    for density, pressure in ((2e21, 2.4), (2e22, 7.2), (2e23, 72.0)):
        cells = []
        for ratio in (1e2, 1e3, 1e4):
            fine = thick_tube(ratio, "selective-integration", pressure, chain_density=density)
            exact = result(fine.with_values({"mesh.degree": 2}), divisions=(8, 4, 1)).value or np.nan
            for name in FORMULATIONS:
                cells.append(result(fine.with_values({"mesh.formulation": name}), divisions=(16, 8, 1)).error(exact))
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
                    cells.append(result(scene).error(exact[ratio]))
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
    turned, row = 0.0, {}
    with made(scene) as simulation:
        watcher = PressureNoise(simulation.stepper)
        for step in simulation.steps():
            turned, row = max(turned, watcher.degrees()) if watched else 0.0, step.row
    off = np.abs(np.array([row[name] for name in COLUMNS_OF_CELLS]) - exact)
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
                found = result(scene, "tip", start=0.0)
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
            found = result(scene, "tip", start=0.0)
            value = "no equilibrium" if found.value is None else f"{found.value:.3f}"
            yield [f"hexahedron {degree}", str(elements), name, value, found.off(TIP), str(found.iterations)]


def table(head: Sequence[str], rows: Iterator[list[str]]) -> str:
    """As Markdown; says each row as it comes."""
    made = []
    for row in rows:
        made.append(row)
        print(" | ".join(row), flush=True)
    return markdown(head, made)


def main() -> None:
    """Make the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--largest", type=int, default=10**9, help="leave out meshes of more elements; makes no page")
    largest = parser.parse_args().largest
    ratios = ["1e2", "1e3", "1e4"]
    both = [f"{name.split('-')[0]}, {ratio}" for ratio in ratios for name in FORMULATIONS]
    over = [f"lambda/mu = {ratio}" for ratio in ratios]
    slab = thick_tube(1e2, "selective-integration").with_values({"mesh.degree": 2})
    compressible = result(slab, divisions=(8, 4, 1)).value or np.nan
    turning = [*turning_rows()]
    chosen = [0, 1, 2, *(3 + RATIOS_OF_CELLS.index(ratio) for ratio in (8.8, 100.0, 1e3, 1e4))]
    head = ["R_o", "degree", "formulation", *map("{:g}".format, RATIOS_OF_CELLS)]
    on_page = markdown([head[k] for k in chosen], ([row[k] for k in chosen] for row in turning if row[0] != "2"))
    words = {
        "tube": table(["elements", "around x through", "formulation", *over], tube_rows(largest)),
        "radial": table(["R_o", "pressure", "degree", *(f"lambda/mu = {ratio:g}" for ratio in RATIOS)], radial_rows()),
        "turning": table(head, iter(turning)),
        "profiles": table(["profile", "lambda/mu", "as run", "off by", "seconds"], profile_rows()),
        "network": table(["chains per m^3", "c/mu", "pressure", *both], network_rows()),
        "exact": f"{EXACT_TUBE}", "tip": f"{TIP}", "versions": made_with(),
        "compressible": f"{100 * (compressible / EXACT_TUBE - 1):.2f}",
    }  # fmt: skip
    with registered():
        words["membrane"] = table(["elements", "formulation", "4", "8", "16", "32"], membrane_rows(largest))
        head = ["elements", "number", "formulation", "tip (mm)", "error", "iterations"]
        words["bar"] = table(head, bar_rows(largest))
    if largest == 10**9:
        made = filled(Path(__file__).with_suffix(".template.md"), words)
        (DOCS.parent / "results" / "locking.md").write_text(made, encoding="utf-8")
        page = DOCS / "what_may_go_wrong.md"
        text = page.read_text(encoding="utf-8")
        for name, made in (("turning", on_page), ("tube", words["tube"])):
            text = between_marks(text, name, made)
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
