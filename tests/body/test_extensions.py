"""Whatever CONTRIBUTING.md says can be added, added from outside the package, as a user's script would.

Each test writes the new thing, registers it, names it in a scene and looks at the physics. It imports only what a user
may; `monkeypatch.setitem` stands for the script's own ``REGISTRY["mine"] = mine``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import dolfinx
import numpy as np
import pytest
import ufl
from mpi4py import MPI
from pydantic import Field

from remodel_fenicsx import Recording, Scene, SceneError, Simulation, extend, parts, run
from remodel_fenicsx.parts import Cube, Domain, Remodeling
from tests.runs import rows_of, simulated
from tests.values import ramp_to, ramped

KAPPA = 0.1
SCENE: dict[str, Any] = {
    "preset": "kuhl-holzapfel-2007",
    "geometry": {"shape": "cube"},
    "model": {"kinematics": "point"},
    "loads": ramped(2.0, force=10.0),
    "remodeling": {"kappa": KAPPA},
    "time": {"end": 4.0},
}
ELASTIC = {"remodeling.law": "none"}
WITHOUT_CHAINS = {"material.chain_density": 0.0, "remodeling.law": "none"}


def scene(**tables: dict[str, Any]) -> Scene:
    """The cube as a point, pulled in two steps and held, with other values: its kernels compile fastest."""
    values = {
        name: dict(table) if isinstance(table, dict) else table for name, table in SCENE.items()
    }
    for name, table in tables.items():
        values[name] = {**values.get(name, {}), **table}
    return Scene(**values)


def whole(**tables: dict[str, Any]) -> Scene:
    """The same with the full kinematics, where what is added needs a mesh."""
    return scene(**{"model": {"kinematics": "full"}, **tables})


def column(rows: list[dict[str, float]], name: str) -> list[float]:
    """A column, without its start."""
    return [row[name] for row in rows]


# ---------------------------------------------------------------- tissue
def test_a_chain_law(monkeypatch: pytest.MonkeyPatch) -> None:
    """A linear spring in three dimensions: with isotropic cells it is a matrix with mu + c g / 3, and never locks."""
    g = 0.7
    monkeypatch.setitem(
        extend.CHAINS,
        "spring",
        extend.Chain(lambda r, L: g * r**2 / 2, lambda r, L: g, locks=False),
    )
    pulled = scene(loads=ramped(4.0, force=30.0)).with_values(ELASTIC)
    springs = pulled.with_values({"material.chain": "spring"})
    with simulated(springs) as (simulation, found):
        squared = simulation.stepper.coupling.equilibrium.squared_lengths()
    assert (
        np.sqrt(squared.min()) > springs.material.contour_length
    )  # no wormlike chain can be so long
    assert set(column(found, "max_chain_extension")) == {0.0}
    stiffer = pulled.material.lame_mu + pulled.material.network_modulus * g / 3
    matrix = rows_of(pulled.with_values({**WITHOUT_CHAINS, "material.lame_mu": stiffer}))
    np.testing.assert_allclose(
        column(found, "mean_stretch"), column(matrix, "mean_stretch"), rtol=1e-9
    )
    wormlike = rows_of(pulled)[-1]
    assert 0.8 < wormlike["max_chain_extension"] < 1.0
    assert wormlike["mean_stretch"] < found[-1]["mean_stretch"] / 1.5


def test_a_chain_that_does_not_lock_may_start_longer_than_its_contour_length(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(
        extend.CHAINS, "spring", extend.Chain(lambda r, L: r**2 / 2, lambda r, L: 1.0, locks=False)
    )
    long = {"cells.end_to_end_length": 3.0, "material.contour_length": 2.0}
    assert scene().with_values({**long, "material.chain": "spring"}).cells.end_to_end_length == 3.0
    with pytest.raises(SceneError, match="must be smaller than material.contour_length = 2"):
        scene().with_values(long)


def test_a_matrix_energy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Typed again it is the same, to the last bit; of twice the energy it is the same with half of the constants."""

    def again(F: Any, lame_lambda: Any, lame_mu: Any) -> Any:
        log_jacobian = ufl.ln(ufl.det(F))
        return (
            lame_lambda / 2 * log_jacobian**2
            + lame_mu / 2 * (ufl.inner(F, F) - 3)
            - lame_mu * log_jacobian
        )

    monkeypatch.setitem(extend.MATRICES, "again", again)
    monkeypatch.setitem(
        extend.MATRICES, "double", lambda F, *lame: 2 * extend.neo_hookean(F, *lame)
    )
    matrix = scene().with_values(WITHOUT_CHAINS)
    expected = column(rows_of(matrix), "mean_stretch")
    assert (
        column(rows_of(matrix.with_values({"material.matrix": "again"})), "mean_stretch")
        == expected
    )
    half = {
        f"material.{name}": getattr(matrix.material, name) / 2
        for name in ("lame_lambda", "lame_mu")
    }
    doubled = column(
        rows_of(matrix.with_values({**half, "material.matrix": "double"})), "mean_stretch"
    )
    np.testing.assert_allclose(doubled, expected, rtol=1e-12)
    assert expected[-1] > 1.5


def test_a_repulsion(monkeypatch: pytest.MonkeyPatch) -> None:
    """M = r^2 cancels the chains' stress at F = I as the logarithms do; the network is then softer."""
    monkeypatch.setitem(extend.REPULSIONS, "again", extend.Repulsion(extend.axes_sum))
    monkeypatch.setitem(
        extend.REPULSIONS,
        "squared",
        extend.Repulsion(lambda F, cells, r0: extend.squared_end_to_end_length(F, cells)),
    )
    expected = column(rows_of(scene(**{"remodeling": {"law": "none"}})), "mean_stretch")
    found = {
        name: column(
            rows_of(scene(material={"repulsion": name}, remodeling={"law": "none"})), "mean_stretch"
        )
        for name in ("again", "squared")
    }
    assert found["again"] == expected
    assert found["squared"][0] > expected[0] > 1.0
    unloaded = {"loads.force.value": 0.0, **ELASTIC}
    with simulated(scene(material={"repulsion": "squared"}).with_values(unloaded)) as (
        simulation,
        _,
    ):
        assert np.abs(simulation.unknown.x.array).max() < 1e-14


def test_a_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    """The Kirchhoff stress is J times Cauchy's: the same axes, the same ratios, the same cells."""
    monkeypatch.setitem(
        extend.DRIVERS, "kirchhoff", extend.Driver(lambda F, s: ufl.det(F) * s.cauchy, False)
    )
    monkeypatch.setitem(extend.DRIVERS, "pressed", extend.Driver(lambda F, s: -s.cauchy, False))
    final = {}
    for name in ("cauchy", "kirchhoff", "pressed"):
        with simulated(scene(remodeling={"driver": name})) as (simulation, _):
            final[name] = simulation.cells.structure_tensor()
    np.testing.assert_allclose(final["kirchhoff"], final["cauchy"], atol=1e-12)
    np.testing.assert_allclose(
        final["pressed"], np.broadcast_to(np.eye(3) / 3, final["pressed"].shape), atol=1e-12
    )
    assert final["cauchy"][0, 0, 2, 2] > 0.5


def rotated_back(F: np.ndarray, spatial_axes: np.ndarray) -> np.ndarray:
    """n_I = R^T m_I with F = R U: a frame of a user's."""
    left, _, right = np.linalg.svd(F)
    return spatial_axes @ (left @ right)


def test_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing turns it is the printed frame; another one puts the chains elsewhere."""
    monkeypatch.setitem(extend.FRAMES, "rotated", extend.Frame(rotated_back, carries_axes=False))
    monkeypatch.setitem(
        extend.FRAMES,
        "across",
        extend.Frame(lambda F, m: np.roll(m, 1, axis=1), carries_axes=False),
    )
    frames = ("spatial", "rotated", "across")
    expected, found, across = (
        rows_of(scene(remodeling={"frame": name}))[-1]["mean_fibre_angle"] for name in frames
    )
    assert found == pytest.approx(expected, abs=1e-12)
    assert expected < 50 and across > 60


def test_a_ranked_law(monkeypatch: pytest.MonkeyPatch) -> None:
    """Relaxation by Euler's explicit method: after n passes towards the load axis (1 - kappa)^n of l0 is left."""

    def euler(l: Any, l0: Any, target: Any, kappa: float, time_old: float, time_new: float) -> Any:
        return l + kappa * (time_new - time_old) * (target - l)

    monkeypatch.setitem(extend.LAWS, "euler", extend.ranked(euler, has_limit=True))
    rows = rows_of(scene(remodeling={"law": "euler"}))
    for passes, row in enumerate(rows):
        left = (1 - KAPPA) ** passes
        across, along = left / np.sqrt(3), 1 - left + left / np.sqrt(3)
        angle = np.degrees(np.arctan2(np.sqrt(2) * across, along))
        assert row["mean_fibre_angle"] == pytest.approx(angle, abs=1e-9)


def test_a_law_of_another_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Collagen that is lost where it is pulled: no target, no ranks, the axes stay."""

    def lost(
        cells: extend.UnitCell, drive: extend.Drive, time_old: float, time_new: float
    ) -> extend.UnitCell:
        pulled = np.linalg.eigvalsh(drive.tensor)[:, -1:] > drive.noise
        share = np.where(pulled, np.exp(-drive.kappa * (time_new - time_old)), 1.0)
        return extend.UnitCell(share * cells.dimensions, cells.axes)

    monkeypatch.setitem(extend.LAWS, "lost", extend.Law(lost))
    with simulated(whole(remodeling={"law": "lost"})) as (simulation, rows):
        left = np.exp(-KAPPA * 4.0) * simulation.cells.initial_dimensions
        np.testing.assert_allclose(simulation.cells.dimension_values, left, rtol=1e-13)
        np.testing.assert_array_equal(
            simulation.cells.axis_values[..., :, :], np.eye(3) + 0 * left[..., None]
        )
    stretch = column(rows, "mean_stretch")
    assert stretch[1] < stretch[2] < stretch[3]  # under the same load
    assert all(row["remodeling_power"] != 0 for row in rows)


def test_a_pairing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The largest tension belongs to the last dimension: the start of a cell is another one, eq. (11) is the same."""

    def ascending(*tensors: Any, **limits: Any) -> Any:
        values, axes = extend.principal(*tensors, **limits)
        return values[:, ::-1], axes[:, ::-1]

    monkeypatch.setitem(extend.PAIRINGS, "ascending", ascending)
    for pairing, along, across in (("sorted", 0.8, 0.6), ("ascending", 0.0, 1.0)):
        rows = rows_of(scene(cells={"initial": [0.8, 0.6, 0.0]}, remodeling={"pairing": pairing}))
        for passes, row in enumerate(rows[1:], start=1):
            left = np.exp(-KAPPA * passes)
            angle = np.degrees(np.arctan2(across * left, along * left + 1 - left))
            assert row["mean_fibre_angle"] == pytest.approx(angle, abs=1e-6), (pairing, passes)


def test_initial_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells along an axis that leans by 30 degrees from the load."""

    def leaning(points: extend.LocalAxes) -> np.ndarray:
        c, s = np.cos(np.pi / 6), 0.5
        return np.broadcast_to(
            [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]], (*points.coordinates.shape[:-1], 3, 3)
        )

    monkeypatch.setitem(extend.AXES, "leaning", leaning)
    with pytest.raises(
        SceneError, match="^cells.axes = 'leaning': must be 'global' for shape 'cube'$"
    ):
        whole(cells={"axes": "leaning", "initial": "aligned"})
    monkeypatch.setattr(Cube, "axis_kinds", (*Cube.axis_kinds, "leaning"))
    first, *_ = rows_of(whole(cells={"axes": "leaning", "initial": "aligned"}))
    assert first["mean_fibre_angle"] == pytest.approx(30.0)


# ---------------------------------------------------------------- bodies
def test_a_load(monkeypatch: pytest.MonkeyPatch) -> None:
    """Weight along z: on one trilinear element the nodal forces are those of half of it, pulling at the top."""

    def add_weight(shape: extend.Shape, loading: Any, name: str) -> None:
        weight = loading.magnitude(name)
        loading.add_term(lambda u, v: -weight * v[2] * loading.weight * ufl.dx)

    density = extend.Dimension(
        "force per volume", "9.81 kN/m^3", ((extend.STRESS_UNIT, 1), (extend.LENGTH_UNIT, -1))
    )
    monkeypatch.setitem(
        Cube.loads,
        "weight",
        extend.LoadKind(add_weight, "weight along z per reference volume", density),
    )
    ramp = ramp_to(2.0)
    heavy = whole(geometry={"length_unit": "m"}, loads={"force": {"value": 0.0, "ramp": ramp},
                                                        "weight": {"value": "0.02 kN/m^3", "ramp": ramp}})  # fmt: skip
    assert heavy.loads["weight"].value == pytest.approx(20.0)
    found, expected = rows_of(heavy), rows_of(whole())
    for row, other in zip(found, expected, strict=True):
        assert row["mean_stretch"] == pytest.approx(other["mean_stretch"], abs=1e-10)
        assert row["mean_fibre_angle"] == pytest.approx(other["mean_fibre_angle"], abs=1e-9)
    assert column(found, "weight") == [10.0, 20.0, 20.0, 20.0]
    with pytest.raises(SceneError, match="a tendon has no such load"):
        Scene(
            geometry={"shape": "tendon"},
            loads={"weight": {"value": 1.0, "ramp": ramp}},
            time={"end": 1.0},
        )


def test_a_column(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The body's volume, integrated on the mesh: the cube's lengths know it too."""

    def volume(m: extend.Measurement) -> float:
        def compiled() -> Any:
            F = m.state.kinematics.deformation_gradient(m.state.unknown)
            return extend.form(ufl.det(F) * m.quadrature.dx)

        return float(dolfinx.fem.assemble_scalar(m.cached("volume", compiled)))

    monkeypatch.setitem(
        extend.COLUMNS,
        "volume",
        extend.Column("volume", "length^3", "volume of the deformed body", volume),
    )
    section = extend.Column(
        "section",
        "length^2",
        "area across the load",
        lambda m: float(np.prod(m.position.max(axis=0)[:2])),
    )
    monkeypatch.setattr(Cube, "columns", (*Cube.columns, section))
    run(whole(), tmp_path / "run", MPI.COMM_SELF)
    history = Recording(tmp_path / "run").history
    np.testing.assert_allclose(
        history["volume"], history["section"] * history["mean_stretch"], rtol=1e-12
    )
    assert history["volume"][0] == pytest.approx(1.0) and history["volume"][-1] > 1.05


class Bar(extend.Shape):
    """A bar of rectangular cross-section along z."""

    loads: ClassVar[dict[str, extend.LoadKind]] = {
        "force": extend.LoadKind(
            lambda shape, loading, name: loading.add_dead_force(name, "z1", 2),
            "force on the top",
            extend.FORCE,
            area=lambda shape: shape.width * shape.depth,
        )
    }
    columns: ClassVar[tuple[extend.Column, ...]] = (
        *extend.uniaxial_columns("z1", "length"),
        extend.Column(
            "width",
            "length",
            "mean of the deformed side",
            lambda m: m.face_mean("x1", m.position[:, 0]),
        ),
    )
    number_of_elements: ClassVar[int] = 4
    face_names: ClassVar[tuple[str, ...]] = ("x0", "x1", "y0", "y1", "z0", "z1")

    shape: Literal["bar"] = Field(default="bar", description="Which body it is.")
    width: Annotated[float, extend.LENGTH] = Field(default=1.0, gt=0, description="Length along x.")
    depth: Annotated[float, extend.LENGTH] = Field(default=2.0, gt=0, description="Length along y.")
    length: Annotated[float, extend.LENGTH] = Field(
        default=4.0, gt=0, description="Length along z."
    )

    def build(self, mesh: Any, comm: Any = None) -> Domain:
        """Of plane faces, whatever degree the scene asks for."""
        sides = {"width": self.width, "depth": self.depth, "length": self.length}
        flat = mesh.model_copy(update={"degree": 1})
        return extend.box_domain("bar", sides, [*sides.values()], (1, 2, 2), flat, comm)

    def hold(self, loading: Any) -> None:
        """Three planes of symmetry."""
        for component, face in enumerate(("x0", "y0", "z0")):
            loading.hold_face(face, component)

    def fibre_angle(self, dimensions: Any, axes: Any, local: Any) -> Any:
        """To x, across the load."""
        return extend.angle_to_axis(dimensions, axes, np.array([1.0, 0.0, 0.0]))


def test_a_shape(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A bar of isotropic cells is as uniform as the cube: the same stretch under the same stress."""
    monkeypatch.setitem(extend.SHAPES, "bar", Bar)
    cube = scene()
    values = cube.model_dump(exclude={"geometry", "preset", "format", "model"}, exclude_none=True)
    values["loads"]["force"]["value"] *= 1.5 * 2.0
    size = {"width": 1.5, "depth": 2.0, "length": 4.0}
    bar = Scene(**values, geometry={"shape": "bar", **size}, model={"kinematics": "full"})
    folder = run(bar, tmp_path / "run", MPI.COMM_SELF)
    recording, expected = Recording(folder), rows_of(cube)
    assert recording.scene == bar and isinstance(recording.scene.geometry, Bar)
    history = {name: values[1:] for name, values in recording.history.items()}
    np.testing.assert_allclose(history["mean_stretch"], column(expected, "mean_stretch"), rtol=1e-9)
    np.testing.assert_allclose(
        history["force"], 3 * np.array(column(expected, "force")), rtol=1e-14
    )
    along = np.cos(np.radians(column(expected, "mean_fibre_angle"))) ** 2
    across = np.degrees(np.arccos(np.sqrt((1 - along) / 2)))
    np.testing.assert_allclose(history["mean_fibre_angle"], across, rtol=1e-9)
    deformed = recording.points + recording.fields(4.0)["displacement"]
    assert deformed[:, 0].max() == pytest.approx(history["width"][-1], rel=1e-6)
    assert len(recording.elements) == 4 and history["width"][-1] < 1.4


def test_a_shape_that_does_not_mesh_what_the_scene_asks_for_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(extend.SHAPES, "bar", Bar)
    curved = Scene(geometry={"shape": "bar"}, mesh={"degree": 2}, time={"end": 1.0})
    with pytest.raises(SceneError, match="^mesh.degree = 2: the mesh has degree 1$"):
        Simulation(curved, MPI.COMM_SELF)
    with pytest.raises(
        SceneError,
        match="^geometry.shape = 'rod': must be one of 'cube', 'tendon', 'tube', 'sheet', 'mesh', 'solid', 'bar'$",
    ):
        Scene(geometry={"shape": "rod"}, time={"end": 1.0})


# ---------------------------------------------------------------- the way through time
def test_a_coupling(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that lets the cells alone until t = 2."""

    class Late(extend.Staggered):
        def remodel(self, time: float) -> float:
            return super().remodel(time) if time > 2.0 else 0.0

    with pytest.raises(
        SceneError,
        match="^remodeling.coupling = 'late': must be one of 'staggered', 'relaxed', 'extrapolated'$",
    ):
        scene(remodeling={"coupling": "late"})
    late = extend.CouplingKind("as staggered, but the cells stay as they are up to t = 2", Late)
    monkeypatch.setitem(extend.COUPLINGS, "late", late)
    angles = column(rows_of(scene(remodeling={"coupling": "late"})), "mean_fibre_angle")
    isotropic = np.degrees(np.arccos(3**-0.5))
    np.testing.assert_allclose(angles[:3], isotropic, rtol=1e-12)
    assert angles[3] < isotropic - 5


def test_a_watcher(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """One of every run, which warns once, and one of this run."""

    class Long(extend.WarnsOnce):
        name = "long"

        def check(self, step: Any) -> str:
            return "the cube is long" if step.row["mean_stretch"] > 1.2 else ""

    class Times(parts.Watcher):
        def __init__(self) -> None:
            self.seen: list[float] = []

        def committed(self, step: Any) -> None:
            self.seen.append(step.time)

    monkeypatch.setitem(extend.WATCHERS, "long", extend.WatcherKind(Long.for_scene))
    times = Times()
    folder = run(scene(), tmp_path / "run", MPI.COMM_SELF, watchers=[times])
    rows = Recording(folder).history
    assert times.seen == rows["time"][1:].tolist()
    first = rows["time"][np.argmax(rows["mean_stretch"] > 1.2)]
    assert (folder / "run.log").read_text().count(f"time {first:g}: the cube is long") == 1


def test_a_kinematics(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the displacement as the unknown: nobody who asks the kinematics notices."""

    class Halved(extend.FullKinematics):
        def displacement(self, unknown: Any) -> Any:
            return 2 * unknown

        def deformation_gradient(self, unknown: Any) -> Any:
            return ufl.Identity(3) + 2 * ufl.grad(unknown)

        def nodal_displacement(self, unknown: Any) -> Any:
            return 2 * super().nodal_displacement(unknown)

    monkeypatch.setitem(extend.KINEMATICS, "halved", Halved())
    matrix = scene().with_values(WITHOUT_CHAINS)
    expected, found = rows_of(matrix), []
    with simulated(matrix.with_values({"model.kinematics": "halved"})) as (simulation, found):
        top = simulation.unknown.x.array.max()
    for name in ("mean_stretch", "min_stretch", "min_jacobian", "stored_energy"):
        np.testing.assert_allclose(
            column(found, name), column(expected, name), rtol=1e-9, err_msg=name
        )
    assert 2 * top == pytest.approx(found[-1]["mean_stretch"] - 1)


def test_a_formulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The two parts apart, but by the same rule: rows as with the whole energy."""
    monkeypatch.setitem(
        extend.FORMULATIONS,
        "apart",
        extend.Selective("both parts at all points", {("hexahedron", 1): 2}),
    )
    with pytest.raises(
        SceneError,
        match="^mesh.formulation = 'apart': must be .* for elements 'hexahedron' of degree 2",
    ):
        whole(mesh={"formulation": "apart", "degree": 2})
    matrix = scene().with_values(WITHOUT_CHAINS)  # as one point: its kernels compile fastest
    expected = rows_of(matrix)
    apart = {"model.kinematics": "full", "mesh.formulation": "apart"}
    with simulated(matrix.with_values(apart)) as (simulation, found):
        assert simulation.state.dilatation.jacobians().shape == (1, 8)
    for name in ("mean_stretch", "min_stretch", "min_jacobian", "stored_energy"):
        np.testing.assert_allclose(
            column(found, name), column(expected, name), rtol=1e-8, err_msg=name
        )


def test_a_solver_method(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its options reach PETSc, and its class solves the systems."""
    made = []

    class Watched(extend.FullNewton):
        def renew(self) -> None:
            super().renew()
            made.append(self)

    options = {
        "snes_type": "newtonls",
        "snes_linesearch_type": "basic",
        "ksp_type": "gmres",
        "pc_type": "jacobi",
    }
    method = extend.SolverMethod({**options, "ksp_rtol": 1e-12}, "for this test", Watched)
    monkeypatch.setitem(extend.SOLVER_METHODS, "krylov", method)
    expected, found = (
        rows_of(whole().with_values({"solver.method": name})) for name in ("direct", "krylov")
    )
    np.testing.assert_allclose(
        column(found, "mean_stretch"), column(expected, "mean_stretch"), rtol=1e-9
    )
    assert column(expected, "linear_iterations") == column(expected, "newton_iterations")
    assert sum(column(found, "linear_iterations")) > 2 * sum(column(found, "newton_iterations"))
    assert len(made) == sum(column(found, "newton_iterations"))


# ---------------------------------------------------------------- scenes
class HealingRemodeling(Remodeling):
    """A table with one more key."""

    rest: float = Field(default=0.0, ge=0, description="Time before the cells begin to remodel.")


class HealingScene(Scene):
    """A scene with that table."""

    remodeling: HealingRemodeling = HealingRemodeling()


def test_a_scene_key() -> None:
    """A field of a table: read, checked, written back and documented like all others."""
    values = {**SCENE, "remodeling": {"rest": 2.5}}
    made = HealingScene(**values)
    assert (
        made.remodeling.rest == 2.5 and made.remodeling.frame == "spatial"
    )  # the preset's lies below
    assert "rest = 2.5" in made.to_toml()
    assert made.with_values({"remodeling.rest": 3.0}).remodeling.rest == 3.0
    with pytest.raises(
        SceneError, match="^remodeling.rest = -1.0: must be a finite number at least 0$"
    ):
        HealingScene(**{**SCENE, "remodeling": {"rest": -1.0}})
    with pytest.raises(SceneError, match="^remodeling.rest = 2.5: unknown key"):
        Scene(**values)
    key = HealingScene.model_json_schema()["$defs"]["HealingRemodeling"]["properties"]["rest"]
    assert (key["default"], key["minimum"], key["description"]) == (
        0.0,
        0,
        "Time before the cells begin to remodel.",
    )
