"""The stability map: its reduced form, that no case gets lost, and that it can tell right from wrong."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.stability_map.cases import all_cases
from benchmarks.stability_map.homogeneous import CUBE
from benchmarks.stability_map.running import Runner, evaluated
from tests.body.test_cube import closed_form_angle
from tests.reference.march import Bar, march, material
from tests.reference.point import prescribed_path
from tests.reference.solid import smallest_eigenvalue

CASES = all_cases()
REDUCED = [key for key, case in CASES.items() if case.reduced]
EXPECTED = tomllib.loads(
    Path(__file__).with_name("stability_expected.toml").read_text(encoding="utf-8")
)["outcomes"]
# of each kind one, a second or less: the others of the reduced map are marked slow
QUICK = (
    "load: frame spatial, force 10.0", "load: frame material, force 0.0001",
    "speed: law explicit, frame spatial, kappa dt 1000.0",
    "chain length: frame spatial, force 10.0, r0/L 0.999", "compression: frame material, density 7e+21, force -10.0",
    "compression: frame material, density 7e+21, force -30.0", "steps: frame spatial, steps 1, force 10000.0",
    "unloading: history reversed, law explicit, frame spatial, force 10.0",
)  # fmt: skip


@pytest.fixture(scope="module")
def runner() -> Iterator[Runner]:
    """The package of this checkout."""
    made = Runner(limit=60)
    yield made
    made.close()


def hold(key: str, runner: Runner) -> None:
    """The outcome is what the table says; else right, refused or named as unstable, and no false alarm."""
    record = evaluated(CASES[key], runner, "test")
    said = f"{record['outcome']}: {record['words']}\n{CASES[key].command}"
    if key in EXPECTED:
        assert (
            record["outcome"] == EXPECTED[key]
        ), f"better or worse than tests/studies/stability_expected.toml says: {said}"
        return
    assert record["outcome"] in ("right", "refused", "unstable"), said
    assert not record["false_alarm"], said


@pytest.mark.parametrize("key", QUICK)
def test_quick_cases(key: str, runner: Runner) -> None:
    assert key in REDUCED
    hold(key, runner)


@pytest.mark.slow
@pytest.mark.parametrize("key", [key for key in REDUCED if key not in QUICK])
def test_reduced_map(key: str, runner: Runner) -> None:
    """Two minutes on two cores."""
    hold(key, runner)


def test_the_table_of_known_faults_has_no_other_cases() -> None:
    assert set(EXPECTED) <= set(REDUCED)
    assert set(EXPECTED.values()) <= {"wrong", "warned", "unchecked"}


# ---------------------------------------------------------------- references
def test_the_point_knows_the_closed_form() -> None:
    """The cube's angle (demos/cube.toml), whatever the stretch."""
    path = march(CUBE, Bar(CUBE))
    # the cells of a row are those of the step before
    angle = closed_form_angle(0.025, np.array(path.times) - 1)
    np.testing.assert_allclose(path.angle(), angle, rtol=1e-12)
    held = smallest_eigenvalue(np.ones(3), np.full(3, 1 / 3), material(CUBE))
    assert held == pytest.approx(1.0)


def test_both_points_agree_where_axes_stay() -> None:
    """The one that solves for stretches and the one that takes any F, each driver and law."""
    for driver in ("cauchy", "pk2", "finger"):
        for law in ("explicit", "rate", "relaxation", "tensor"):
            scene = {
                **CUBE,
                "remodeling": {**CUBE["remodeling"], "driver": driver, "law": law},
                "time": {"end": 30.0, "step": 1.0},
            }
            path = march(scene, Bar(scene))
            F = np.array([np.diag(stretches) for stretches in path.unknowns])
            A = prescribed_path(
                material(scene), F, np.array(path.times), np.full(3, 3**-0.5), driver, law
            )
            along = A[:, 2, 2]
            np.testing.assert_allclose(
                along, np.array(path.squares)[:, 0, 2], atol=1e-9, err_msg=f"{driver} {law}"
            )
