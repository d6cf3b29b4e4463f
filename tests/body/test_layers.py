"""A tube of two layers held against an independent one-dimensional solver; equal layers are one layer."""

from __future__ import annotations

import runpy
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Scene
from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.body.tube import whole_tube
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.scene import scene_from_dict
from remodel_fenicsx.simulation import Simulation
from tests.reference.radial import RadialHistory, RadialMaterial, Tube, solve_radial
from tests.runs import last_row, rows_of
from tests.values import isotropic, ramped

SELF = MPI.COMM_SELF
INTERFACE, END = 1.5, 12.0
MEDIA = {"chain_density": 1.5e21, "lame_mu": 2.0, "contour_length": 1.7}
ADVENTITIA = {
    "chain_density": 4.0e21,
    "lame_lambda": 40.0,
    "temperature": 320.0,
    "persistence_length": 1.2,
}
# pressure and elongation; those of laws whose cells jump where principal values cross let none cross
LOADS = dict.fromkeys(("explicit", "tensor"), (3.0, 0.3)) | dict.fromkeys(
    ("rate", "relaxation"), (4.8, 0.1)
)
LENGTHS, R0 = [0.63, 0.63, 0.63], 0.63 * 3**0.5  # initial cells of the adventitia
KAPPA = {"media": 0.06, "adventitia": 0.02}
LAYERS: dict[str, Any] = {
    "media": {"outer_radius": INTERFACE, "material": MEDIA, "remodeling": {"kappa": KAPPA["media"]}},
    "adventitia": {"material": ADVENTITIA, "remodeling": {"kappa": KAPPA["adventitia"]},
                   "cells": {"initial": LENGTHS, "end_to_end_length": R0}},
}  # fmt: skip


def scene(regions: Any = LAYERS, law: str = "explicit", **changes: Any) -> Scene:
    """The artery, short, with fast loads; on one radius where that is allowed."""
    pressure, elongation = LOADS[law]
    values = isotropic(
        None, "auto", geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 0.5},
        regions=regions, loads=ramped(8.0, pressure=pressure, elongation=elongation), material={"repulsion": "axes"},
        remodeling={"law": law, "coupling": "staggered"}, mesh={"degree": 2, "formulation": "displacement"},
        time={"end": END},
        solver={"method": "direct"},
    )  # fmt: skip
    return Scene(**values).with_values(changes)


@lru_cache
def reference(law: str, step: float = 1.0, elements: int = 200) -> RadialHistory:
    """The same typed from the paper's equations, with parameters by point; the interface lies between two elements."""
    points = Tube(1.0, 3.0, elements, RadialMaterial()).points
    inside = points[:, None] < INTERFACE

    def modulus(density: float, temperature: float = 310.0, persistence: float = 1.365) -> float:
        return 1.380649e-23 * temperature * density / (4 * persistence)

    material = RadialMaterial(
        np.where(inside, 27.293, 40.0), np.where(inside, 2.0, 3.103),
        np.where(inside, modulus(1.5e21), modulus(4e21, 320.0, 1.2)), np.where(inside, 1.7, 1.594),
        np.where(inside, 1.0, R0),
    )  # fmt: skip
    initial = np.where(inside, 1 / np.sqrt(3), np.array(LENGTHS))
    return solve_radial(
        pressure=LOADS[law][0], stretch=LOADS[law][1], ramp_time=8.0, end=END, step=step, law=law,
        kappa=np.where(inside, 0.06, 0.02), elements=elements, material=material, initial=initial,
    )  # fmt: skip


def held_against(law: str, simulation: Simulation) -> tuple[float, float, float]:
    """Largest relative error of a radius over all steps, and of the mean angle of each layer at the end, degrees."""
    steps, exact = list(simulation.steps()), reference(law)
    radii = np.array([[step.row["inner_radius"], step.row["outer_radius"]] for step in steps])
    error = np.abs(radii / np.stack([exact.inner_radii, exact.outer_radii], axis=1) - 1).max()
    angle, domain = Measurement(simulation.observer, steps[-1]).fibre_angle, simulation.domain
    means = [
        simulation.quadrature.nanmean(angle, domain.element_region == domain.regions[n])
        for n in LAYERS
    ]
    known = exact.mean_fibre_angle(1.0, INTERFACE), exact.mean_fibre_angle(INTERFACE, 3.0)
    simulation.close()
    return float(error), *(abs(found - right) for found, right in zip(means, known, strict=True))


@pytest.mark.parametrize("law", ["explicit", "rate", "relaxation", "tensor"])
def test_two_layers_on_one_radius_are_those_of_the_reference(law: str) -> None:
    """Parameters, kappa and initial cells by layer; 0.2 degrees and 0.3 % are asked for."""
    radius, media, adventitia = held_against(
        law, Simulation(scene(law=law, **{"mesh.refinement": 4}), SELF)
    )
    assert radius < 3e-4 and media < 0.1 and adventitia < 0.1


def test_extrapolated_steps_come_to_the_limit_of_short_steps() -> None:
    """Cells of the reference lag by a step, and are extrapolated to none."""
    known = []
    for short in (0.1, 0.05):
        exact = reference("tensor", short, 40)
        known.append(
            [exact.mean_fibre_angle(1.0, INTERFACE, -2), exact.mean_fibre_angle(INTERFACE, 3.0, -2)]
        )
    limit = 2 * np.array(known[1]) - np.array(known[0])
    changes = {"remodeling.coupling": "extrapolated", "time.step": 0.5, "material.repulsion": "log"}
    row = last_row(scene(law="tensor", **changes, **{"mesh.refinement": 2}))
    found = [row["fibre_angle_media"], row["fibre_angle_adventitia"]]
    np.testing.assert_allclose(found, limit, rtol=0, atol=0.03)
    assert np.abs(limit - known[1]).min() > 0.02  # more than the errors that are left


def test_two_layers_in_three_dimensions_are_those_of_the_reference() -> None:
    full = scene(**{"model.kinematics": "full"})
    domain = whole_tube(full.geometry, (8, 8, 1), "hexahedron", 2, SELF, full.regions)  # type: ignore[arg-type]
    radius, media, adventitia = held_against("explicit", Simulation(full, SELF, domain))
    assert radius < 3e-3 and media < 0.2 and adventitia < 0.2


def write_layers(
    path: Path, radii: Any = (1.0, INTERFACE, 3.0), turn: Any = None, around: int = 12
) -> Path:
    """The same tube as a mesh file by the script of a demo, whose numbers are set and whose bend is left out."""
    script: Any = runpy.run_path(
        str(Path(__file__).parents[2] / "demos" / "bent_vessel" / "mesh.py")
    )
    numbers = {"RADII": radii, "LENGTH": 0.5, "AROUND": around, "THROUGH": 2, "ALONG": 1}
    script["straight"].__globals__.update(numbers)
    with gmsh_model("layers") as gmsh:
        script["straight"]()
        script["name_parts"]()
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(2)
        if turn is not None:
            tags, places, _ = gmsh.model.mesh.getNodes()
            for tag, place in zip(tags, places.reshape(-1, 3) @ np.asarray(turn).T, strict=True):
                gmsh.model.mesh.setNode(tag, place, [])
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(path))
    return path


def test_two_layers_of_a_mesh_file_are_those_of_the_reference(tmp_path: Path) -> None:
    """Axes, depth and ends are found or held by springs, as for any vessel; 0.2 degrees and 0.3 % are asked for."""
    values = scene().model_dump(exclude_unset=True) | {
        "geometry": {"shape": "mesh", "file": str(write_layers(tmp_path / "layers.msh", around=20))},
        "output": {"fields": False, "columns": ["outer_area"]}, "mesh": {"formulation": "displacement"}, "model": {},
        "cells": {"initial": "isotropic"},
    }  # fmt: skip
    values["regions"] = {
        name: {k: v for k, v in r.items() if k != "outer_radius"} for name, r in LAYERS.items()
    }
    simulation, exact = Simulation(scene_from_dict(values), SELF), reference("explicit")
    steps = list(simulation.steps())
    length = np.array([0.5 * (1 + step.row["axial_elongation"]) for step in steps])
    inner = np.sqrt(np.array([step.row["lumen_volume"] for step in steps]) / (np.pi * length))
    outer = np.array([step.row["outer_area"] for step in steps]) / (2 * np.pi * length)
    for found, known in ((inner, exact.inner_radii), (outer, exact.outer_radii)):
        np.testing.assert_allclose(found, known, rtol=3e-3)
    angle, domain = Measurement(simulation.observer, steps[-1]).fibre_angle, simulation.domain
    for name, limits in (("media", (1.0, INTERFACE)), ("adventitia", (INTERFACE, 3.0))):
        mean = simulation.quadrature.nanmean(angle, domain.element_region == domain.regions[name])
        assert mean == pytest.approx(exact.mean_fibre_angle(*limits), abs=0.2), name
    simulation.close()


def rows(made: Scene) -> np.ndarray:
    """Columns of the whole body, but those of time and work."""
    found = rows_of(made)
    names = [name for name in found[0] if "seconds" not in name and "iterations" not in name and "media" not in name
             and "adventitia" not in name]  # fmt: skip
    return np.array([[row[name] for name in names] for row in found])


@pytest.mark.parametrize("kinematics", ["radial", "full"])
def test_equal_layers_are_one_layer(kinematics: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once as numbers, as they are where nothing differs, and once with functions that have the same values."""
    monkeypatch.setattr("remodel_fenicsx.body.tube.PAPER", (8, 2, 1))
    short = {"time.end": 3.0, "model.kinematics": kinematics}
    one = rows(scene({}, **short))
    halves: dict[str, Any] = {"media": {"outer_radius": 2.0}, "adventitia": {}}
    np.testing.assert_allclose(rows(scene(halves, **short)), one, rtol=1e-10, atol=1e-10)
    halves["media"]["material"] = {"lame_mu": 3.103 * (1 + 1e-15)}
    halves["media"]["remodeling"] = {"kappa": 0.025 * (1 + 1e-15)}
    differing = scene(halves, **short)
    assert differing.properties()["media"].kappa != differing.properties()["adventitia"].kappa
    np.testing.assert_allclose(rows(differing), one, rtol=1e-10, atol=1e-10)


def test_initial_cells_of_a_region_are_drawn_as_those_of_the_body() -> None:
    """The same seed and element: the same cell; elsewhere what the region says."""
    made = scene({"media": {"outer_radius": 2.0, "cells": {"initial": "random"}}, "adventitia": {}},
                 **{"model.kinematics": "full", "mesh.degree": 1})  # fmt: skip
    whole = Simulation(
        scene({}, **{"model.kinematics": "full", "mesh.degree": 1, "cells.initial": "random"}), SELF
    )
    layered = Simulation(made, SELF)
    media = layered.domain.element_region == layered.domain.regions["media"]
    assert np.array_equal(
        layered.cells.dimension_values[media], whole.cells.dimension_values[media]
    )
    assert np.ptp(layered.cells.dimension_values[~media]) == 0.0
    for simulation in (whole, layered):
        simulation.close()
