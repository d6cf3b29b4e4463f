"""Reduced kinematics: equal to the full one, or to an independent solution, where allowed; refused elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, Scene, SceneError, Simulation, cli, run
from remodel_fenicsx.body.reductions import AUTO, choice, describe_choice, objections
from remodel_fenicsx.fem import jit
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.results.columns import Measurement
from remodel_fenicsx.scene import scene_from_dict
from tests.conftest import Refused, slowly
from tests.reference.radial import solve_radial
from tests.runs import columns, columns_of, made
from tests.tables import rows as table, values as values_of
from tests.values import assert_close, ramped

SELF = MPI.COMM_SELF
ISOTROPIC = {"initial": "isotropic"}
OF_THE_SOLVER = ("seconds", "newton_iterations", "linear_iterations", "substeps")


def values(shape: str, kinematics: str, end: float, **tables: Any) -> dict[str, Any]:
    """The preset's body with isotropic cells, as a scene's values."""
    base = {
        "preset": "kuhl-holzapfel-2007",
        "geometry": {"shape": shape},
        "model": {"kinematics": kinematics},
    }
    return base | {"cells": ISOTROPIC, "time": {"end": end}} | tables


def scene(*arguments: Any, **tables: Any) -> Scene:
    return scene_from_dict(values(*arguments, **tables))


def difference(one: Scene, other: Scene) -> float:
    """Largest difference of a column, relative to its largest value; the power of remodeling has fewer digits."""
    first, second = columns_of(one), columns_of(other)
    assert list(first) == list(second)
    found = 0.0
    for name in [name for name in first if name not in OF_THE_SOLVER]:
        size = max(float(np.abs(second[name]).max()), 1e-12)
        share = float(np.abs(first[name] - second[name]).max()) / size
        found = max(found, share / 100 if name == "remodeling_power" else share)
    return found


# ---------------------------------------------------------------- against what is known otherwise
def ray_and_reference(
    driver: str, end: float, **mesh: int
) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Of tests/reference all; radii (2, steps), angle and the reference's at the quadrature points of a ray."""
    exact = solve_radial(driver=driver, end=end, elements=150)
    with made(scene("tube", "radial", end, mesh=mesh, remodeling={"driver": driver})) as simulation:
        steps = list(simulation.steps())
        radii = np.array(
            [[step.row[name] for step in steps] for name in ("inner_radius", "outer_radius")]
        )
        angle = Measurement(simulation.observer, steps[-1]).fibre_angle
        expected = np.interp(
            simulation.quadrature.coordinates[..., 0], exact.points, exact.fibre_angle()
        )
    assert np.ptp(angle) > 3.0
    return exact, radii, angle, expected


@pytest.mark.parametrize("driver", ["cauchy", "pk2", "finger"])
def test_radial_is_the_independent_solution(driver: str) -> None:
    """Linear elements, which other tests compile anyway: the limit of 72 and 144 against 150 of tests/reference."""
    (_, coarse, *_), (exact, fine, angle, expected) = (
        ray_and_reference(driver, 10.0, refinement=refinement) for refinement in (9, 18)
    )
    limit = fine + (fine - coarse) / 3
    np.testing.assert_allclose(limit, [exact.inner_radii, exact.outer_radii], rtol=1e-6)
    # about the middle of such an element the strain rises and falls
    np.testing.assert_allclose(angle.mean(axis=1), expected.mean(axis=1), rtol=0, atol=0.01)


@pytest.mark.parametrize("driver", ["cauchy", *slowly("pk2", "finger")])
def test_the_consistent_law_is_the_independent_solution(driver: str) -> None:
    """Its law, typed by hand in the reference too; linear elements, which other tests of this law compile anyway."""
    changes = {"driver": driver, "law": "tensor", "frame": "material"}
    tables: dict[str, Any] = {"mesh": {"refinement": 18}, "material": {"repulsion": "log"}}
    exact, printed = (
        solve_radial(driver=driver, law=law, end=10.0, elements=150)
        for law in ("tensor", "explicit")
    )
    with made(scene("tube", "radial", 10.0, remodeling=changes, **tables)) as simulation:
        steps = list(simulation.steps())
        inner = [step.row["inner_radius"] for step in steps]
        np.testing.assert_allclose(inner, exact.inner_radii, rtol=2e-5)
        assert np.abs(printed.inner_radii / exact.inner_radii - 1).max() > 1e-3
        angle = Measurement(simulation.observer, steps[-1]).fibre_angle
        expected = np.interp(
            simulation.quadrature.coordinates[..., 0], exact.points, exact.fibre_angle()
        )
        # linear elements: about their middle the strain rises and falls by 0.1 degrees
        np.testing.assert_allclose(angle.mean(axis=1), expected.mean(axis=1), rtol=0, atol=0.01)


@pytest.mark.parametrize("cells", [ISOTROPIC, {"initial": [0.6, 0.0, 0.8]}, {"initial": "random"}])
def test_a_cube_is_a_point(cells: dict[str, Any]) -> None:
    assert (
        difference(*(scene("cube", name, 12.0, cells=cells) for name in ("point", "full"))) < 1e-9
    )


@pytest.mark.parametrize(
    "cells", [{"initial": [0.48, 0.6, 0.64]}, ISOTROPIC | {"axes": "cylindrical"}]
)
def test_a_tendon_is_a_point(cells: dict[str, Any]) -> None:
    assert (
        difference(*(scene("tendon", name, 4.0, cells=cells) for name in ("point", "full"))) < 1e-9
    )


def test_a_half_plane_is_a_ray() -> None:
    assert difference(*(scene("tube", name, 6.0) for name in ("axisymmetric", "radial"))) < 1e-9


def clamped(name: str, end: float) -> float:
    """Inner radius of a tube with clamped ends."""
    return float(
        columns_of(scene("tube", name, end, supports={"ends": "clamped"}))["inner_radius"][-1]
    )


def test_clamped_ends_hold_a_half_plane_as_a_quarter() -> None:
    """The quarter has plane elements around: 0.2 % away on the paper's mesh. Free ends would let it widen more."""
    half_plane, quarter = (clamped(name, 3.0) - 1.0 for name in ("axisymmetric", "sector"))
    free = float(columns_of(scene("tube", "radial", 3.0))["inner_radius"][-1]) - 1.0
    assert half_plane == pytest.approx(quarter, rel=0.03)
    assert half_plane < 0.85 * free


# ---------------------------------------------------------------- random cells of a quarter
def test_a_quarter_of_random_cells_is_the_tube_that_has_their_mirror_images(
    monkeypatch: Any,
) -> None:
    """With all layers along z: the whole tube, given these cells by hand, has the same columns."""
    monkeypatch.setattr("remodel_fenicsx.body.tube.PAPER", (16, 8, 4))
    random = {"cells": {"initial": "random", "axes": "cylindrical", "seed": 3}}
    quarter, whole = (
        Simulation(scene("tube", name, 2.0, **random), SELF) for name in ("sector", "full")
    )
    assert quarter.domain.number_of_elements == 128
    own, every = (one.quadrature.coordinates.mean(axis=1) for one in (quarter, whole))
    distances = np.linalg.norm(np.abs(every)[:, None] - own, axis=-1)
    assert distances.min(axis=1).max() < 1e-6
    cells, lengths = whole.cells, quarter.cells.dimension_values[distances.argmin(axis=1)]
    assert np.ptp(lengths[:, 0, 0]) > 0.9
    cells.set(lengths, cells.initial_axes())
    cells.initial_dimensions[:] = lengths
    part, body = (columns([step.row for step in one.steps()]) for one in (quarter, whole))
    assert_close(part, body, set(part) - {*OF_THE_SOLVER}, 1e-8, 1e-10)
    for one in (quarter, whole):
        one.close()


def test_it_is_named_never_chosen_and_says_what_it_means(caplog: pytest.LogCaptureFixture) -> None:
    base = scene("tube", "sector", 2.0, cells={"initial": "random", "axes": "cylindrical"})
    words = [
        line
        for line in describe_choice(base)
        if "means over seeds are nearly those of the whole tube" in line
    ]
    assert len(words) == 1
    left = describe_choice(base.with_values({"model.kinematics": AUTO}))
    assert "'full'" in left[0] and any(
        line.startswith("'sector' is also allowed for means over seeds") for line in left
    )
    with caplog.at_level("INFO"):
        Simulation(base, SELF).close()
    assert words[0] in caplog.messages
    assert not [
        line for line in describe_choice(scene("tube", "sector", 2.0)) if "means over seeds" in line
    ]


# ---------------------------------------------------------------- rules


@pytest.mark.parametrize(
    ("shape", "name", "refused", "allowed", "words"), table(__file__, "kinematics_rules.txt")
)
def test_every_rule_refuses_a_scene_and_allows_its_neighbour(
    shape: str, name: str, refused: str, allowed: str, words: str
) -> None:
    base, asked = scene(shape, AUTO, 2.0), values_of(refused)
    assert [reason for reason in objections(base.with_values(asked), name) if words in reason]
    with pytest.raises(SceneError, match=f"model.kinematics = '{name}': .*{words}"):
        base.with_values({**asked, "model.kinematics": name})
    chosen = base.with_values({**values_of(allowed), "model.kinematics": name})
    assert chosen.model.kinematics == name


def test_a_load_is_for_the_reductions_that_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a tube: one that only a quarter has, beside those that all have."""
    from remodel_fenicsx.body import LoadKind, Tube

    lift = LoadKind(lambda shape, loading, name: None, "of a quarter", reductions=("sector",))
    monkeypatch.setitem(Tube.loads, "lift", lift)
    lifted = scene("tube", AUTO, 2.0, loads=ramped(2, lift=1.0))
    for name in ("radial", "axisymmetric"):
        with pytest.raises(SceneError, match=f"'{name}': loads.lift "):
            lifted.with_values({"model.kinematics": name})
        assert not objections(scene("tube", AUTO, 2.0), name)
    assert choice(lifted).name == "sector"


def test_axes_of_ones_own_may_have_no_symmetry(monkeypatch: pytest.MonkeyPatch) -> None:
    from remodel_fenicsx.body import Cube, Tube
    from remodel_fenicsx.model.cells import global_axes
    from remodel_fenicsx.model.axes import AXES

    monkeypatch.setitem(
        AXES, "tilted", lambda points: np.roll(global_axes(points.coordinates), 1, axis=-1)
    )
    for shape in (Cube, Tube):
        monkeypatch.setattr(shape, "axis_kinds", ("global", "cylindrical", "tilted"))
    for shape, name, words in (
        ("tube", "sector", "may have no planes of symmetry"),
        ("tube", "radial", "along the diagonal"),
        ("cube", "point", "the cells may not be homogeneous"),
    ):
        base = scene(shape, AUTO, 2.0)
        with pytest.raises(SceneError, match=f"'{name}': cells.axes = 'tilted':? .*{words}"):
            base.with_values({"cells.axes": "tilted", "model.kinematics": name})
        assert not objections(base, name)


@pytest.mark.parametrize(("shape", "tables", "name"), [
    ("tube", {}, "radial"), ("tube", {"supports": {"ends": "clamped"}}, "axisymmetric"),
    ("tube", {"cells": ISOTROPIC | {"axes": "global"}}, "sector"),
    ("tube", {"cells": {"initial": "random"}}, "full"),  # the quarter is right for means alone
    ("cube", {}, "point"), ("tendon", {"cells": {"initial": "random"}}, "full"),
])  # fmt: skip
def test_auto_takes_the_cheapest_that_is_allowed(
    shape: str, tables: dict[str, Any], name: str
) -> None:
    chosen = scene(shape, AUTO, 2.0, **tables)
    assert choice(chosen).name == name
    lines = describe_choice(chosen)
    assert lines[0].startswith(f"kinematics '{name}'")
    assert len(lines) == len(chosen.geometry.reductions) + (name == "full")


def test_without_a_preset_the_choice_is_auto_and_presets_are_full() -> None:
    assert (
        scene_from_dict({"geometry": {"shape": "cube"}, "time": {"end": 1.0}}).model.kinematics
        == AUTO
    )
    assert (
        scene_from_dict({"preset": "consistent", "geometry": {"shape": "cube"}}).model.kinematics
        == "full"
    )


def test_what_the_symmetric_solution_cannot_show_is_said() -> None:
    for remodeling, said in (({"driver": "pk2"}, True), ({"law": "rate"}, True), ({}, False)):
        lines = describe_choice(scene("tube", AUTO, 2.0, remodeling=remodeling))
        assert any("leaves it after a while" in line for line in lines) == said
    assert not any(
        "leaves it" in line
        for line in describe_choice(scene("cube", AUTO, 2.0, remodeling={"driver": "pk2"}))
    )


@pytest.mark.parametrize(
    ("shape", "name", "size"), [("cube", "point", {"side": 2.5}), ("tendon", "point", {"area": 3.0}),
                                ("tube", "radial", {"length": 2.5})]
)  # fmt: skip
def test_another_size_compiles_nothing(shape: str, name: str, size: dict[str, float]) -> None:
    """The size of the body is no literal of the kernels."""
    columns_of(scene(shape, name, 1.0))
    before = len(jit.compiled_kernels)
    columns_of(scene(shape, name, 1.0, geometry={"shape": shape, **size}))
    assert len(jit.compiled_kernels) == before


TENSOR = {"law": "tensor", "coupling": "extrapolated"}
TWICE = {
    "point": values("cube", "point", 5.0),
    "one element": values("cube", "full", 3.0, mesh={"formulation": "selective-integration"}),
    "chosen steps of a point": values(
        "cube", "point", 3.0, time={"end": 3.0, "tolerance": 1.0}, remodeling=TENSOR
    ),
    "radial": values("tube", "radial", 5.0),
    "axisymmetric": values("tube", "axisymmetric", 5.0, supports={"ends": "clamped"}),
    "sector": values("tube", "sector", 3.0, cells={"initial": "random", "axes": "cylindrical"}),
}
ON_ONE_AND_TWO_RANKS = [
    {"scene": scene | {"solver": {"relative_tolerance": 1e-13}}} for scene in TWICE.values()
]


@pytest.fixture(scope="module")
def on_one_and_two_ranks(both_ranks: Any) -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
    """What each of them saves."""
    return dict(zip(TWICE, both_ranks, strict=True))


@pytest.mark.parametrize("name", TWICE)
def test_two_ranks_give_the_same(
    name: str, on_one_and_two_ranks: dict[str, tuple[dict[str, Any], dict[str, Any]]]
) -> None:
    one, two = on_one_and_two_ranks[name]
    shape = TWICE[name]["geometry"]["shape"]
    columns = (
        ["mean_stretch", "force"]
        if shape == "cube"
        else ["inner_radius", "outer_radius", "fibre_angle_middle"]
    )
    assert_close(two, one, (*columns, "stored_energy", "max_chain_extension"), 1e-12, 0.0)
    np.testing.assert_allclose(two["l"], one["l"], rtol=0, atol=1e-11)


# ---------------------------------------------------------------- records
@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Folder of a shape's full run of one step, made once."""
    return cache(
        lambda shape: run(scene(shape, "full", 1.0), tmp_path_factory.mktemp("full") / shape, SELF)
    )


@pytest.mark.parametrize(
    ("shape", "name", "cell"),
    [
        ("cube", "point", 3),
        ("tube", "radial", 3),
        ("tube", "axisymmetric", 9),
        ("tube", "sector", 12),
    ],
)
def test_recorded_fields_are_revolved_into_the_body(
    shape: str,
    name: str,
    cell: int,
    whole: Callable[[str], Path],
    tmp_path: Path,
    refused: Refused,
    monkeypatch: Any,
) -> None:
    """Held against the full run, element by element. Those of `full` lie between chords."""
    monkeypatch.setattr("remodel_fenicsx.body.tube.PAPER", (16, 4, 2))
    folders = {name: run(scene(shape, name, 1.0), tmp_path / name, SELF), "full": whole(shape)}
    with h5py.File(folders[name] / "fields.vtkhdf") as file:
        assert set(file["VTKHDF/Types"][:]) == {cell}
    assert cli.main(["revolve", str(folders[name])]) == 0
    (tmp_path / "body").mkdir()
    for file_name, source in (
        ("fields_body.vtkhdf", name),
        ("scene.toml", name),
        ("history.csv", name),
    ):
        target = file_name.replace("fields_body", "fields")
        (tmp_path / "body" / target).write_bytes((folders[source] / file_name).read_bytes())
    body, full = Recording(tmp_path / "body"), Recording(folders["full"])
    np.testing.assert_array_equal(body.times, full.times)
    tolerance = 1e-5 if name == "point" else 0.03
    found, expected = body.fields(1.0), full.fields(1.0)
    assert set(found) == set(expected)
    own, others = (run.points[run.elements].mean(axis=1) for run in (body, full))
    nearest = np.linalg.norm(others[:, None] - own, axis=2).argmin(axis=1)
    found = {field: values[nearest] for field, values in found.items() if field != "displacement"}
    for field in ("deformation_gradient", "cauchy_stress", "fibre_angle", "chain_extension"):
        size = np.abs(
            expected[field] - (np.eye(3).ravel() if field == "deformation_gradient" else 0.0)
        ).max()
        np.testing.assert_allclose(
            found[field], expected[field], rtol=0, atol=tolerance * size, err_msg=field
        )
    axes = (
        np.stack([fields[f"axis_{i}"] for i in (1, 2, 3)], axis=1) for fields in (found, expected)
    )
    structure = map(structure_tensor, (found["cell_dimensions"], expected["cell_dimensions"]), axes)
    np.testing.assert_allclose(*structure, rtol=0, atol=0.01)
    with h5py.File(folders[name] / "fields_body_chains.vtkhdf") as file:
        assert file["VTKHDF/NumberOfCells"][0] == 4 * len(body.elements)
    refused("revolve", folders[name])  # nothing is overwritten


def test_a_full_run_has_nothing_to_revolve(whole: Callable[[str], Path], refused: Refused) -> None:
    assert "'full': the fields are those of the body already" in refused("revolve", whole("cube"))


# ---------------------------------------------------------------- what buckles
@pytest.mark.parametrize(
    ("force", "unstable", "name"), [(10.0, "warn", "point"), (-30.0, "warn", "full")]
)
def test_auto_is_full_where_a_load_presses(force: float, unstable: str, name: str) -> None:
    """The cube under -30 leaves its shape by a mode that a point does not have."""
    scene = scene_from_dict({
        "geometry": {"shape": "cube"}, "cells": {"initial": "isotropic"}, "time": {"end": 3.0},
        "loads": ramped(3.0, force=force),
    })  # fmt: skip
    assert choice(scene).name == name
    assert ("buckle" in " ".join(describe_choice(scene))) == (name == "full")
    stops = scene.with_values({"solver.unstable": "stop"})
    assert choice(stops).name == "full" and "modes of the whole body" in " ".join(
        describe_choice(stops)
    )
