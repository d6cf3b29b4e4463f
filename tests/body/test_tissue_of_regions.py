"""Regions without collagen, and with a matrix of their own: against bodies and parameters that say the same."""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from remodel_fenicsx import Recording, Scene, SceneError, read_scene
from remodel_fenicsx.body.tube import whole_tube
from remodel_fenicsx.extend import CHAINS, MATRICES, Matrix, Parameter, neo_hookean
from remodel_fenicsx.running import run
from tests.runs import SELF, last_row, made, rows_of
from tests.values import assert_close, isotropic, ramped

WALL = {"shape": "tube", "inner_radius": 1.0, "outer_radius": 2.0, "length": 2.0}
BARE = {"material": {"chain_density": 0.0}}
PLAQUE = {"plaque": {"outer_radius": 1.3, **BARE}, "media": {}}


def scene(regions: dict[str, Any] = PLAQUE, kinematics: str = "radial", **tables: Any) -> Scene:
    """Two layers under a pressure, isotropic at first."""
    values: dict[str, Any] = {
        "mesh": {"refinement": 2, "degree": 2}, "material": {"chain_density": 7e21, "contour_length": 2.125},
        "loads": ramped(4, pressure=0.6, elongation=0.1), "remodeling": {"law": "tensor"}, "time": {"end": 20.0},
    }  # fmt: skip
    values = {
        name: {**values.get(name, {}), **tables.get(name, {})} for name in {**values, **tables}
    }
    return Scene(**isotropic(None, kinematics, geometry=WALL, regions=regions, **values))


def test_a_plaque_carries_as_matrix_alone() -> None:
    """Beside chains that hardly carry it is a body without any; its angles are empty, its cells stay."""
    few = {"plaque": PLAQUE["plaque"], "media": {"material": {"chain_density": 1e15}}}
    row, bare = last_row(scene(few, time={"end": 6.0})), last_row(
        scene({}, material={"chain_density": 0.0})
    )
    assert row["inner_radius"] == pytest.approx(bare["inner_radius"], rel=1e-5)
    assert row["max_chain_extension_plaque"] == 0.0 and np.isnan(row["fibre_angle_plaque"])
    assert np.isnan(row["fibre_angle_inner"]) and 0 < row["fibre_angle_media"] < 90
    assert np.isnan([value for name, value in bare.items() if "angle" in name]).all()


def test_neither_its_stretch_nor_its_cells_stop_or_change_anything() -> None:
    """It is stretched beyond what chains would bear, and no cell of it turns; no law of them has a number there."""
    short = {
        "plaque": {"outer_radius": 1.3, "material": {"chain_density": 0.0, "contour_length": 1.05}},
        "media": {},
    }
    with patch.dict(CHAINS):
        runpy.run_path(
            str(Path(__file__).parents[2] / "demos" / "extensions" / "freely_jointed_chain.py")
        )
        stretched = scene(
            short, loads=ramped(4, pressure=2.0), material={"chain": "freely-jointed"}
        )
        with made(stretched) as simulation:
            before = simulation.cells.dimension_values.copy()
            rows = [step.row for step in simulation.steps()]
            inside = simulation.domain.element_region == simulation.domain.regions["plaque"]
            np.testing.assert_array_equal(simulation.cells.dimension_values[inside], before[inside])
            assert not np.array_equal(simulation.cells.dimension_values[~inside], before[~inside])
        assert (
            max(row["inner_radius"] for row in rows) > 1.55
            and max(row["max_chain_extension"] for row in rows) < 1
        )
        assert np.isfinite([row["stored_energy"] for row in rows]).all()


def test_the_whole_tube_has_it() -> None:
    """As one radius, within the facets of its elements; their kernels are those of the layers of test_layers.py."""
    tables = {"time": {"end": 6.0}, "material": {"repulsion": "axes"}, "mesh": {"refinement": 1}}
    radial, full = (scene(kinematics=name, **tables) for name in ("radial", "full"))
    domain = whole_tube(full.geometry, (8, 8, 1), "hexahedron", 2, SELF, full.regions)
    names = ("inner_radius", "outer_radius", "fibre_angle_media", "fibre_angle_outer")
    assert_close(last_row(full, domain), last_row(radial), names, 1e-5)


def test_fields_of_it_are_empty(tmp_path: Path) -> None:
    """No angle, no chain lines of any length."""
    folder = run(scene(output={"fields": True}, time={"end": 2.0}), tmp_path / "run", SELF)
    found = Recording(folder).fields(2.0)
    inside = found["region"] == found["region"][np.isnan(found["fibre_angle"])][0]
    assert 0 < inside.sum() < len(inside) and np.isnan(found["fibre_angle"][inside]).all()
    assert (found["cell_dimensions"][inside] == 0).all() and (
        found["cell_dimensions"][~inside] > 0
    ).any()


def test_what_needs_chains_everywhere_is_refused() -> None:
    for tables, line in (
        (
            {"time": {"end": "equilibrium"}},
            "time.end = 'equilibrium': needs chains: regions.plaque.material.chain_de",
        ),
        (
            {"remodeling": {"turnover": {"time": 40.0}}},
            "remodeling.turnover: needs chains: regions.plaque.material.",
        ),
        (
            {"remodeling": {"law": "rotation"}},
            "regions.plaque.material.chain_density = 0.0: a region without chains must not remodel",
        ),
    ):
        with pytest.raises(SceneError) as refused:
            scene(**tables)  # type: ignore[arg-type]
        assert str(refused.value).startswith(line)


# ---------------------------------------------------------------- a matrix by region


@pytest.fixture
def scaled() -> Iterator[None]:
    """A matrix with a number of its own: the built-in one times a factor."""

    def volumetric(J: Any, lam: Any, mu: Any, factor: Any) -> Any:
        return factor * neo_hookean.volumetric(J, lam, mu)

    def others(F: Any, lam: Any, mu: Any, factor: Any) -> Any:
        return factor * neo_hookean.distortional(F, lam, mu)

    with patch.dict(MATRICES):
        numbers = {"factor": Parameter(1.0, "Of the energy.", exclusive_minimum=0.0)}
        MATRICES["scaled"] = Matrix(volumetric, others, parameters=numbers)
        MATRICES["whole"] = lambda F, lam, mu: neo_hookean(F, lam, mu)
        yield


STIFFER = {"lame_mu": 2 * 3.103, "lame_lambda": 2 * 27.293}
TWICE = {"matrix": "scaled", "factor": 2.0}


@pytest.mark.parametrize("tables", [
    {}, {"mesh": {"formulation": "selective-integration"}, "remodeling": {"law": "none"}},
], ids=str)  # fmt: skip
def test_a_region_has_a_matrix_of_its_own(scaled: None, tables: dict[str, Any]) -> None:
    """One that is twice the built-in one is that of twice the moduli, in the inner layer or in the outer one."""
    columns = [
        "inner_radius",
        "stored_energy",
        "hoop_stress_a" if "mesh" in tables else "fibre_angle_a",
    ]
    for name in ("a", "b"):
        layers = {"a": {"outer_radius": 1.4}, "b": {}}
        twice, stiffer = (
            {**layers, name: {**layers[name], "material": own}} for own in (TWICE, STIFFER)
        )
        asked = tables | {
            "time": {"end": 6.0},
            "output": {"columns": [*columns, "newton_iterations"]},
        }
        rows = [rows_of(scene(regions, **asked)) for regions in (twice, stiffer)]
        for column in columns:
            np.testing.assert_allclose(*([row[column] for row in one] for one in rows), rtol=1e-7)
        of_twice, of_stiffer = (sum(row["newton_iterations"] for row in one) for one in rows)
        assert of_twice <= 1.2 * of_stiffer  # its tangent is that of its stress


def test_its_numbers_are_keys_of_the_region(scaled: None, tmp_path: Path) -> None:
    """They are written and read again; what it leaves out is the body's, or the matrix's own."""
    regions = {
        "a": {"outer_radius": 1.4, "material": TWICE},
        "b": {"material": {"matrix": "scaled"}},
    }
    found = scene(regions)
    (tmp_path / "scene.toml").write_text(found.to_toml())
    assert read_scene(tmp_path / "scene.toml") == found
    factors = [one.tissue.matrix.values["factor"] for one in found.properties().values()]  # type: ignore[attr-defined]
    assert factors == [2.0, 1.0]
    body = scene(regions, material={"matrix": "scaled", "factor": 3.0}).properties()
    assert [one.tissue.matrix.values["factor"] for one in body.values()] == [2.0, 3.0]  # type: ignore[attr-defined]


def test_what_is_refused(scaled: None) -> None:
    for own, line in (
        (
            {"matrix": "whole"},
            "regions.b.material.matrix = 'whole': must be 'neo-hookean', or both need",
        ),
        ({"matrix": "none"}, "regions.b.material.matrix = 'none': must be one of 'neo-hookean'"),
        ({"factor": 2.0}, "regions.b.material.factor = 2.0: unknown key"),
        (
            {"matrix": "scaled", "factor": -1.0},
            "regions.b.material.factor = -1.0: must be a finite number greater",
        ),
    ):
        with pytest.raises(SceneError) as refused:
            scene({"a": {"outer_radius": 1.4}, "b": {"material": own}})
        assert str(refused.value).startswith(line)
