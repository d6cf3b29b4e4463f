#!/usr/bin/env python3
"""Elements that lock and elements that do not: a thick tube without chains, and tubes that remodel.

    ./with-fenicsx benchmarks/locking.py

Makes two tables of docs/what_may_go_wrong.md from runs, in a bulk from soft to stiff, for every formulation: errors,
and beside them what a run says of itself. Some minutes on an idle core.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from mpi4py import MPI

from docs.making.pages import DOCS, between_marks, markdown
from remodel_fenicsx import Scene
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.watch.warnings import LockingWarning, PressureNoise
from tests.locking_bodies import EXACT_TUBE, thick_tube
from tests.reference.radial import RadialMaterial, solve_radial
from tests.parts import tube
from tests.runs import made

MESHES = [  # elements, their degree, and how many of them go around and through
    ("hexahedron", 1, 16, 8), ("hexahedron", 1, 32, 16), ("hexahedron", 2, 8, 4), ("tetrahedron", 1, 16, 8),
]  # fmt: skip
COLUMNS_OF_CELLS = (
    *(f"fibre_angle_{place}" for place in ("inner", "middle", "outer")),
    "inner_radius",
    "outer_radius",
)
RATIOS_OF_CELLS = (8.8, 100.0, 1e3, 1e4)  # lambda/mu


def tube_rows() -> Iterator[list[str]]:
    """Thick tube in plane strain, without chains: error of the inner displacement against the incompressible one."""
    for element, degree, around, through in MESHES:
        for name, formulation in FORMULATIONS.items():
            if formulation.applies_to(element, degree):
                scene = thick_tube(1e2, name).with_values(
                    {"mesh.element": element, "mesh.degree": degree}
                )
                scenes = [
                    scene.with_values({"material.lame_lambda": 3.103 * ratio})
                    for ratio in (1e2, 1e3, 1e4)
                ]
                cells = [tube_cell(one, (around, through, 1)) for one in scenes]
                yield [f"{element} {degree}", f"{around} x {through}", name, *cells]


def tube_cell(scene: Scene, divisions: tuple[int, int, int]) -> str:
    """Error of a run, in parentheses what it says is missing, and Newton iterations."""
    mesh = scene.mesh
    domain = tube(1.0, 3.0, 1.0, 1, mesh.element, mesh.degree, MPI.COMM_SELF, divisions)
    with made(scene, domain) as simulation:
        rows = [step.row for step in simulation.steps()]
        missing = sum(
            LockingWarning(
                simulation.stepper, FORMULATIONS[mesh.formulation].locks
            ).missing_deformation()
        )
    off = (rows[-1]["inner_radius"] - 1.0) / EXACT_TUBE - 1
    iterations = sum(row["newton_iterations"] for row in rows)
    return f"{100 * off:+.2f} % ({100 * missing:.3g} %), {iterations:.0f}"


def turning_rows() -> Iterator[list[str]]:
    """Tubes that remodel, kinematics `radial`: errors of angles and radii against a reference that shares no code."""
    for radius, pressure in ((1.3, 1.2), (3.0, 4.8)):
        exact = {ratio: reference_cells(ratio, radius, pressure) for ratio in RATIOS_OF_CELLS}
        for degree, name in product((1, 2), FORMULATIONS):
            yield [f"{radius:g}", str(degree), name, *(
                turning_cell(turning_tube(ratio, radius, pressure, degree, name), exact[ratio]) for ratio in exact
            )]  # fmt: skip


def turning_tube(
    ratio: float, radius: float, pressure: float, degree: int, formulation: str
) -> Scene:
    """Isotropic cells that turn by the law "tensor" for two times 1/kappa."""
    ramp = [[0, 0], [20, 1]]
    loads = {
        "pressure": {"value": pressure, "ramp": ramp},
        "elongation": {"value": 0.1, "ramp": ramp},
    }
    return Scene(
        geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": radius, "length": 2.0},
        material={"lame_lambda": 3.103 * ratio}, cells={"initial": "isotropic"}, model={"kinematics": "radial"},
        mesh={"degree": degree, "formulation": formulation}, remodeling={"law": "tensor"}, loads=loads,
        time={"end": 80.0, "step": 2.5},
    )  # fmt: skip


def turning_cell(scene: Scene, exact: np.ndarray) -> str:
    """Largest errors at the end, and by how much the run finds tensions turned by noise."""
    turned, row = 0.0, {}
    with made(scene) as simulation:
        watcher = PressureNoise(simulation.stepper)
        for step in simulation.steps():
            turned, row = max(turned, watcher.degrees()), step.row
    off = np.abs(np.array([row[name] for name in COLUMNS_OF_CELLS]) - exact)
    said = f" ({turned:.2g})" if FORMULATIONS[scene.formulation].locks else ""
    return f"{off[:3].max():.2f}°, {100 * (off[3:] / exact[3:]).max():.2f} %{said}"


def reference_cells(ratio: float, radius: float, pressure: float) -> np.ndarray:
    """Angles as means over the elements of the mesh, and radii, by 200 quadratic elements and steps of 0.5."""
    material, size = RadialMaterial(lame_lambda=3.103 * ratio, lame_mu=3.103), (radius - 1) / 8
    found = solve_radial(
        pressure, 0.1, 20.0, 80.0, 0.5, law="tensor", outer_radius=radius, material=material
    )
    middle = (1 + radius) / 2
    places = ((1, 1 + size), (middle - size, middle + size), (radius - size, radius))
    angles = [found.mean_fibre_angle(*place) for place in places]
    return np.array([*angles, found.inner_radii[-1], found.outer_radii[-1]])


def table(head: Sequence[str], rows: Iterator[list[str]]) -> str:
    """As Markdown; says each row as it comes."""
    found = []
    for row in rows:
        found.append(row)
        print(" | ".join(row), flush=True)
    return markdown(head, found)


def main() -> None:
    """Make the tables."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    over = [f"lambda/mu = {ratio}" for ratio in ("1e2", "1e3", "1e4")]
    tables = {
        "turning": table(
            ["R_o", "degree", "formulation", *map("{:g}".format, RATIOS_OF_CELLS)], turning_rows()
        ),
        "tube": table(["elements", "around x through", "formulation", *over], tube_rows()),
    }
    page = DOCS / "what_may_go_wrong.md"
    text = page.read_text(encoding="utf-8")
    for name, rows in tables.items():
        text = between_marks(text, name, rows)
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
