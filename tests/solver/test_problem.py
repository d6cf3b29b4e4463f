"""The tangent of a pressure, loads, the guards r < L and J > 0, and the rates of convergence of the elements."""

from __future__ import annotations

import dolfinx.fem
import numpy as np
import pytest
import ufl

from remodel_fenicsx import preset_scene
from remodel_fenicsx.fem import jit, quadrature
from remodel_fenicsx.model.tensors import determinant_changes_sign
from remodel_fenicsx.schema.settings import Cells, Material
from remodel_fenicsx.solver.equilibrium import StateLimits, PointState
from remodel_fenicsx.solver import newton
from remodel_fenicsx.solver.newton import SolveFailure
from tests import parts
from tests.conftest import slowly
from tests.parts import clamped_cube, cube, smooth, tube
from tests.reference.radial import secant_stiffness
from tests.runs import made


# ---------------------------------------------------------------- residual and tangent
@pytest.mark.parametrize("element", ["hexahedron", "tetrahedron"])
def test_pressure_tangent_is_symmetric_on_the_artery_and_not_with_free_ends(element: str) -> None:
    """The ends slide in planes: the edge terms vanish and the pressure has a potential."""
    made = parts.body(
        tube(length=2.0, element=element, divisions=(8, 2, 3)),
        Cells(initial="isotropic", axes="cylindrical"),
    )
    made.loading.hold_face("bottom", 2)
    made.loading.hold_face("top", 2)
    made.loading.add_follower_pressure("pressure", "inner")
    u = smooth(made.nodes, 0.1, 1)
    u[:, 2] *= made.nodes[:, 2] * (2.0 - made.nodes[:, 2])
    made.set_displacement(u)
    made.loading.set({"pressure": 1.0})
    test, trial = (
        make(made.displacement.function_space) for make in (ufl.TestFunction, ufl.TrialFunction)
    )
    virtual_work = made.loading.external_residual(test)
    form = jit.form(ufl.derivative(virtual_work, made.displacement, trial))
    tangent = dolfinx.fem.assemble_matrix(form).to_scipy().toarray()
    held = np.concatenate(
        [condition.dof_indices()[0] for condition in made.loading.boundary_conditions]
    )
    free = np.setdiff1d(np.arange(tangent.shape[0]), held)
    on_free = tangent[np.ix_(free, free)]
    assert np.linalg.norm(on_free - on_free.T) < 1e-14 * np.linalg.norm(on_free)
    assert np.linalg.norm(tangent - tangent.T) > 0.1 * np.linalg.norm(tangent)


def test_loads_are_what_their_names_say() -> None:
    """On a cube of side 2: the whole force, the pressure times the area, the elongation times the length."""
    made = parts.body(cube(2.0, refinement=2), Cells(initial="random", seed=3))
    made.loading.add_dead_force("force", "z1", component=2)
    made.loading.add_follower_pressure("pressure", "x1")
    made.loading.add_prescribed_elongation("elongation", "z1", 2, 2.0)
    problem = made.problem()
    for loads, total in (
        ({"force": 3.0, "pressure": 0.0}, [0, 0, 3]),
        ({"force": 0.0, "pressure": 5.0}, [-20, 0, 0]),
    ):
        made.loading.set(loads)
        external = -dolfinx.fem.assemble_vector(problem.external_forms[0]).array.reshape(-1, 3)
        np.testing.assert_allclose(external.sum(axis=0), total, atol=1e-13)
        assert made.loading.values == {**loads, "elongation": 0.0}
    made.loading.set({"elongation": 0.1})
    assert problem.prescribed_gap() == pytest.approx(0.2, rel=1e-14)


def test_a_prescribed_elongation_is_reached_as_fast_as_newton_can() -> None:
    """Lifting spreads it over the body at once: without it, or with its sign wrong, the first layer takes it all."""
    made = parts.body(cube(refinement=4), Cells(initial="isotropic"))
    for component, face in enumerate(("x0", "y0", "z0")):
        made.loading.hold_face(face, component)
    made.loading.add_prescribed_elongation("elongation", "z1", 2, 1.0)
    problem = made.problem(parts.TIGHT.model_copy(update={"method": "direct"}))
    for elongation in (0.1, 0.2):
        made.loading.set({"elongation": elongation})
        solution = problem.solve()
    u = made.displacement.x.array.reshape(-1, 3)
    np.testing.assert_allclose(u[:, 2], 0.2 * made.nodes[:, 2], atol=1e-10)
    assert (
        solution.newton_iterations <= 5
    )  # the last one at the rounding of the forces; six without lifting


# ---------------------------------------------------------------- guards
LINE_SEARCHES = ["basic", "bt", "cp", "l2"]
OVERSIZED = 16.5


@pytest.fixture(scope="module")
def small_steps() -> np.ndarray:
    """The displacement under the force of the guard tests, in thirty steps."""
    made = clamped_cube()
    problem = made.problem()
    for force in np.linspace(0.0, OVERSIZED, 31)[1:]:
        made.loading.set({"force": force})
        problem.solve()
    assert problem.limits().max_chain_extension == pytest.approx(0.938, abs=2e-3)
    return made.displacement.x.array.copy()


@pytest.mark.parametrize("line_search", LINE_SEARCHES)
def test_one_oversized_step_ends_on_the_branch_or_where_it_began(
    line_search: str, small_steps: np.ndarray
) -> None:
    """Unguarded, the chains converge beyond their contour length: their force is finite and positive there too."""
    made = clamped_cube()
    settings = parts.TIGHT.model_copy(
        update={"petsc_options": {"snes_linesearch_type": line_search}}
    )
    problem = made.problem(settings)
    made.loading.set({"force": OVERSIZED})
    try:
        problem.solve()
    except SolveFailure:
        assert line_search != "basic"  # the default profile arrives
        assert not made.displacement.x.array.any()
    else:
        assert problem.limits().admissible
        np.testing.assert_allclose(made.displacement.x.array, small_steps, atol=1e-9)


def stretched_bar(stretch: float) -> parts.Body:
    """A cube free to contract, its chains along the load, stretched this far along z."""
    made = parts.body(cube(refinement=2), Cells(initial="aligned"))
    made.supported()
    made.set_displacement(made.nodes * (stretch ** np.array([-0.4, -0.4, 1.0]) - 1))
    made.loading.set({"force": OVERSIZED})
    return made


def test_wrong_branch_is_there_and_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond r = L the chain force is finite and positive again: Newton without guards converges there, quickly."""
    made = stretched_bar(4.0)
    start = made.displacement.x.array.copy()
    problem = made.problem(
        parts.TIGHT.model_copy(update={"petsc_options": {"snes_linesearch_type": "bt"}})
    )
    real, harmless = problem.evaluate, PointState(
        StateLimits(0.5, 0.5, (0.0, 0.0, 0.0)), *np.zeros((3, 0))
    )
    problem.newton._snes.setLineSearchPreCheck(lambda x, step: False)
    guard = lambda: real() if problem.newton._snes.getConvergedReason() else harmless  # noqa: E731
    monkeypatch.setattr(problem, "evaluate", guard)
    with pytest.raises(SolveFailure, match=r"not admissible: r/L = 2\.72") as caught:
        problem.solve()
    assert (
        problem.newton._snes.getConvergedReason() > 0
        and problem.newton._snes.getFunctionNorm() < 1e-9
    )
    assert caught.value.newton_iterations < 10
    assert caught.value.limits.max_chain_extension == pytest.approx(2.7212, abs=1e-3)
    np.testing.assert_array_equal(made.displacement.x.array, start)


def test_a_straight_way_through_a_collapsed_volume_is_seen() -> None:
    """Against the determinant at many places of the way, for ends that are both in order."""
    rng = np.random.default_rng(4)
    before, after = (np.eye(3) + 0.7 * rng.standard_normal((5_000, 3, 3)) for _ in range(2))
    good = (np.linalg.det(before) > 0) & (np.linalg.det(after) > 0)
    before, after = before[good], after[good]
    lowest = np.min(
        [np.linalg.det(before + s * (after - before)) for s in np.linspace(0, 1, 401)], axis=0
    )
    found = determinant_changes_sign(before, after)
    assert np.all(found[lowest <= 0]) and np.all(lowest[found] < 1e-3)
    assert 0.02 < found.mean() < 0.2
    half_a_turn = np.diag([-1.0, -1.0, 1.0])[None]
    assert determinant_changes_sign(np.eye(3)[None], half_a_turn) and not determinant_changes_sign(
        half_a_turn, half_a_turn
    )
    assert not determinant_changes_sign(
        np.eye(3)[None], np.full((1, 3, 3), np.nan)
    )  # others refuse that


def test_no_point_that_turns_is_left_out() -> None:
    """Few points are asked whether the way between two states turns them, and no other one turns."""
    problem = parts.body(cube(refinement=1), Cells(initial="isotropic")).problem()
    rng = np.random.default_rng(17)
    F = np.eye(3) + 0.5 * rng.normal(size=(200, 3, 3))
    F = F[np.linalg.det(F) > 0]
    for size in (1e-3, 0.1, 0.3, 1.0):
        G = F + size * rng.normal(size=F.shape)
        expected = determinant_changes_sign(F, G)
        for at in range(len(F)):
            ends = [
                PointState(
                    problem.limits(), np.zeros(1), np.linalg.det(X[at : at + 1]), X[at : at + 1]
                )
                for X in (F, G)
            ]
            assert problem.inverts_between(*ends) == expected[at]
    assert expected.any() and not expected.all()


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_state_that_is_not_finite_is_at_its_limits(number: float) -> None:
    """At its worst point r/L is infinite, J is no volume, and the other points stay as they are."""
    made = parts.body(cube(refinement=2), Cells(initial="isotropic"))
    problem = made.problem()
    elsewhere = problem.evaluate().stretches
    made.displacement.x.array[0] = number
    look = problem.evaluate()
    bad = np.isinf(look.stretches)
    assert bad.any() and not look.limits.admissible
    assert look.limits.max_chain_extension == np.inf and look.limits.min_jacobian == -np.inf
    np.testing.assert_array_equal(look.stretches[~bad], elsewhere[~bad])


def test_a_newton_step_is_shortened_where_elements_turn_inside_out_or_chains_lock() -> None:
    """Half a turn as a step: J = 1 at its end, zero on the way; three times the length; and a tenth, which may be."""
    made = parts.body(cube(refinement=1), Cells(initial="isotropic"))
    made.supported()
    newton = made.problem().newton
    x, step = newton.unknown.x.petsc_vec.duplicate(), newton.unknown.x.petsc_vec.duplicate()
    for stretches, shorter in (([-1.0, -1.0, 1.0], 4), ([1.0, 1.0, 3.0], 2), ([1.0, 1.0, 0.1], 1)):
        step.array[:] = -(made.nodes @ (np.diag(stretches) - np.eye(3)).T).ravel()
        asked = step.array.copy()
        assert newton._keep_admissible(x, step) == (shorter > 1)
        np.testing.assert_allclose(step.array, asked / shorter)


@pytest.mark.parametrize(
    ("stretch", "said"),
    [(2.5, "not admissible: r/L = "), (8.0, "not admissible: r/L = "), (-0.5, "J = -0.125")],
)
def test_a_start_beyond_the_contour_length_or_inside_out_fails_and_stays(
    stretch: float, said: str
) -> None:
    made = stretched_bar(max(stretch, 1.0))
    if stretch < 0:
        made.set_displacement((stretch - 1) * made.nodes)
    start = made.displacement.x.array.copy()
    with pytest.raises(SolveFailure, match=said):
        made.problem().solve()
    np.testing.assert_array_equal(made.displacement.x.array, start)


@pytest.mark.parametrize("method", ["direct", "lagged"])
def test_a_solve_that_diverges_ends_early(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A thin tube, as a large body: its residual goes far above the first one. A small body may go on from there."""
    monkeypatch.setattr(newton, "LARGE", 0)
    shown: list[str] = []
    scene = preset_scene("kuhl-holzapfel-2007", "tube").with_values(
        {"solver.method": method, "geometry.outer_radius": 1.02, "cells.initial": "isotropic"}
    )
    with made(scene) as simulation:
        simulation.state.loading.set({"pressure": 1.0, "elongation": 0.0})
        simulation.state.tell = shown.append
        with pytest.raises(SolveFailure, match="the residual diverges") as caught:
            simulation.stepper.coupling.newton.solve()
        assert 4 < caught.value.newton_iterations < 25
        assert len(shown) > caught.value.newton_iterations
        assert not simulation.unknown.x.array.any()


@pytest.mark.parametrize("where", ["displacement", "dimensions", "axes"])
def test_nan_anywhere_is_a_failure_not_a_result(where: str) -> None:
    """Comparisons with NaN are false: a guard written the other way round would let it through."""
    made = clamped_cube()
    problem = made.problem()
    made.loading.set({"force": 1.0})
    function = {
        "displacement": made.displacement,
        "dimensions": made.cells.dimensions,
        "axes": made.cells.axes,
    }[where]
    function.x.array[7] = np.nan
    before = made.displacement.x.array.copy()
    extension = problem.limits()
    assert not extension.admissible and extension.max_chain_extension == np.inf
    with pytest.raises(SolveFailure):
        problem.solve()
    np.testing.assert_array_equal(made.displacement.x.array, before)


def test_a_solve_that_is_cut_off_leaves_the_displacement_where_it_was() -> None:
    made = clamped_cube()
    start = 1e-3 * smooth(made.nodes, 1.0, 1).ravel()
    made.set_displacement(start)
    made.loading.set({"force": 3.0})
    with pytest.raises(SolveFailure, match="no equilibrium within 1 Newton iterations"):
        made.problem(parts.TIGHT.model_copy(update={"maximum_iterations": 1})).solve()
    np.testing.assert_array_equal(made.displacement.x.array, start)


def test_a_failed_solve_leaves_a_solver_that_works() -> None:
    made = clamped_cube()
    problem = made.problem()
    made.loading.set({"force": 1.0})
    made.displacement.x.array[7] = np.nan
    with pytest.raises(SolveFailure):
        problem.solve()
    made.displacement.x.array[:] = 0.0
    problem.solve()
    again = clamped_cube()
    again.loading.set({"force": 1.0})
    again.problem().solve()
    np.testing.assert_allclose(made.displacement.x.array, again.displacement.x.array, atol=1e-12)


# ---------------------------------------------------------------- convergence of the elements
FINE = 6  # degree of the rule for the body force and the error norms
TURNED = parts.rotation((1.0, 2.0, -0.5), 40.0)
DIMENSIONS = np.array([0.8, 0.5, np.sqrt(1 - 0.8**2 - 0.5**2)])
COMPRESSIBLE = Material(
    lame_lambda=3.0
)  # nearly incompressible, linear tetrahedra are slow to show their rate
MATERIALS = {
    "chains": COMPRESSIBLE,
    "matrix": COMPRESSIBLE.model_copy(update={"chain_density": 0.0}),
}
AMPLITUDES = np.array([0.08, -0.06, 0.1])
SLOPES = np.array([[0.5, 0.2, -0.3], [-0.4, 0.1, 0.6], [0.2, -0.5, 0.3]])


def manufactured(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """u (n, 3) and grad u (n, 3, 3) at x (n, 3), real or complex; zero on the whole boundary of the unit cube."""
    sine, cosine = np.sin(np.pi * x), np.pi * np.cos(np.pi * x)
    bubble = np.prod(sine, axis=1)
    slope = np.stack(
        [cosine[:, j] * np.prod(np.delete(sine, j, axis=1), axis=1) for j in range(3)], axis=1
    )
    factor = AMPLITUDES * (1 + x @ SLOPES.T)
    gradient = factor[:, :, None] * slope[:, None, :] + bubble[:, None, None] * (
        AMPLITUDES[:, None] * SLOPES
    )
    return factor * bubble[:, None], gradient


def first_piola_kirchhoff(F: np.ndarray, chain_density: float) -> np.ndarray:
    """P = J sigma F^-T of eq. (7) with erratum 5, typed by hand, F (n, 3, 3) real or complex."""
    lame, mu = COMPRESSIBLE.lame_lambda, 3.103
    c = 1.381e-23 * 310.0 * chain_density / (4 * 1.365)
    fibres = np.einsum("nij,Ij->nIi", F, TURNED)  # F n_I
    squared = np.sum(fibres**2, axis=2)
    r = np.sqrt(squared @ DIMENSIONS**2)[:, None]
    g, g0 = (secant_stiffness(length, 1.594) for length in (r, 1.0))
    weights = c * DIMENSIONS**2 * (g - g0 / squared)
    inverse_transposed = np.swapaxes(np.linalg.inv(F), 1, 2)
    matrix = mu * F + (lame * np.log(np.linalg.det(F)) - mu)[:, None, None] * inverse_transposed
    return matrix + np.einsum("nI,nIi,Ij->nij", weights, fibres, TURNED)


def body_force(x: np.ndarray, chain_density: float) -> np.ndarray:
    """b = -Div P(I + grad u) at x (n, 3), each derivative by a complex step."""
    force = np.zeros_like(x)
    for j, shift in enumerate(1e-30 * np.eye(3)):
        force -= (
            first_piola_kirchhoff(np.eye(3) + manufactured(x + 1j * shift)[1], chain_density)[
                :, :, j
            ].imag
            / 1e-30
        )
    return force


def errors(refinement: int, element: str, degree: int, material: Material) -> tuple[float, float]:
    """L2 and H1 (semi-norm) errors of the solution on a uniform mesh."""
    made = parts.body(
        cube(refinement=refinement, element=element, degree=degree),
        Cells(initial="isotropic"),
        degree,
    )
    made.cells.set(
        np.broadcast_to(DIMENSIONS, made.cells.dimension_values.shape),
        np.broadcast_to(TURNED, made.cells.axis_values.shape),
    )
    for face in made.domain.faces:
        for component in range(3):
            made.loading.hold_face(face, component)
    rule = quadrature.Quadrature(made.domain.mesh, FINE)
    at = rule.coordinates.reshape(-1, 3)
    force = rule.function("body_force", (3,))
    rule.values(force, (3,))[:] = body_force(at, material.chain_density).reshape(*rule.shape, 3)
    made.loading.add_term(lambda u, v: -ufl.inner(force, v) * rule.dx)
    made.problem(material=material).solve()
    u = made.displacement
    state = jit.expression(
        ufl.as_vector([*u, *(ufl.grad(u)[i, j] for i in range(3) for j in range(3))]), rule.points
    )
    values = rule.evaluate(state, (12,))
    exact, gradient = manufactured(at)
    wrong = values - np.concatenate([exact, gradient.reshape(-1, 9)], axis=1).reshape(values.shape)
    parts_of_norm = (np.sum(wrong[..., :3] ** 2, axis=-1), np.sum(wrong[..., 3:] ** 2, axis=-1))
    first, second = (float(np.sqrt(rule.integral(part))) for part in parts_of_norm)
    return first, second


# the rate is the element's, whatever the material: the matrix alone is compiled in a fifth of the time
ELEMENTS = [("hexahedron", 1, (4, 8), "chains"), ("hexahedron", 2, (3, 6), "matrix")]
OTHERS = [("hexahedron", 2, (3, 6), "chains"), ("tetrahedron", 1, (8, 16), "chains"),
          ("tetrahedron", 2, (4, 8), "chains")]  # fmt: skip


@pytest.mark.parametrize(("element", "degree", "meshes", "material"), [*ELEMENTS, *slowly(*OTHERS)])
def test_manufactured_solution_is_approached_at_the_elements_rates(
    element: str,
    degree: int,
    meshes: tuple[int, int],
    material: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An oblique orthotropic cell and a body force from eq. (7) typed by hand: shares no line with the forms."""
    monkeypatch.setitem(quadrature.DEGREES, (element, FINE), FINE)
    coarse, fine = (errors(n, element, degree, MATERIALS[material]) for n in meshes)
    rates = np.log2(np.array(coarse) / fine)
    # linear tetrahedra are the slowest to arrive: 1.53, 1.77, 1.85 for 3, 6, 8 to 6, 12, 16 elements along an edge
    np.testing.assert_allclose(
        rates, [degree + 1, degree], atol=0.2 if (element, degree) == ("tetrahedron", 1) else 0.1
    )
    size = np.sqrt(
        np.mean(
            np.sum(manufactured(np.random.default_rng(1).uniform(size=(1000, 3)))[0] ** 2, axis=1)
        )
    )
    assert fine[0] < 0.04 * size
