"""remodeling.turnover in every kinematics, with every driver, in regions, bodies from a file and natural states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, Simulation
from remodel_fenicsx.model.chains import CHAINS
from remodel_fenicsx.model.drivers import DRIVERS
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.running import run
from remodel_fenicsx.scene import scene_from_dict
from tests.runs import last_row, simulated
from tests.values import TENSION, assert_close, isotropic, ramped

SELF = MPI.COMM_SELF
TURNED = ["content", "natural_length"]
TURNOVER = {"time": 10.0, "deposition_stretch": 1.1, "gain": 1.0} | TENSION
WALL = {"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.3, "length": 2.0}


def grown(
    kinematics: str = "radial", driver: str = "cauchy", pressure: float = 1.2, **tables: Any
) -> Any:
    """A thin tube under load while its collagen is turned over."""
    values: dict[str, Any] = {
        "preset": "consistent",
        "geometry": WALL,
        "mesh": {"degree": 2},
        "remodeling": {"driver": driver, "turnover": TURNOVER},
        "loads": ramped(8.0, pressure=pressure, elongation=0.1),
        "time": {"end": 12.0, "step": 2.0},
        "output": {
            "fields": False,
            "columns": [*TURNED, "inner_radius", "outer_radius", "fibre_angle_outer"],
        },
    }
    return scene_from_dict(isotropic(kinematics=kinematics, **values | tables))


def points_of(simulation: Simulation) -> tuple[Tissue, np.ndarray, np.ndarray]:
    """The tissue as arrays over the points, F_e and the radii there."""
    tissue = simulation.stepper.remodeling.parameters.at_points()
    return (
        tissue,
        simulation.state.elastic_gradient(),
        simulation.quadrature.coordinates[..., 0].ravel(),
    )


def cauchy_of_the_energy(simulation: Simulation) -> np.ndarray:
    """At all points, by differences of W."""
    tissue, F, _ = points_of(simulation)
    cells, h = [simulation.cells.point_cells], 1e-5
    P = np.zeros_like(F)
    for i, j in np.ndindex(3, 3):
        way = np.zeros((3, 3))
        way[i, j] = h
        P[:, i, j] = (
            tissue.strain_energy(F + way, cells) - tissue.strain_energy(F - way, cells)
        ) / (2 * h)
    found: np.ndarray = P @ np.swapaxes(F, 1, 2) / np.linalg.det(F)[:, None, None]
    return found


# ---------------------------------------------------------------- kinematics


def test_fields_are_written_where_there_is_turnover(tmp_path: Path) -> None:
    """All fields have both; of a reduction they are turned to the whole body like any number."""
    remodeling = {"turnover": TURNOVER | {"volume": 0.5}}  # with the kernels of test_growth
    folder = run(
        grown("sector", output={"every": 6, "report": False}, remodeling=remodeling),
        tmp_path / "run",
        SELF,
    )
    fields = Recording(folder).fields(12.0)
    assert {*TURNED} < set(fields) and 1.0 < fields["content"].min() < fields["content"].max()


# ---------------------------------------------------------------- drivers
@pytest.mark.parametrize("repulsion", ["log", "length"])
@pytest.mark.parametrize("driver", DRIVERS)
def test_drivers_see_content_and_natural_length(driver: str, repulsion: str) -> None:
    """Each is that of W with m and rho, by differences."""
    of = grown(driver=driver, material={"repulsion": repulsion})
    with simulated(of) as (simulation, rows):
        F, found = simulation.stepper.remodeling.driving_tensor()
        cauchy = cauchy_of_the_energy(simulation)
    inverse = np.linalg.inv(F)
    expected = {
        "cauchy": cauchy,
        "pk2": np.linalg.det(F)[:, None, None] * inverse @ cauchy @ np.swapaxes(inverse, 1, 2),
        "finger": F @ np.swapaxes(F, 1, 2),
    }
    assert rows[-1]["content"] > 1.2 and rows[-1]["natural_length"] > 1.05
    np.testing.assert_allclose(found, expected[driver], atol=1e-6 * np.abs(found).max())


# ---------------------------------------------------------------- regions
def layers(**outer: Any) -> Any:
    return {"adventitia": outer, "media": {"outer_radius": 1.15}}


def test_regions_of_one_tissue_are_none() -> None:
    fine = {"degree": 2, "refinement": 2}
    plain, layered = (last_row(grown(mesh=fine, regions=regions)) for regions in ({}, layers()))
    assert_close(layered, plain, (*TURNED, "inner_radius", "outer_radius"), 1e-9)


def test_each_region_turns_over_with_its_own_chains() -> None:
    """After the first row ln m and ln rho have the rates of its length L, r0 and chains, written down here."""
    outer = {
        "material": {"contour_length": 1.9, "chain_density": 2.0},
        "cells": {"end_to_end_length": 1.2},
    }
    remodeling = {
        "turnover": TURNOVER,
        "coupling": "staggered",
    }  # the first step is solved with the cells of the start
    of = grown(regions=layers(**outer), time={"end": 2.0, "step": 2.0}, remodeling=remodeling)
    with simulated(of) as (simulation, _):
        tissue, F, radius = points_of(simulation)
        values = simulation.stepper.process("turnover").higher_order()
    g, is_outer = CHAINS["wormlike"].stiffness, radius > 1.15
    L, r0 = np.where(is_outer, 1.9, tissue.contour_length), np.where(is_outer, 1.2, 1.0)
    np.testing.assert_array_equal(tissue.end_to_end_length, r0)
    stretch = np.sqrt((F**2).sum(axis=(1, 2)) / 3)  # of isotropic cells
    tension = stretch * g(stretch * r0, L) / (1.1 * g(1.1 * r0, L))
    content = np.clip(tension - 1.0, -1.0, 1.0) / 10.0
    length = (0.1 + np.maximum(content, 0.0)) * (stretch / 1.1 - 1.0)
    np.testing.assert_allclose(values, 2.0 * np.array([content, length]), rtol=1e-9)
    assert len(set(is_outer)) == 2


# ---------------------------------------------------------------- natural states
def test_closed_ends_and_residual_stress() -> None:
    """The driver is that of W at F_e; the length grows with the tissue; a cut before any growth opens as given."""
    columns = [*TURNED, "opening_angle", "axial_elongation"]
    of = grown(
        natural={"opening_angle": 120.0},
        supports={"ends": "closed"},
        remodeling={"turnover": TURNOVER, "coupling": "staggered"},  # its first row has not grown
        output={"fields": False, "columns": columns},
        loads=ramped(8.0, pressure=1.2, elongation=0.0),
    )
    with simulated(of) as (simulation, rows):
        found, expected = simulation.stepper.remodeling.driving_tensor()[1], cauchy_of_the_energy(
            simulation
        )
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(found).max())
    assert rows[0]["opening_angle"] == pytest.approx(120.0, abs=0.01)
    assert (
        rows[-1]["content"] > 1.2
        and rows[-1]["axial_elongation"] > rows[3]["axial_elongation"] > 0.05
    )


# ---------------------------------------------------------------- ranks
WHOLE = isotropic(
    "consistent", "full", geometry=WALL, cells={"initial": "random"}, remodeling={"turnover": {"time": 10.0}},
    loads=ramped(4.0, pressure=1.2, elongation=0.1), time={"end": 4.0, "step": 2.0},
    cases=[{"weight": 0.6, "loads": {"pressure": 0.8}}, {"weight": 0.4, "loads": {"pressure": 1.3}}],
    output={"columns": [*TURNED, "growth", "inner_radius"]},
)  # fmt: skip
ON_ONE_AND_TWO_RANKS = [{"scene": WHOLE, "divisions": [8, 1, 1]}]


def test_one_and_two_ranks_agree(both_ranks: Any) -> None:
    """Random cells in three dimensions, with two load cases."""
    ((one, two),) = both_ranks
    np.testing.assert_allclose(two["l"], one["l"], atol=1e-9)
    assert_close(two, one, (*TURNED, "growth", "inner_radius@2"), 1e-9, 0.0)
    assert one["inner_radius@2"][-1] > one["inner_radius"][-1] + 0.01
    assert abs(one["content"][-1] - 1.0) > 0.01
