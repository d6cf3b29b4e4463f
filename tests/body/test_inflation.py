"""Inflation by volume: the lumen's volume is prescribed, and the pressure is an unknown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import SceneError
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import integral
from remodel_fenicsx.scene import scene_from_dict
from tests.conftest import slowly, warnings_of
from tests.mesh_files import TUBE, write_tube
from tests.runs import columns_of, goes_on, last_row, simulated
from tests.values import assert_close, isotropic, ramp_to, ramped

VOLUME = "lumen_expansion"
EXACT = {"relative_tolerance": 1e-13}
CLOSED = {"ends": "closed"}
REMODELS = {"law": "tensor", "coupling": "staggered"}


def tube(kinematics: str, loads: dict[str, Any], **tables: Any) -> dict[str, Any]:
    geometry = {"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.5, "length": 2.0}
    base = {"geometry": geometry, "remodeling": REMODELS, "solver": EXACT, "loads": loads}
    base |= {"time": {"end": 3.0}, "output": {"columns": [VOLUME], "fields": False}}
    return isotropic(None, kinematics, **base | tables)


def at_steps(values: Any) -> dict[str, Any]:
    """A load with these values at the times 1, 2, ..."""
    ramp = [[0.0, 0.0], *([number, float(value)] for number, value in enumerate(values, 1))]
    return {VOLUME: {"value": 1.0, "ramp": ramp}}


def by_volume(values: dict[str, Any], pressed: dict[str, Any]) -> dict[str, Any]:
    """The scene with the volumes that its pressure has made."""
    loads = {name: load for name, load in values["loads"].items() if name != "pressure"}
    return values | {"loads": loads | at_steps(pressed[VOLUME])}


def assert_same(values: dict[str, Any]) -> dict[str, Any]:
    """Inflate by pressure, then by the volumes that it made."""
    pressed = columns_of(values)
    assert pressed[VOLUME][-1] > 0.05
    inflated = columns_of(by_volume(values, pressed))
    works = {"seconds", "newton_iterations", "linear_iterations", "substeps", "remodeling_power"}
    assert_close(inflated, pressed, pressed.keys() - works, 1e-8, 1e-10, equal_nan=True)
    return inflated


STRETCHED = ramped(3.0, pressure=2.0, elongation=0.1)
PULLED = ramped(3.0, pressure=2.0, axial_force=1.0)


@pytest.mark.parametrize(("kinematics", "ends"), [
    ("radial", "free"), ("radial", "closed"), ("axisymmetric", "clamped"), ("axisymmetric", "closed"),
    ("sector", "clamped"), ("full", "free"), *slowly(("sector", "closed"), ("full", "closed")),
])  # fmt: skip
def test_volume_is_pressure(kinematics: str, ends: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("remodel_fenicsx.body.tube.PAPER", (8, 2, 2))
    loads = ramped(3.0, pressure=2.0) if ends == "closed" else STRETCHED
    row = assert_same(tube(kinematics, loads, supports={"ends": ends}))
    assert row["pressure"][-1] == pytest.approx(2.0, rel=1e-8)


def test_the_length_under_a_force_is_an_unknown_beside_the_pressure() -> None:
    """Without caps: the pressure does not work on the ends."""
    assert_same(tube("radial", PULLED))


LIMIT = {
    "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 1.1, "length": 8.0},
    "supports": CLOSED, "material": {"chain_density": 0.0}, "remodeling": {"law": "none"}, "mesh": {"degree": 2},
    "output": {"columns": ["negative_eigenvalues"], "fields": False},
}  # fmt: skip


def test_a_limit_point_is_passed(caplog: pytest.LogCaptureFixture) -> None:
    """The largest pressure of a closed tube; it is stable at each volume, also beyond."""
    load = {VOLUME: {"value": 12.0, "ramp": ramp_to(60.0)}}
    time = {"end": 60.0, "step": 1.0}
    values = tube("radial", load, **LIMIT | {"time": time})
    found = columns_of(values)
    top = int(found["pressure"].argmax())
    near = slice(top - 1, top + 2)
    parabola = np.poly1d(np.polyfit(found[VOLUME][near], found["pressure"][near], 2))
    (volume,) = parabola.deriv().roots
    radius, length = (
        np.interp(volume, found[VOLUME], found[name])
        for name in ("inner_radius", "axial_elongation")
    )
    assert (parabola(volume), radius, 1 + length) == pytest.approx((0.216, 1.66, 1.20), rel=5e-3)
    assert found["inner_radius"][-1] > 2.5 and (np.diff(found["pressure"][top:]) < 0).all()
    assert not found["negative_eigenvalues"].any()
    assert not warnings_of(caplog)


# ---------------------------------------------------------------- bodies of one's own


def own(file: Path, loads: dict[str, Any], **tables: Any) -> dict[str, Any]:
    body = {"geometry": {"shape": "mesh", "file": str(file)}, "model": {"kinematics": "full"}}
    return tube("full", loads, **body | tables)


def bend(places: Any) -> Any:
    """A right angle with the radius 8: the normals of the ends lie in one plane."""
    x, y, turn = places[:, 0], places[:, 1], places[:, 2] * np.pi / 6
    return np.stack([(8 + x) * np.cos(turn), y, (8 + x) * np.sin(turn)], axis=1)


OWN = own(TUBE, at_steps([0.1, 0.2, 0.4]))
STIFF, HELD = {"kind": "guided", "stiffness": 1e5}, {"kind": "held"}
FORCES = [f"support_force_{face}" for face in ("inlet", "outlet")]


@pytest.mark.parametrize(
    ("moved", "support"), [(None, HELD), (bend, STIFF)], ids=["straight", "bent"]
)
def test_a_vessel_has_the_volume_that_is_asked(tmp_path: Path, moved: Any, support: Any) -> None:
    """That of its column, whose caps are flat, wherever the ends look and if one moves."""
    columns = {"columns": [VOLUME, "lumen_volume", "pressure", *FORCES], "fields": False}
    ends = {face: support for face in ("inlet", "outlet")}
    tables = {"supports": ends, "output": columns, "solver": {"relative_tolerance": 1e-11}}
    found = assert_same(own(write_tube(tmp_path / "a.msh", moved=moved), STRETCHED, **tables))
    volume = found["lumen_volume"] / (1 + found[VOLUME])
    np.testing.assert_allclose(volume, volume[0], rtol=1e-4)


def test_ends_that_look_anywhere() -> None:
    """What the wall sweeps is the change of the volume, if the ends stay in their planes."""
    with simulated(scene_from_dict(own(TUBE, ramped(3.0, pressure=2.0)))) as (simulation, _):
        loading, unknown, changes = simulation.loading, simulation.unknown, []
        for across in (np.eye(3)[:, :2], np.empty((3, 0))):
            volume, start = loading.lumen_volume("inner", across)
            form = jit.form(volume(unknown) * loading.surface_measure("inner"))
            changes.append(integral(form) - start)
    assert changes[0] == pytest.approx(changes[1], rel=1e-3) and changes[1] > 1.0


@pytest.mark.parametrize(("tables", "words"), [
    ({"supports": {"outlet": {"kind": "free"}, "outer": HELD}}, "supports.outlet.kind = 'free': must be"),
    ({"loads": ramped(3.0, lumen_expansion=0.1, pressure=1.0)}, r"loads.\w+ = .*: not allowed together"),
    ({"solver": {"method": "iterative"}}, "solver.method = 'iterative': must be one of .*pressure is an"),
    ({"geometry": {"shape": "mesh", "file": str(TUBE), "is": "loaded"}}, "geometry.is = 'loaded': not allowed with"),
])  # fmt: skip
def test_what_is_refused(tables: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match=f"^{words}"):
        last_row(OWN | tables)


# ---------------------------------------------------------------- records and ranks


def test_a_run_goes_on(tmp_path: Path) -> None:
    scene = tube("radial", at_steps([0.1, 0.2, 0.4]), supports=CLOSED)
    assert goes_on(scene, tmp_path, 1.0, 2.0).history["pressure"][-1] > 0.1


ON_ONE_AND_TWO_RANKS = [
    {"scene": tube("axisymmetric", at_steps([0.1, 0.2, 0.4]), supports=CLOSED)},
    {"scene": OWN},
]


def test_one_and_two_ranks_agree(both_ranks: Any) -> None:
    for one, two in both_ranks:
        assert_close(two, one, ("u", "l", "pressure", VOLUME), 1e-9, 1e-9)
