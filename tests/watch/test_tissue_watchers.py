"""What a run says of its tissue: volume that is lost, and chains that point out of the wall."""

from __future__ import annotations

import logging
import re
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx.body import SHAPES
from remodel_fenicsx.scene import Scene, scene_from_dict
from remodel_fenicsx.system import NOTICE
from remodel_fenicsx.watch.warnings import VolumeLoss
from tests.conftest import slowly
from tests.runs import rows_of, simulated
from tests.values import PAPER, assert_close, isotropic, ramp_to, ramped


def tube_scene(**tables: Any) -> Scene:
    base = {
        "loads": ramped(1.0, pressure=0.0, elongation=0.0),
        "remodeling": {"law": "none"},
        "time": {"end": 3.0},
    }
    return scene_from_dict(isotropic(**base | tables))


def squeezed(elongation: float, ratio: float, **tables: Any) -> Scene:
    """A tube of a matrix alone that is made shorter; ratio is lambda/mu."""
    loads = ramped(1.0, pressure=0.0) | ramped(2.0, elongation=elongation)
    return tube_scene(
        material={"chain_density": 0.0, "lame_lambda": ratio, "lame_mu": 1.0}, loads=loads, **tables
    )


def said(scene: Scene, caplog: pytest.LogCaptureFixture, word: str) -> list[tuple[int, str]]:
    """Lines of a run with a word: level and text."""
    caplog.clear()
    with caplog.at_level(logging.INFO):
        rows_of(scene)
    return [
        (record.levelno, record.getMessage())
        for record in caplog.records
        if word in record.getMessage()
    ]


def volume_of(elongation: float, ratio: float) -> float:
    """J of uniaxial stress in the neo-Hookean matrix: mu (a^2 - 1) + lambda ln J = 0 with J = a^2 (1 + elongation)."""
    low, high = 0.01, 10.0
    for _ in range(200):
        squared = (low + high) / 2
        low, high = (
            (squared, high)
            if squared - 1 + ratio * np.log(squared * (1 + elongation)) < 0
            else (low, squared)
        )
    return float(low * (1 + elongation))


@pytest.mark.parametrize(
    ("elongation", "ratio", "level"),
    [
        (-0.3, 8.8, None),
        (-0.3, 1.0, logging.INFO),
        (-0.3, 0.0, logging.WARNING),
        (-0.6, 1.0, logging.WARNING),
    ],
)
def test_tissue_that_loses_volume(
    elongation: float, ratio: float, level: int | None, caplog: pytest.LogCaptureFixture
) -> None:
    """The mean and the worst point are those of the closed form, here the same; said once, in words of its level."""
    J = volume_of(elongation, ratio)
    lines = said(squeezed(elongation, ratio), caplog, "of its volume")
    assert (level is None) == (J > 0.95) and (level == logging.WARNING) == (J <= 0.8)
    warned = [logging.WARNING] if level == logging.WARNING else []
    assert [found for found, _ in lines] == ([] if level is None else [*warned, logging.INFO])
    for _, text in lines:  # a warning when it happens, and at the end how much it was
        assert (
            f"has lost up to {100 * (1 - J):.2g} % of its volume at" in text
            and f"(minimum J {J:.3g}, time 2)" in text
        )
        assert f"{100 * (1 - J):.2g} % overall (mean J {J:.3g}, time 2)" in text


def test_the_worst_point_alone_is_enough_for_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    """Suction on a soft thick wall: the inner face is squeezed, the rest is not."""
    loads = {
        "pressure": {"value": -14.0, "ramp": ramp_to(2)},
        "elongation": {"value": 0.0, "ramp": [[0, 1]]},
    }
    material = {"chain_density": 0.0, "lame_lambda": 0.0, "lame_mu": 1.0}
    scene = tube_scene(
        material=material, loads=loads, geometry={"shape": "tube", "outer_radius": 10.0}
    )
    lines = said(scene, caplog, "of its volume")
    assert [level for level, _ in lines] == [logging.WARNING]
    (lost,) = re.findall(r"has lost up to (\d+) % of its volume", lines[0][1])
    assert int(lost) > 40  # of the worst point: the body as a whole has lost a few per cent
    with simulated(scene) as (simulation, rows):
        watcher = next(
            watcher for watcher in simulation.watchers if isinstance(watcher, VolumeLoss)
        )
        assert min(row["min_jacobian"] for row in rows) == watcher._numbers["least"] < 0.6
        assert watcher._numbers["mean"] > 0.9 and 1.2 < watcher._numbers["x"] < 1.3


def test_chains_that_point_out_of_the_wall_are_said(caplog: pytest.LogCaptureFixture) -> None:
    """One notice where most of them do; none of the others, and none of bodies without a wall."""
    for cells, lines in (([0.6, 0.0, 0.8], 1), ([0.8, 0.0, 0.6], 0), ("isotropic", 0)):
        found = said(tube_scene(cells={"initial": cells}), caplog, "out of the wall")
        assert [level for level, _ in found] == [NOTICE] * lines
        assert all(text.startswith("time 1: ") and "radial_share 0.64" in text for _, text in found)
    dimensions, axes, places = (
        np.ones((4, 3)),
        np.broadcast_to(np.eye(3), (4, 3, 3)),
        np.ones((4, 3)),
    )
    assert not SHAPES["cube"](shape="cube", side=1.0).radial_share(dimensions, axes, places).any()


@pytest.mark.parametrize("refinement", [1, *slowly(2)])
def test_a_front_within_the_inner_layer_is_said(
    refinement: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Chains turn from circumferential to axial at R = 1.2: in the first of 8 elements, or the second of 16."""
    loads, time, remodeling = (
        ramped(25.0, pressure=3.0, elongation=0.3),
        {"end": "equilibrium"},
        {"law": "explicit"},
    )
    scene = tube_scene(
        loads=loads, mesh={"degree": 2, "refinement": refinement}, remodeling=remodeling, time=time
    )
    found = said(scene, caplog, "A front lies in these elements")
    assert [level for level, _ in found] == [logging.WARNING] * (refinement == 1)
    assert all("fibre_angle_inner" in text for _, text in found)


COLUMNS = [
    "axial_force",
    "reduced_axial_force",
    "radial_share",
    "fibre_angle_inner",
    "angle_profile_4",
]
WHOLE = {
    "preset": PAPER, "geometry": {"shape": "tube", "length": 2.0}, "time": {"end": 2.0},
    "loads": ramped(2.0, pressure=2.4, elongation=-0.2), "output": {"columns": COLUMNS},
    "material": {"lame_lambda": 2.0},
}  # fmt: skip
ON_ONE_AND_TWO_RANKS = [{"scene": WHOLE, "divisions": [8, 4, 1]}]


def test_one_and_two_ranks_agree(both_ranks: Any) -> None:
    """Of random cells on the whole tube: forces, shares and angles."""
    ((one, two),) = both_ranks
    assert_close(two, one, COLUMNS, 1e-10, 0.0)


# ---------------------------------------------------------------- weak loads
@pytest.mark.parametrize(("factor", "told"), [(1e-6, False), (1e-8, True), (0.0, False)])
def test_loads_that_are_hardly_more_than_rounding_are_told(
    factor: float, told: bool, caplog: Any
) -> None:
    """Whose tensions count in part: the angle is another one than that of loads a hundred times as large."""
    shape = {"shape": "tube", "inner_radius": 1.0, "outer_radius": 3.0, "length": 2.0}
    loads = ramped(25.0, pressure=4.8 * factor, elongation=0.1 * factor)
    scene = isotropic(
        None,
        geometry=shape,
        loads=loads,
        remodeling={"law": "tensor"},
        time={"end": 50.0, "step": 2.5},
    )
    rows = rows_of(scene)
    if factor:
        assert (abs(rows[-1]["fibre_angle_inner"] - 23.03) > 1.0) == told
    assert ["loads too small" in line for line in caplog.messages] == [True] * told
