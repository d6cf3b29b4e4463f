"""A body of one's own from a mesh file: a tube as a file is the tube; supports; rigid motions."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx.body import Tube
from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.body.mesh_domain import free_motions
from remodel_fenicsx.body.mesh_faces import Face
from remodel_fenicsx.body.tube import whole_tube
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.scene import scene_from_dict
from remodel_fenicsx.schema.settings import Support
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.results.recording import read_history
from tests.command.test_run import run
from tests.conftest import mpirun
from tests.mesh_files import COUNTS, LENGTH, RADII, write_tube
from tests.processes import ran
from tests.runs import simulated
from tests.values import TURN, assert_close, ramp_to, ramped

LOADS = {
    name: {"value": value, "ramp": ramp_to(2)}
    for name, value in (("pressure", 2.0), ("elongation", 0.1))
}
SHIFT = np.array([10.0, -3.0, 7.0])
FREE = {"kind": "free"}
WORK = {"seconds", "newton_iterations", "linear_iterations"}


def scene_of(file: Path, **tables: Any) -> Any:
    """Of a mesh file, pressed and stretched."""
    values = {
        "geometry": {"shape": "mesh", "file": str(file)}, "cells": {"initial": "isotropic"}, "loads": LOADS,
        "remodeling": {"law": "rate"}, "time": {"end": 2.0, "step": 1.0}, "solver": {"method": "direct"},
    }  # fmt: skip
    return scene_from_dict(values | tables)


def solved(scene: Any, domain: Any = None) -> tuple[dict[str, float], Any, Any]:
    """The last row, displacement of the nodes and their places, in the order of the file."""
    with simulated(scene, domain) as (simulation, rows):
        displacement = simulation.state.gathered_displacement()
        return (
            rows[-1],
            displacement,
            simulation.domain.gather_nodes(simulation.domain.mesh.geometry.x),
        )


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tube(tmp_path_factory.mktemp("mesh") / "tube.msh")


@pytest.fixture(scope="module")
def of_the_file(tube: Path) -> tuple[dict[str, float], Any, Any]:
    return solved(scene_of(tube))


def test_elements_of_a_file_are_those_of_a_body_that_is_drawn(tube: Path) -> None:
    """To the letter, which names their kernels in the cache."""
    drawn = whole_tube(
        Tube(inner_radius=RADII[0], outer_radius=RADII[1], length=LENGTH), COUNTS, "hexahedron", 1
    )
    own = Simulation(scene_of(tube), MPI.COMM_WORLD).domain
    one, other = (repr(body.mesh.ufl_domain().ufl_coordinate_element()) for body in (own, drawn))
    assert one == other


def test_a_tube_as_a_file_is_the_tube(of_the_file: Any) -> None:
    shape = {"shape": "tube", "inner_radius": RADII[0], "outer_radius": RADII[1], "length": LENGTH}
    scene = scene_of(Path("none.msh"), geometry=shape, model={"kinematics": "full"})
    made = whole_tube(
        Tube(inner_radius=RADII[0], outer_radius=RADII[1], length=LENGTH), COUNTS, "hexahedron", 1
    )
    row, displacement, places = solved(scene, made)
    own, own_displacement, own_places = of_the_file
    order, other = np.lexsort(np.round(places, 6).T), np.lexsort(np.round(own_places, 6).T)
    np.testing.assert_allclose(own_places[other], places[order], atol=1e-9)
    # ends are guided by springs, not exactly
    radii, own_radii = (
        np.hypot(*(x + u)[:, :2].T)
        for x, u in (
            (places[order], displacement[order]),
            (own_places[other], own_displacement[other]),
        )
    )
    np.testing.assert_allclose(own_radii, radii, rtol=1e-4)
    np.testing.assert_allclose(own_displacement[other], displacement[order], atol=2e-4)
    for place in ("inner", "middle", "outer"):
        assert own[f"fibre_angle_{place}"] == pytest.approx(row[f"fibre_angle_{place}"], abs=0.05)
    assert own["stored_energy"] == pytest.approx(row["stored_energy"], rel=1e-4)
    inner = np.isclose(np.hypot(*own_places[:, :2].T), RADII[0])
    radius = np.hypot(*(own_places + own_displacement)[inner, :2].T).mean()
    octagon = 4 * np.sin(np.pi / 4) * radius**2
    assert own["lumen_volume"] == pytest.approx(octagon * 1.1 * LENGTH, rel=1e-3)
    assert radius > 1.05 * RADII[0]


@pytest.mark.parametrize("shift", [SHIFT, (1.2e6, -8.5e5, 3.4e6)])
def test_a_turned_and_shifted_file_has_the_same_rows(
    tmp_path: Path, of_the_file: Any, shift: Any
) -> None:
    """Also a million of its radii away, as in the coordinates of a scanner."""
    row, displacement, _ = solved(
        scene_of(write_tube(tmp_path / "turned.msh", turn=TURN, shift=shift))
    )
    own, own_displacement, _ = of_the_file
    np.testing.assert_allclose(displacement, own_displacement @ TURN.T, atol=1e-6)
    assert_close(row, own, row.keys() - WORK, 1e-6)


def test_the_file_of_another_unit(tmp_path: Path, of_the_file: Any) -> None:
    file = write_tube(tmp_path / "metres.msh", turn=1e-3 * np.eye(3))
    geometry = {"shape": "mesh", "file": str(file), "file_unit": "m", "length_unit": "mm"}
    row, _, _ = solved(scene_of(file, geometry=geometry))
    assert row["lumen_volume"] == pytest.approx(of_the_file[0]["lumen_volume"], rel=1e-8)


@pytest.mark.parametrize(
    ("element", "degree"), [("tetrahedron", 1), ("hexahedron", 2), ("tetrahedron", 2)]
)
@pytest.mark.parametrize("version", [2.2, 4.1])
def test_element_and_degree_are_those_of_the_file(
    tmp_path: Path, element: str, degree: int, version: float
) -> None:
    scene = scene_of(write_tube(tmp_path / "tube.msh", element, degree, version))
    assert (scene.mesh.element, scene.mesh.degree) == (element, degree)
    domain = scene.geometry.build(scene.mesh, MPI.COMM_SELF)
    assert domain.length() == pytest.approx(LENGTH, rel=1e-3)
    assert domain.mesh.geometry.cmap.degree == degree
    assert {part.name: round(part.area, 3) for part in domain.boundary.faces} == {
        "inner": 18.369, "outer": 36.738, "inlet": 8.485, "outlet": 8.485
    }  # fmt: skip


def test_held_ends_move_as_they_are_told(tube: Path) -> None:
    supports = {"inlet": {"kind": "held"}, "outlet": {"kind": "held"}}
    _, displacement, places = solved(
        scene_of(tube, supports=supports, time={"end": 1.0, "step": 1.0})
    )
    np.testing.assert_allclose(displacement[places[:, 2] < 1e-9], 0.0, atol=1e-12)
    np.testing.assert_allclose(
        displacement[places[:, 2] > LENGTH - 1e-9],
        np.tile([0, 0, 0.05 * LENGTH], (24, 1)),
        atol=1e-12,
    )


# ---------------------------------------------------------------- rigid motions


SLIDING = {"kind": "sliding"}
SPRINGS = {"kind": "elastic", "stiffness": 1.0}


@pytest.mark.parametrize(("supports", "free"), [
    ({}, 0), ({"inlet": FREE}, 0), ({"inlet": FREE, "outlet": FREE}, 6),
    ({"inlet": SLIDING, "outlet": SLIDING}, 3),
    ({"inlet": SLIDING, "outlet": FREE, "outer": SPRINGS}, 0),
    ({"inlet": FREE, "outlet": FREE, "outer": SPRINGS | {"tangential": 0.0}}, 2),
])  # fmt: skip
def test_every_free_rigid_motion_counts(tube: Path, supports: Any, free: int) -> None:
    scene = scene_of(tube)
    parts = scene.geometry.build(scene.mesh, MPI.COMM_SELF).boundary.faces
    chosen = {"inlet": Support(), "outlet": Support()} | {
        name: Support(**one) for name, one in supports.items()
    }
    assert free_motions(parts, chosen) == free


@pytest.mark.parametrize("number", [1, 2])
def test_springs_on_one_or_two_facets_hold_a_body(tube: Path, number: int) -> None:
    """Any displacement that is linear in place is held on a triangle; at its middle alone three turns are not."""
    scene = scene_of(tube)
    parts = scene.geometry.build(scene.mesh, MPI.COMM_SELF).boundary.faces
    spot = Face("spot", parts[0].facets[:number], parts[0].corners[:number])
    assert free_motions([*parts, spot], {"spot": Support(**SPRINGS)}) == 0


# ---------------------------------------------------------------- runs

RUN = """
material.repulsion = "axes"
remodeling = { law = "tensor", coupling = "extrapolated" }
supports = { inlet.kind = "sliding", outlet.kind = "sliding", outer = { kind = "elastic", stiffness = 0.002 } }
[geometry]
shape = "mesh"
file = "mesh/tube.msh"
[loads.pressure]
value = 2.0
ramp = [[0.0, 0.0], [2.0, 1.0]]
[time]
end = 3.0
step = 1.0
[solver]
method = "iterative"
"""


def test_multigrid_of_degree_two_goes_on_with_its_copy_on_other_ranks(tmp_path: Path) -> None:
    """Begun on three ranks and ended on one, and the other way round; a copy that has changed is refused.

    Elements, law and supports are those of the bend below: both take the same kernels.
    """
    (tmp_path / "mesh").mkdir()
    file = write_tube(tmp_path / "mesh" / "tube.msh", degree=2, counts=(8, 1, 3))
    scene = tmp_path / "vessel.toml"
    scene.write_text(RUN)
    folders = {name: str(tmp_path / name) for name in ("whole", "three", "one")}
    begin, go_on = (lambda name: ["run", str(scene), "-o", folders[name]]), [
        "--no-report",
        "--set",
        "time.end=1",
    ]
    assert run(*begin("whole"), "--no-report").returncode == 0
    assert run(*begin("one"), *go_on).returncode == 0
    commands = {
        "three": [*begin("three"), *go_on],
        "one": ["run", "--resume", folders["one"], *go_on[:2], "time.end=2"],
    }
    (tmp_path / "commands.json").write_text(json.dumps(commands))
    program = [sys.executable, str(Path(__file__).parents[1] / "commands.py"), str(tmp_path)]
    done = ran(mpirun(3, *program))
    assert json.loads((tmp_path / "codes.json").read_text()) == {
        "three": [0] * 3,
        "one": [0] * 3,
    }, done.stderr
    copy = tmp_path / "three" / "tube.msh"
    assert copy.read_bytes() == file.read_bytes()
    file.unlink()  # the run has its own
    for name in ("three", "one"):
        assert (
            run("run", "--resume", folders[name], "--set", "time.end=3", "--no-report").returncode
            == 0
        )
        found, expected = (read_history(tmp_path / folder) for folder in (name, "whole"))
        assert_close(found, expected, expected.keys() - WORK, 1e-8, 1e-10, equal_nan=True)
    copy.write_text(copy.read_text() + "\n")
    refused = run("run", "--resume", folders["three"], "--set", "time.end=5")
    assert refused.returncode == 2
    assert "tube.msh': has changed" in refused.stderr


# ---------------------------------------------------------------- pressures on other faces


def _outside(face: str = "outer", **more: Any) -> dict[str, Any]:
    return {"kind": "pressure", "face": face, "value": 2.0, "ramp": ramp_to(2)} | more


def test_equal_pressures_inside_and_outside_compress_alike_everywhere(tube: Path) -> None:
    """In plane strain all of it is s times as wide: (mu (s^2 - 1) + 2 lambda ln s)/s^2 = -p, on plane facets too."""
    stiff = {"kind": "guided", "stiffness": 1e8}
    pressure = {"value": 2.0, "ramp": ramp_to(2)}
    scene = scene_of(
        tube, material={"chain_density": 0.0}, remodeling={"law": "none"},
        loads={"pressure": pressure, "tissue": _outside()}, supports={"inlet": stiff, "outlet": stiff},
    )  # fmt: skip
    row, displacement, places = solved(scene)
    mu, lame_lambda, s = scene.material.lame_mu, scene.material.lame_lambda, 1.0
    for _ in range(50):  # Newton's method
        balance = mu * (s**2 - 1) + 2 * lame_lambda * np.log(s) + 2.0 * s**2
        s -= balance / (2 * mu * s + 2 * lame_lambda / s + 4.0 * s)
    assert s < 0.98 and row["tissue"] == 2.0
    assert np.abs(displacement[:, :2] - (s - 1) * places[:, :2]).max() < 1e-5


# ---------------------------------------------------------------- a bend that statics determine


def test_a_bend_with_sliding_ends_carries_the_force_of_a_closed_tube(tmp_path: Path) -> None:
    """Two sliding ends square to each other: beside the bending plane cells turn as in a closed straight tube.

    At 90 degrees from the plane a bend's wall has the straight tube's pressure times radius, and the force of the caps
    comes from the ends. A soft foundation keeps the body from moving across the plane.
    """
    bend, (inner, outer), counts = 8.0, RADII, (12, 3, 4)

    def moved(places: Any) -> Any:
        x, y, turn = places[:, 0], places[:, 1], places[:, 2] / bend
        return np.stack([(bend + x) * np.cos(turn) - bend, y, (bend + x) * np.sin(turn)], axis=1)

    length = bend * np.pi / 2
    file = write_tube(tmp_path / "bend.msh", degree=2, counts=counts, length=length, moved=moved)
    tables = {
        "loads": ramped(10, pressure=2.0), "material": {"repulsion": "axes"},
        "remodeling": {"law": "tensor", "coupling": "extrapolated"}, "time": {"end": 40.0, "step": 10.0},
        "output": {"fields": False},
    }  # fmt: skip
    sliding: dict[str, Any] = {name: {"kind": "sliding"} for name in ("inlet", "outlet")}
    sliding["outer"] = {"kind": "elastic", "stiffness": 0.002}
    bent = Simulation(scene_of(file, supports=sliding, **tables), MPI.COMM_SELF)
    last = list(bent.steps())[-1]
    angle, places = Measurement(bent.observer, last).fibre_angle, bent.cells.local_axes.coordinates
    bent.close()
    x, y = np.hypot(places[..., 0] + bend, places[..., 2]) - bend, places[..., 1]
    depth = (np.hypot(x, y) - inner) / (outer - inner)
    half_way = np.abs(np.arctan2(places[..., 2], places[..., 0] + bend) - np.pi / 4) < np.pi / 10
    beside = np.abs(np.degrees(np.arctan2(np.abs(y), x)) - 90) < 180 / counts[0]
    shape = {"shape": "tube", "inner_radius": inner, "outer_radius": outer, "length": length}
    closed = {
        "supports": {"ends": "closed"},
        "model": {"kinematics": "radial"},
        "mesh": {"degree": 2, "refinement": 2},
    }
    straight = Simulation(scene_of(Path(), geometry=shape, **closed, **tables), MPI.COMM_SELF)
    step = list(straight.steps())[-1]
    known, radius = (
        Measurement(straight.observer, step).fibre_angle,
        straight.cells.local_axes.coordinates[..., 0],
    )
    straight.close()
    order = np.argsort(radius, axis=None)
    straight_share = (radius.ravel()[order] - inner) / (outer - inner)
    expected = np.interp(depth, straight_share, known.ravel()[order])
    spread = []
    for low in np.arange(3) / 3:
        band = (depth >= low) & (depth < low + 1 / 3) & half_way
        spread.append(float(np.ptp(angle[band] - expected[band])))
        assert angle[band & beside].mean() == pytest.approx(
            expected[band & beside].mean(), abs=1.0
        ), low
    assert min(spread) > 2.0  # and around the section they differ, as a bend's do


def test_a_flat_inner_face_encloses_no_lumen(tmp_path: Path) -> None:
    """A strip whose lower and upper face are called inner and outer: rounding is no volume."""
    with gmsh_model("strip") as gmsh:
        gmsh.model.occ.addBox(3.0, 1.0, 2.0, 3.0, 1.0, 1.0)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(3, [1], name="tissue")
        for name, tag in (("inlet", 1), ("outlet", 2), ("inner", 5), ("outer", 6)):
            gmsh.model.addPhysicalGroup(2, [tag], name=name)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.6)
        gmsh.model.mesh.generate(3)
        gmsh.write(str(tmp_path / "strip.msh"))
    geometry = {"shape": "mesh", "file": str(tmp_path / "strip.msh"), "open_boundary": True}
    tables: Any = {
        "loads": LOADS | {"pressure": LOADS["pressure"] | {"value": 0.0}},
        "remodeling": {},
    }
    row, _, _ = solved(scene_of(tmp_path / "strip.msh", geometry=geometry, **tables))
    assert np.isnan(row["lumen_volume"]) and row["fibre_angle_inner"] > 45.0
