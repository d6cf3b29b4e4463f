"""Whether a body would buckle that a reduction keeps straight: thrust in a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from docs.making import validation
from remodel_fenicsx import Scene
from remodel_fenicsx.watch.stability import BucklingWarning
from tests.parts import tube
from tests.runs import made, rows_of, simulated
from tests.values import isotropic, ramp_to

MU, LAME = 3.103, 27.293
YOUNG, POISSON = MU * (3 * LAME + 2 * MU) / (LAME + MU), LAME / (2 * (LAME + MU))
BARE: dict[str, Any] = {
    "material": {"lame_mu": MU, "lame_lambda": LAME, "chain_density": 0.0},
    "remodeling": {"law": "none", "coupling": "staggered"}, "time": {"end": 1.0},
}  # fmt: skip
DEGREE = {"mesh.degree": 2}
SECOND_MOMENT = np.pi / 4 * (1.5**4 - 1)


def ramped(value: float) -> dict[str, Any]:
    """A load that is all there from t = 1."""
    return {"value": value, "ramp": ramp_to(1.0)}


def slender(kinematics: str, pressure: float, **changes: Any) -> Scene:
    """A tube without chains, 40 long, its wall from 1 to 1.5."""
    shape = {"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.5, "length": 40.0}
    loads = {"pressure": ramped(pressure)}
    return Scene(**isotropic(None, kinematics, geometry=shape, loads=loads, **BARE)).with_values(
        changes
    )


@contextmanager
def watched(scene: Scene) -> Iterator[BucklingWarning]:
    """The watcher at the end of a run."""
    with simulated(scene) as (simulation, _):
        yield BucklingWarning(simulation.stepper, scene.geometry.strut(scene.supports.ends))


# ---------------------------------------------------------------- in closed form
@pytest.mark.parametrize(("ends", "force"), [("closed", None), ("closed", 0.3), ("free", 0.1)])
def test_thrust_is_what_is_not_given(ends: str, force: float | None) -> None:
    """Caps take the pressure on the lumen, a force that is given is the wall's."""
    changes: dict[str, Any] = {"supports.ends": ends}
    if force is not None:
        changes["loads.axial_force"] = ramped(force)
    with watched(slender("radial", 0.3, **changes)) as watcher:
        lumen = 0.3 * watcher.lumen_area() if ends == "free" else 0.0
        assert watcher.thrust() == pytest.approx(lumen - (force or 0.0), abs=2e-6)


@pytest.mark.parametrize(("kinematics", "ends", "factor"), [
    ("radial", "free", 1.0), ("axisymmetric", "clamped", 0.5), ("sector", "free", 1.0),
])  # fmt: skip
def test_eulers_load_of_an_unloaded_tube(kinematics: str, ends: str, factor: float) -> None:
    """pi^2 EI / (k L)^2; the pressure's thrust on a held length is (1 - 2 nu) p pi r_i^2 at first."""
    with watched(slender(kinematics, 1e-4, **{"supports.ends": ends}, **DEGREE)) as watcher:
        exact = np.pi**2 * YOUNG * SECOND_MOMENT / (factor * 40) ** 2
        assert watcher.euler_load() == pytest.approx(exact, rel=0.01)
        assert watcher.thrust() == pytest.approx(
            (1 - 2 * POISSON) * 1e-4 * np.pi, rel=0.01 if kinematics == "radial" else 0.2
        )


def column(force: float, kinematics: str = "point") -> Scene:
    """A slender tendon under a dead force."""
    shape = {"shape": "tendon", "length": 10.0, "area": 0.1}
    return Scene(
        **isotropic(None, kinematics, geometry=shape, loads={"force": ramped(force)}, **BARE)
    )


def test_a_tendon_is_a_column_with_a_free_end() -> None:
    exact = np.pi**2 * YOUNG * 0.1**2 / (4 * np.pi) / (2 * 10.0) ** 2
    with watched(column(-0.5 * exact)) as watcher:
        assert watcher.thrust() / watcher.euler_load() == pytest.approx(0.5, rel=0.01)


# ---------------------------------------------------------------- against the whole body
def test_the_whole_tube_loses_its_stability_where_the_ray_says_so() -> None:
    """Two modes, x and y, between pressures at which the estimate is 0.8 and 1.1."""
    counts, shares = [], []
    for pressure in (0.26, 0.32):
        with watched(slender("radial", pressure)) as watcher:
            shares.append(watcher.thrust() / watcher.euler_load())
        changes = {"mesh.degree": 2, "output.columns": ["negative_eigenvalues"]}
        whole = slender("full", pressure, **changes)
        with made(
            whole, tube(1.0, 1.5, 40.0, 1, "hexahedron", 2, MPI.COMM_SELF, (8, 1, 8))
        ) as simulation:
            counts.append([step.row["negative_eigenvalues"] for step in simulation.steps()][-1])
    assert counts == [0, 2]
    assert shares[0] < 0.9 < shares[1]


@pytest.mark.parametrize(("scene", "told"), [
    (slender("radial", 0.2), ""), (slender("radial", 0.4), "thrust"), (slender("sector", 0.4, **DEGREE), "thrust"),
    (slender("axisymmetric", 0.4, **{"supports.ends": "clamped"}, **DEGREE), ""),
    (slender("radial", 0.4, **{"supports.ends": "closed"}), ""),
    (slender("radial", 0.4, **{"loads.elongation": ramped(0.02)}), ""),
    (slender("radial", 0.01, **{"loads.elongation": ramped(-0.02)}), "thrust"),
    (slender("radial", 0.01, **{"loads.axial_force": ramped(-0.3)}), "thrust"),
    (slender("radial", 0.4, **{"geometry.length": 8.0}), ""), (column(-1e-4), ""), (column(-2e-4), "thrust"),
    (column(0.1), ""),
])  # fmt: skip
def test_who_is_told(scene: Scene, told: str, caplog: Any) -> None:
    """Once, with what to set."""
    longer = scene.with_values({"time.end": 2.0})
    rows_of(longer)
    lines = [line for line in caplog.messages if "expected buckling" in line]
    assert len(lines) == bool(told), lines
    for line in lines:
        assert f"axial {told} is about " in line and "set model.kinematics = 'full'" in line


def test_a_wall_whose_chains_nearly_lock_is_a_stiff_column() -> None:
    """Across the chains differences of the energy are rounding, even 0."""
    tables = validation.tube(
        1.3,
        0.0,
        remodeling={"exponent": 4.0, "driver": "pk2", "kappa": 0.2},
        loads=validation.ramped(10.0, pressure=1.2, elongation=0.4),
        time={"end": 60.0, "tolerance": 2.0, "step": 5.0},
    )
    with watched(Scene(**tables)) as watcher:
        # Above that of a tube of Young's modulus 1, which is softer than chains.
        assert watcher.euler_load() > 7.3
