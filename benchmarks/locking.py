#!/usr/bin/env python3
"""Elements that lock and elements that do not: a thick tube without chains, and tubes that remodel.

    ./with-fenicsx benchmarks/locking.py

Makes two tables of docs/reliability.md from runs, with lambda/mu from small to large: errors of elements that lock
with the run's own estimates, and the largest error with selective integration. Some minutes on an idle core.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from mpi4py import MPI

from docs.making.pages import DOCS, between_marks, markdown, shown
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
RATIOS_OF_TUBES = RATIOS_OF_CELLS[1:]
SELECTIVE = "selective-integration"


def tube_rows() -> Iterator[list[str]]:
    """Thick tube in plane strain, without chains: error of the inner displacement against the incompressible one."""
    for element, degree, around, through in MESHES:
        values = {"mesh.element": element, "mesh.degree": degree}
        errors = {
            name: [
                tube_errors(thick_tube(ratio, name).with_values(values), (around, through, 1))
                for ratio in RATIOS_OF_TUBES
            ]
            for name, formulation in FORMULATIONS.items()
            if formulation.applies_to(element, degree)
        }
        locking = (
            f"{error:+.2f} % ({missing:.3g} %)" for error, missing in errors.pop("displacement")
        )
        best = [f"{np.abs(found)[:, 0].max():.2f} %" for found in errors.values()]
        yield [f"{element} {degree}", f"{around} x {through}", *locking, *(best or ["refused"])]


def tube_errors(scene: Scene, divisions: tuple[int, int, int]) -> tuple[float, float]:
    """Error of a run and its own estimate of the missing displacement, in percent."""
    mesh = scene.mesh
    domain = tube(1.0, 3.0, 1.0, 1, mesh.element, mesh.degree, MPI.COMM_SELF, divisions)
    with made(scene, domain) as simulation:
        rows = [step.row for step in simulation.steps()]
        missing = sum(
            LockingWarning(
                simulation.stepper, FORMULATIONS[mesh.formulation].locks
            ).missing_deformation()
        )
    return 100 * ((rows[-1]["inner_radius"] - 1.0) / EXACT_TUBE - 1), 100 * missing


def turning_rows() -> Iterator[list[str]]:
    """Tubes that remodel, kinematics `radial`: errors of angles and radii against a reference that shares no code."""
    for radius, pressure in ((1.3, 1.2), (3.0, 4.8)):
        exact = {ratio: reference_cells(ratio, radius, pressure) for ratio in RATIOS_OF_CELLS}
        for degree in (1, 2):
            locking, best = (
                [
                    turning_errors(turning_tube(ratio, radius, pressure, degree, name), found)
                    for ratio, found in exact.items()
                ]
                for name in ("displacement", SELECTIVE)
            )
            cells = ("{:.2f}°, {:.2f} % ({:.2g})".format(*errors) for errors in locking)
            largest = "{:.2f}°, {:.2f} %".format(*np.max(best, axis=0))
            yield [f"{radius:g}", str(degree), *cells, largest]


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


def turning_errors(scene: Scene, exact: np.ndarray) -> tuple[float, ...]:
    """Largest errors of angles and radii, %, at the end, and the angle by which the run sees noise rotate tensions."""
    noise, row = 0.0, {}
    with made(scene) as simulation:
        watcher = PressureNoise(simulation.stepper)
        for step in simulation.steps():
            noise, row = max(noise, watcher.degrees()), step.row
    errors = np.abs(np.array([row[name] for name in COLUMNS_OF_CELLS]) - exact)
    return errors[:3].max(), 100 * (errors[3:] / exact[3:]).max(), noise


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


def main() -> None:
    """Make the tables."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    ratios = [f"{ratio:g}" for ratio in RATIOS_OF_CELLS]
    tables = {
        "turning": markdown(["R_o", "degree", *ratios, SELECTIVE], shown(turning_rows())),
        "tube": markdown(
            ["elements", "around x through", *ratios[1:], SELECTIVE], shown(tube_rows())
        ),
    }
    page = DOCS / "reliability.md"
    text = page.read_text(encoding="utf-8")
    for name, rows in tables.items():
        text = between_marks(text, name, rows)
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
