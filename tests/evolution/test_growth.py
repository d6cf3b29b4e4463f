"""remodeling.turnover.volume: what is made takes room; figures of an independent program on one radius."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, cli
from remodel_fenicsx.body.tube import whole_tube
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import TURNOVER_RATES, TurnoverRule
from remodel_fenicsx.running import run
from remodel_fenicsx.scene import Scene, scene_from_dict
from remodel_fenicsx.solver.continuation import StepFailure
from tests.conftest import slowly, warnings_of
from tests.mesh_files import COUNTS, LENGTH, RADII, write_tube
from tests.reference.radial import RadialMaterial
from tests.reference.wall import Wall
from tests.runs import goes_on, last_row, made, opening_angle, rows_of, simulated
from tests.values import ANGLES, assert_close, isotropic, ramped

SELF = MPI.COMM_SELF
GROWN = [
    "content",
    "natural_length",
    "growth",
    "collagen_share",
    "wall_thickness",
    "mean_hoop_stress",
]
PLACES = [f"hoop_stress_{place}" for place in ("inner", "middle", "outer")]


def wall(
    volume: float, end: float | str = 1440.0, tolerance: float | None = 1.0, **tables: Any
) -> Scene:
    """A tube of 1 to 1.3 under a pressure of 1.2 and an elongation of 10 %, with the rates `cauchy`."""
    turnover = {
        "time": 40.0,
        "deposition_stretch": 1.1,
        "gain": 1.0,
        "volume": volume,
    } | tables.pop("turnover", {})
    values = isotropic(
        "consistent",
        geometry={"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.3, "length": 2.0}
        | tables.pop("geometry", {}),
        remodeling={"turnover": turnover} | tables.pop("remodeling", {}),
        time={"end": end} | ({} if end == "equilibrium" else {"step": 4.0, "tolerance": tolerance}),
        output={"fields": False, "report": False},
    )
    scene = scene_from_dict(
        values | {"mesh": {"refinement": 2, "degree": 2}, "loads": raised(1.0)} | tables
    )
    columns = [*ANGLES, "inner_radius", "outer_radius", *PLACES, *GROWN]
    kept = [name for name in columns if volume or name not in ("growth", "collagen_share")]
    return scene.with_values({"output.columns": kept})


def raised(factor: float, at: float = 1600.0, pressure: float = 1.2) -> Any:
    """The loads, and a pressure that rises by a factor when the wall rests."""
    loads = ramped(24.0, pressure=pressure, elongation=0.1)
    loads["pressure"]["ramp"] += [] if factor == 1.0 else [[at, 1.0], [at + 24.0, factor]]
    return loads


class Rest(NamedTuple):
    """A wall at rest by an independent program: angles of the inner eighth, half-way and of the outer eighth."""

    inner_radius: float
    wall_thickness: float
    mean_hoop_stress: float
    content: float
    natural_length: float
    angles: tuple[float, float, float]
    opening_angle: float


# volume, gain, deposition stretch, pressure over that of before
RESTS = {
    (0.0, 1.0, 1.1, 1.0): Rest(1.3885, 0.2170, 7.68, 2.647, 1.174, (6.6, 12.2, 18.1), 113.4),
    (0.0, 1.0, 1.1, 1.5): Rest(1.6437, 0.1880, 15.74, 6.083, 1.367, (2.6, 6.3, 10.5), 166.5),
    (0.3, 1.0, 1.1, 1.0): Rest(1.3315, 0.3203, 4.99, 2.624, 1.176, (3.4, 10.4, 15.9), 127.6),
    (0.3, 1.0, 1.1, 1.5): Rest(1.5190, 0.4547, 6.01, 6.122, 1.378, (0.0, 2.2, 7.7), 153.7),
    (0.3, 2.0, 1.1, 1.0): Rest(1.2390, 0.3333, 4.46, 2.554, 1.109, (3.3, 10.7, 16.8), 113.0),
    (0.5, 1.0, 1.1, 1.0): Rest(1.2997, 0.3877, 4.02, 2.624, 1.177, (1.5, 9.2, 14.6), 132.6),
    (1.0, 1.0, 1.1, 1.0): Rest(1.2365, 0.5589, 2.66, 2.673, 1.179, (0.0, 6.0, 11.2), 139.1),
    (0.5, 1.0, 1.15, 1.0): Rest(1.2457, 0.2833, 5.28, 1.454, 1.048, (4.4, 12.1, 19.2), 106.3),
}
THICK_RESTS = {
    (0.0, 1.0, 1.1, 1.0): Rest(1.6232, 1.5361, 5.07, 1.949, 1.068, (0.0, 18.9, 65.5), 78.4),
    (0.3, 1.0, 1.1, 1.0): Rest(1.3878, 1.9024, 3.50, 1.849, 1.087, (0.0, 8.7, 40.7), 114.2),
    (0.3, 1.0, 1.1, 1.5): Rest(1.5733, 2.3244, 4.87, 4.093, 1.267, (0.0, 0.0, 13.5), 168.8),
}
LOCAL = {  # hoop stress and content inside, half-way and outside; growth makes the stress uniform
    (0.3, 1.0, 1.1, 1.0): ((4.9, 5.0, 5.0), (3.36, 2.61, 2.12)),
    (1.0, 1.0, 1.1, 1.0): ((2.2, 2.7, 2.9), (2.19, 2.56, 3.46)),
}


def at_rest(
    case: tuple[float, float, float, float],
    pressure: float = 1.2,
    held: float = 1600.0,
    **tables: Any,
) -> Scene:
    """The wall of a case, on the path through the rest before; eight elements, as its angles are of eighths."""
    volume, gain, stretch, factor = case
    loads = raised(factor, held, pressure)
    turnover = {"gain": gain, "deposition_stretch": stretch} | tables.pop("turnover", {})
    scene = wall(volume, "equilibrium", None, turnover=turnover, loads=loads, **tables)
    columns = [*scene.output.columns, "opening_angle"]
    return scene.with_values({"mesh.refinement": 1, "output.columns": columns})


def compare(row: dict[str, float], expected: Rest, *but: str) -> None:
    """Within the tolerances: radii 0.5 %, other means 1 %, angles 0.5 degrees, cuts 2 degrees."""
    for name, tolerance in zip(Rest._fields[:5], (0.005, 0.01, 0.01, 0.01, 0.01), strict=True):
        assert row[name] == pytest.approx(getattr(expected, name), rel=tolerance), name
    if "angles" not in but:
        assert [row[name] for name in ANGLES] == pytest.approx(expected.angles, abs=0.5)
    if "opening_angle" not in but:
        assert row["opening_angle"] == pytest.approx(expected.opening_angle, abs=2.0)


@pytest.mark.parametrize("case", RESTS, ids=str)
def test_walls_rest_where_an_independent_program_says(
    case: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Radius, thickness, means, angles, what a cut shows, curves continued to the faces; nothing is said."""
    with simulated(at_rest(case)) as (simulation, (row,)):
        stress = simulation.stepper.remodeling.driving_tensor()[1][:, 1, 1]
        depth, content = simulation.cells.local_axes.depth.ravel(), simulation.stepper.process(
            "turnover"
        )._values("content")
    compare(row, RESTS[case])
    for values, expected, accuracy in zip(
        (stress, content.ravel()), LOCAL.get(case, ()), (0.1, 0.02)
    ):
        curve = np.polynomial.Polynomial.fit(depth, values, 8)
        assert curve(np.array([0.0, 0.5, 1.0])) == pytest.approx(expected, rel=0.03, abs=accuracy)
    if case[0]:
        assert row["growth"] == pytest.approx(1 + case[0] * (row["content"] - 1), rel=1e-3)
        assert row["collagen_share"] == pytest.approx(
            case[0] * row["content"] / row["growth"], abs=0.01
        )
    assert not warnings_of(caplog)


@pytest.mark.parametrize("case", THICK_RESTS, ids=str)
def test_thick_walls_too(case: Any) -> None:
    """The paper's radii and pressure; half-way is a line between two of eight elements, in one of which angles jump."""
    finer = at_rest(case, 4.8, geometry={"outer_radius": 3.0}).with_values(
        {"mesh.refinement": 1 + (case[0] == 0.0)}
    )
    columns = [*finer.output.columns, "axial_force"]
    row, expected = last_row(finer.with_values({"output.columns": columns})), THICK_RESTS[case]
    if case[0]:  # growth turns a pull along the axis into a thrust
        assert row["axial_force"] == pytest.approx({1.0: 13.0, 1.5: -27.0}[case[3]], abs=1.0)
    if not case[0]:
        assert row[ANGLES[1]] == pytest.approx(expected.angles[1], abs=0.5)
    compare(row, expected, *["angles"] * (not case[0]))


@pytest.mark.parametrize(
    ("volume", "thickness", "stress", "opening_angle"),
    [(0.3, 1.189, 1.465, 158.5), *slowly((0.5, 1.411, 1.220, 155.5), (1.0, 1.994, 0.841, 151.5))],
)
def test_room_from_rest_on(
    volume: float, thickness: float, stress: float, opening_angle: float
) -> None:
    """Over the rest before, that of a wall without room; however short its loads were held."""
    before = RESTS[0.0, 1.0, 1.1, 1.0]
    row = last_row(at_rest((volume, 1.0, 1.1, 1.5), held=100.0, turnover={"from": "equilibrium"}))
    assert row["wall_thickness"] / before.wall_thickness == pytest.approx(thickness, rel=0.01)
    assert row["mean_hoop_stress"] / before.mean_hoop_stress == pytest.approx(stress, rel=0.01)
    assert row["opening_angle"] == pytest.approx(opening_angle, abs=2.0)


def test_a_wall_comes_back_when_the_pressure_falls() -> None:
    """Thickness and content, which remember a little of it."""
    scene = at_rest((0.3, 1.0, 1.1, 1.5), held=400.0)
    ramp = [*map(list, scene.loads["pressure"].ramp), [800.0, 1.5], [824.0, 1.0]]
    row = last_row(scene.with_values({"loads.pressure.ramp": ramp}))
    assert [row["wall_thickness"], row["content"]] == pytest.approx([0.3252, 2.595], rel=0.01)


def membrane(volume: float, gain: float, loads: Any, end: float, step: float) -> Scene:
    """A thin wall that collagen alone bears."""
    bulk = {"lame_lambda": 100.0, "lame_mu": 0.01}
    thin: Any = {
        "geometry": {"outer_radius": 1.01},
        "turnover": {"gain": gain},
        "material": bulk,
        "loads": loads,
    }
    return wall(volume, end, None, **thin).with_values({"time.step": step})


@pytest.mark.parametrize("gain", [1.0, 2.0])
def test_a_membrane_that_is_all_collagen_keeps_its_hoop_stress(gain: float) -> None:
    """m/rho^2 follows the pressure, the radius rho, and the thickness m: the closed limits of a thin wall."""
    rows = rows_of(membrane(1.0, gain, raised(1.5, 720.0, 0.04), 1440.0, 24.0 / gain))
    before = next(row for row in rows if row["time"] >= 720.0)
    factor = {name: rows[-1][name] / before[name] for name in (*GROWN, "inner_radius")}
    assert factor["content"] / factor["natural_length"] ** 2 == pytest.approx(1.5, rel=0.01)
    assert factor["inner_radius"] == pytest.approx(factor["natural_length"], rel=0.01)
    assert factor["mean_hoop_stress"] == pytest.approx(1.0, rel=0.01)


def test_the_wall_is_as_large_as_its_tissue() -> None:
    """Volume between the deformed faces: the integral of J_e J_g."""
    with simulated(wall(0.5, 400.0)) as (simulation, rows):
        F, quadrature = simulation.state.elastic_gradient(), simulation.quadrature
        growth = simulation.stepper.process("turnover").growth.ratio
        volume = quadrature.integral(np.linalg.det(F).reshape(growth.shape) * growth)
    inner, outer = rows[-1]["inner_radius"], rows[-1]["outer_radius"]
    assert volume == pytest.approx(np.pi * (outer**2 - inner**2) * 2.0 * 1.1, rel=1e-6)
    assert np.mean(growth) > 1.2


def test_growth_does_not_alternate_from_point_to_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """As much of it as the strain of an element can follow: with all of it J_e swings within every element."""

    def swing() -> float:
        stiff = {
            "material": {"lame_lambda": 300.0},
            "mesh": {"degree": 2, "formulation": "displacement"},
        }
        with simulated(wall(0.5, 200.0, **stiff)) as (simulation, _):
            J = np.linalg.det(simulation.state.elastic_gradient()).reshape(-1, 3)
        return float(np.abs(J[:, 0] - 2 * J[:, 1] + J[:, 2]).max() / np.ptp(J.mean(axis=1)))

    projected = swing()
    monkeypatch.setattr(
        Quadrature, "polynomial_residual", lambda self, degree, values: np.zeros_like(values)
    )
    assert swing() > 3 * projected


@pytest.mark.parametrize(
    "case", ["growth", "opening angle", "random tissue", "residual stress alone"]
)
def test_walls_are_those_of_the_reference(case: str) -> None:
    """At a time on the way to rest, with fine steps; where tissue does not turn over, the opened sector too."""
    rng, tissue, opening, volume, gain, stretch = (
        np.random.default_rng(3),
        RadialMaterial(),
        0.0,
        0.5,
        1.0,
        1.1,
    )
    if case == "random tissue":
        numbers = [
            float(rng.uniform(*ends)) for ends in ((10, 60), (1, 6), (1, 4), (1.5, 2.5), (0.9, 1.1))
        ]
        tissue, volume, gain, stretch = RadialMaterial(*numbers), 0.8, 1.4, 1.15
    elif case != "growth":
        opening = 90.0
    turns = case != "residual stress alone"
    reference = Wall(
        tissue, (1.0, 1.3), opening, 0.025, 10.0 if turns else 1e12, stretch, gain, volume
    )
    reference.run(1.2, 0.1, 8.0, 20.0, 0.5)
    turnover = {"time": reference.time, "gain": gain, "deposition_stretch": stretch}
    moduli = {name: getattr(tissue, name) for name in ("lame_lambda", "lame_mu", "contour_length")}
    density = tissue.network_modulus / (1.381e-23 * 310.0 / (4 * 1.365))
    tables: Any = {
        "loads": ramped(8.0, pressure=1.2, elongation=0.1),
        "material": moduli | {"chain_density": density},
    }
    scene = wall(
        volume, 20.0, None, turnover=turnover, natural={"opening_angle": opening}, **tables
    ).with_values(
        {
            "time.step": 0.5,
            "mesh.refinement": 6,
            "cells.end_to_end_length": tissue.end_to_end_length,
        }
    )
    expected = reference.row()
    with simulated(scene.with_values({"output.columns": [*expected]})) as (simulation, rows):
        assert_close(rows[-1], expected, expected, 2e-3)
        if case in (
            "random tissue",
            "residual stress alone",
        ):  # the angle is that sensitive to steps elsewhere
            assert opening_angle(simulation) == pytest.approx(reference.cut(), abs=1.0)


# ---------------------------------------------------------------- bodies
SHORT: Any = {"turnover": {"time": 10.0}, "loads": ramped(8.0, pressure=1.2, elongation=0.1)}


def test_kinematics_agree() -> None:
    """One radius, a half-plane, a piece of the ring in three dimensions."""
    rows = [
        last_row(wall(0.5, 12.0, None, **SHORT, model={"kinematics": name}, mesh={"degree": 2}))
        for name in ("radial", "axisymmetric", "sector")
    ]
    assert rows[0]["growth"] > 1.1
    for row in rows[1:]:
        assert_close(row, rows[0], ("inner_radius", *GROWN), 1e-4)


def test_whole_tubes_and_their_files_agree(tmp_path: Path) -> None:
    """Linear elements; the file's wall grows along the radial axis that is found in it."""
    geometry = {"inner_radius": RADII[0], "outer_radius": RADII[1], "length": LENGTH}
    names, loads = ["growth", "content", "collagen_share"], ramped(
        8.0, pressure=4.0, elongation=0.1
    )
    tables: Any = {
        "turnover": {"time": 10.0},
        "loads": loads,
        "mesh": {"degree": 1},
        "model": {"kinematics": "full"},
    }
    scene = wall(0.5, 12.0, None, geometry=geometry, **tables).with_values(
        {"output.columns": names}
    )
    whole = last_row(scene, whole_tube(scene.geometry, COUNTS, "hexahedron", 1, SELF))
    body = {"shape": "mesh", "file": str(write_tube(tmp_path / "tube.msh"))}
    changes: dict[str, Any] = {
        "preset": None,
        "material.repulsion": "log",
        "remodeling.law": "tensor",
    }
    file = last_row(scene.with_values(changes | {"geometry": body, "cells.axes": "local"}))
    assert whole["growth"] > 1.1
    assert_close(file, whole, names, 0.03)


def test_a_run_goes_on_across_the_start_of_growth(tmp_path: Path) -> None:
    """Before `from` the volume stays."""
    scene = wall(0.5, 40.0, None, turnover={"time": 10.0, "from": 16.0}, loads=SHORT["loads"])
    history = goes_on(scene, tmp_path, 16.0, 20.0).history
    early = history["time"] <= 16.0
    np.testing.assert_allclose(history["growth"][early], 1.0, rtol=1e-14)
    np.testing.assert_allclose(history["collagen_share"][early], 0.5, rtol=1e-14)
    assert history["growth"][-1] > 1.05 and history["content"][early][-1] > 1.05


def test_load_cases_grow_alike() -> None:
    """Two cases of the same loads are one."""
    values: Any = {"mesh": {"degree": 2}, "loads": SHORT["loads"], "turnover": {"time": 10.0}}
    plain = last_row(wall(0.5, 12.0, None, **values))
    cases = [
        {"weight": 0.5, "loads": {"pressure": 1.0}},
        {"weight": 0.5, "loads": {"pressure": 1.0}},
    ]
    twice = last_row(wall(0.5, 12.0, None, **values, cases=cases))
    assert_close(twice, plain, ("inner_radius", *GROWN), 1e-8)


def test_a_folder_of_an_earlier_version_goes_on_as_it_was(tmp_path: Path) -> None:
    """Its scene as run has turnover without rates and volume: those of tension, which takes no room."""
    scene = wall(0.0, 8.0, None, turnover={"rates": "tension", "time": 10.0}, loads=SHORT["loads"])
    folder = run(scene, tmp_path / "run", SELF)
    text = (folder / "scene.toml").read_text()
    lines = [
        line
        for line in text.splitlines()
        if not line.startswith(("rates =", "volume =", "from =", "growth ="))
    ]
    assert len(lines) < len(text.splitlines())
    (folder / "scene.toml").write_text("\n".join(lines) + "\n")
    turnover = Recording(folder).scene.remodeling.turnover
    assert (turnover.rates, turnover.volume) == ("tension", 0.0)


# ---------------------------------------------------------------- what is said
def test_a_vessel_that_grows_pushes_along_its_axis(caplog: pytest.LogCaptureFixture) -> None:
    """A long tube is said to buckle while it thickens."""
    rows_of(wall(0.5, 160.0, None, geometry={"length": 9.0}))
    (line,) = warnings_of(caplog)
    assert "expected buckling: axial thrust" in line


def test_tissue_that_is_lost_is_refused() -> None:
    """All of a wall is collagen, which goes where nothing pulls."""
    slack = {
        "turnover": {"time": 1.0, "deposition_stretch": 1.3},
        "loads": ramped(4.0, pressure=0.01, elongation=0.0),
    }
    with pytest.raises(StepFailure, match="tissue"):
        rows_of(wall(1.0, 200.0, None, **slack))


@pytest.mark.parametrize(
    ("turnover", "says"),
    [
        (
            {"gain": 0.35},
            "gain = 0.35: no stable homeostasis with this deposition_stretch; must exceed 0.397",
        ),
        ({"gain": 0.45}, "gain = 0.45: reaches equilibrium slowly"),
        ({"gain": 0.45, "rates": "tension"}, "must exceed 0.496"),
        ({"gain": 0.45, "deposition_stretch": 1.2}, "reaches equilibrium slowly"),
        ({"gain": 1.0}, ""),
    ],
)
def test_validate_says_which_gains_rest(
    turnover: Any, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """2/a, closed, for both kinds of rates."""
    (tmp_path / "scene.toml").write_text(wall(0.3, turnover=turnover).to_toml())
    assert cli.main(["validate", str(tmp_path / "scene.toml")]) == 0
    printed = capsys.readouterr()
    found = [
        line for line in (printed.out + printed.err).splitlines() if "turnover.gain = " in line
    ]
    assert says in found[0] if says else not found


def test_the_time_to_rest_is_that_of_the_formula() -> None:
    """E T/(k a - 2) for a membrane without a matrix, from the fall of its rates; a matrix makes it rest sooner."""
    for gain in (1.0, 2.0):
        rates: list[float] = []
        with made(
            membrane(0.0, gain, ramped(20.0, pressure=0.04, elongation=0.1), 700.0, 20.0 / gain)
        ) as simulation:
            turnover = simulation.stepper.process("turnover")
            for step in simulation.steps():
                rates += [np.abs(turnover.rates()).max()] if step.time in (600.0, 700.0) else []
            tissue = simulation.stepper.remodeling.parameters.largest()
        _, slowly = turnover.settings.rule.gain_and_recovery_time(tissue)
        assert 100.0 / np.log(rates[0] / rates[1]) == pytest.approx(slowly, rel=0.03), gain


def test_nothing_is_made_by_chains_without_stress() -> None:
    """Production is never negative, whatever the gain: removal is left, and what is there keeps its length."""
    rule = TurnoverRule(40.0, 1.1, 2.0, TURNOVER_RATES["cauchy"])
    found = rule.rates(Tissue(1.0, 1.0, 1.0, 1.594, 1.0), np.array([0.5, 1.1]))
    np.testing.assert_allclose(found, [[-1 / 40.0, 0.0], [0.0, 0.0]], atol=1e-15)
