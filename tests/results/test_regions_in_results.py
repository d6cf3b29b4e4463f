"""What a run leaves of regions: columns, the field, the page; the same on two ranks and where a run goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Recording, Scene, SceneError, run
from remodel_fenicsx.results.whole_body import revolve
from remodel_fenicsx.running import resume
from remodel_fenicsx.studies import sweep as study
from tests.conftest import forked_children
from tests.results.test_resume import assert_same
from tests.runs import made
from tests.values import assert_close, ramp_to

RAMP = ramp_to(3.0)
VALUES: dict[str, Any] = {
    "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 1.0},
    "regions": {
        "media": {"outer_radius": 1.7, "material": {"chain_density": 1e21}, "remodeling": {"kappa": 0.1}},
        "adventitia": {"material": {"contour_length": 1.8}, "cells": {"initial": "aligned", "aligned_axis": 2}},
    },
    "cells": {"initial": "isotropic"},
    "loads": {"pressure": {"value": 2.4, "ramp": RAMP}, "elongation": {"value": 0.1, "ramp": RAMP}},
    "remodeling": {"law": "explicit"}, "solver": {"method": "direct"}, "time": {"end": 4.0},
    "model": {"kinematics": "radial"},
}  # fmt: skip
WHOLE = VALUES | {"model": {"kinematics": "sector"}, "time": {"end": 3.0},
                  "regions": VALUES["regions"] | {"adventitia": {"cells": {"initial": "random"}}}}  # fmt: skip
ON_ONE_AND_TWO_RANKS = [{"scene": WHOLE}]
COLUMNS = [
    f"{name}_{region}"
    for region in ("media", "adventitia")
    for name in ("fibre_angle", "max_chain_extension")
]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run."""
    return run(Scene(**VALUES), tmp_path_factory.mktemp("layers") / "run")


def test_the_columns_of_regions_share_out_those_of_the_body(recorded: Path) -> None:
    """r/L: the larger one is the body's. Angles: means of the state, by the volumes that are known from the radii."""
    history = Recording(recorded).history
    names = list(history)
    assert [name for name in names if name in COLUMNS] == COLUMNS, "in the order of the scene"
    assert (
        names.index("fibre_angle_outer")
        < names.index(COLUMNS[0])
        < names.index("max_chain_extension")
    )
    larger = np.maximum(
        history["max_chain_extension_media"], history["max_chain_extension_adventitia"]
    )
    np.testing.assert_allclose(larger, history["max_chain_extension"], rtol=1e-12)
    assert np.all(history["max_chain_extension_media"] != history["max_chain_extension_adventitia"])
    start = [history[f"fibre_angle_{name}"][0] for name in ("media", "adventitia")]
    assert start == pytest.approx([45.0, 90.0])
    recording = Recording(recorded)
    for row, time in enumerate(
        recording.times
    ):  # means of elements, as the fields have them: cells of a row are equal
        fields = recording.fields(time)
        areas = np.diff(np.sort(recording.points[:, 0]) ** 2)
        for region, name in enumerate(("media", "adventitia"), start=1):
            inside = fields["region"] == region
            mean = np.average(fields["fibre_angle"][inside], weights=areas[inside])
            assert history[f"fibre_angle_{name}"][row] == pytest.approx(mean, abs=0.05)


def test_only_what_is_asked_for_is_measured() -> None:
    with made(Scene(**VALUES | {"output": {"columns": ["fibre_angle_media"]}})) as simulation:
        assert [column.name for column in simulation.observer.columns][-1] == "fibre_angle_media"
        assert len(simulation.observer.columns) == 4, "time, loads and it"
    with pytest.raises(
        SceneError,
        match="output.columns = 'fibre_angle_intima': no such column on request; allowed",
    ):
        Scene(**VALUES | {"output": {"columns": ["fibre_angle_intima"]}})


def test_the_field_has_the_number_of_each_elements_region(recorded: Path, tmp_path: Path) -> None:
    """On one radius, and in the whole body that is made of it; bodies without regions have none."""
    recording = Recording(recorded)
    middle = recording.points[recording.elements].mean(axis=1)[:, 0]
    np.testing.assert_array_equal(recording.fields(4.0)["region"], np.where(middle < 1.7, 1, 2))
    import h5py

    with h5py.File(revolve(recorded)[0]) as file:
        found = set(file["VTKHDF/CellData/region"][:])
    assert found == {1.0, 2.0}
    plain = run(Scene(**{key: value for key, value in VALUES.items() if key != "regions"} | {"time": {"end": 1.0}}),
                tmp_path / "plain")  # fmt: skip
    assert "region" not in Recording(plain).fields(1.0)
    with pytest.raises(SceneError, match="^output.fields = 'region': the scene has no regions$"):
        Scene(**{**VALUES, "regions": {}, "output": {"fields": ["region"]}})


def test_it_goes_on_to_the_last_bit(recorded: Path, tmp_path: Path) -> None:
    half = run(Scene(**VALUES | {"time": {"end": 2.0}}), tmp_path / "half")
    resume(half, ["time.end=4.0"])
    assert_same(half, recorded)
    with pytest.raises(
        SceneError, match="^regions.media.remodeling.kappa = 0.2: was 0.1; a resumed run may change"
    ):
        resume(half, ["regions.media.remodeling.kappa=0.2"])


def test_one_and_two_ranks_agree(both_ranks: Any) -> None:
    ((one, two),) = both_ranks
    np.testing.assert_array_equal(one["l0"], two["l0"])
    assert np.ptp(one["l0"], axis=(0, 1)).min() > 0.5, "isotropic and random cells"
    assert_close(two, one, (*COLUMNS, "inner_radius", "outer_radius"), atol=1e-7)
    np.testing.assert_allclose(two["u"], one["u"], rtol=0, atol=1e-8)


def test_an_ensemble_draws_the_cells_of_the_region_that_has_random_ones(tmp_path: Path) -> None:
    """The other region's stay as they are."""
    scene = Scene(**WHOLE | {"time": {"end": 1.0}, "output": {"report": False}})
    with forked_children():
        folder, found = study.ensemble(scene, tmp_path / "out", seeds=2)
    assert not found.failed
    assert len(found.histories) == 2 and "fibre_angle_adventitia_mean" in found.table()
    scenes = [Recording(folder / f"seed-{n}").scene for n in (1, 2)]
    assert [one.cells.seed for one in scenes] == [1, 2]
    assert {one.regions["adventitia"].cells.initial for one in scenes} == {"random"}
    extremes = {column.name for column in scene.columns() if column.extreme}
    assert extremes >= {"max_chain_extension_media", "max_chain_extension_adventitia"}
