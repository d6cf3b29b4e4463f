"""Cells that belong to their stress at points, without a mesh: the local equation, stress and consistent tangent."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from remodel_fenicsx.model import spectral, tensors
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.energy import REPULSIONS, Tissue
from remodel_fenicsx.model import local_problem
from remodel_fenicsx.model.laws import LAWS, Drive, TURNOVER_RATES, TurnoverRule, turned_over_at_the_end

Array = NDArray[np.float64]

COMBINATIONS = [
    (law, repulsion, driver, frame)
    for (law, repulsion), driver, frame in product(
        [("tensor", "log"), ("tensor", "length"), ("explicit", "axes"), ("relaxation", "axes"), ("rate", "log")],
        [name for name, part in DRIVERS.items() if part.derivatives],
        [name for name, part in FRAMES.items() if part.has_derivatives],
    )
    if frame == "material" or not DRIVERS[driver].material
]


def deformations(number: int, rng: np.random.Generator) -> Array:
    """Stretches apart, with a rotation: under tension."""
    R = Rotation.random(2 * number, random_state=rng).as_matrix()
    stretches = np.array([1.35, 1.12, 0.8]) + rng.uniform(-0.06, 0.06, (number, 3))
    return R[:number] @ (stretches[:, :, None] * R[number:])


def points(
    law: str, repulsion: str, driver: str, frame: str, number: int, initial: str = "isotropic", **changes: Any
) -> local_problem.LocalProblem:
    rng = np.random.default_rng(5)
    tissue = Tissue(27.3, 3.1, 1.57, 1.594, 1.0, repulsion=REPULSIONS[repulsion])
    lengths = np.full((number, 3), 1 / np.sqrt(3))
    if initial == "random":
        lengths = np.abs(rng.standard_normal((number, 3)))
        lengths /= np.linalg.norm(lengths, axis=1, keepdims=True)
    cells = UnitCell(lengths, Rotation.random(number, random_state=rng).as_matrix())
    nothing = np.zeros((number, 3, 3))
    drive = Drive(nothing, nothing, DRIVERS[driver], FRAMES[frame], 1e-13, lengths.copy(), np.ones(number), 0.025)
    step = local_problem.StepOfCells(LAWS[law], drive._replace(rounding=1e-13), cells, 8.0, 12.0)
    step = step._replace(drive=step.drive._replace(**changes))
    return local_problem.LocalProblem(tissue.map(lambda name, value: np.full(number, value)), step)


def with_pairing(some: local_problem.LocalProblem, pairing: spectral.Pairing) -> local_problem.LocalProblem:
    return replace(some, step=some.step._replace(drive=some.step.drive._replace(pairing=pairing)))


def solved(some: local_problem.LocalProblem, F: Array, start: Array | None = None) -> local_problem.LocalSolution:
    """From the axes of C, on which isotropic cells lie."""
    return some.solve(F, np.swapaxes(F, 1, 2) @ F if start is None else start)


def tangent_errors(
    some: local_problem.LocalProblem,
    F: Array,
    found: local_problem.LocalSolution,
    rng: np.random.Generator,
    directions: int = 3,
) -> Array:
    """Of both slopes against difference quotients, relative, the larger by random direction and point."""
    slopes, errors = some.tangent(found), []
    for _ in range(directions):
        H = rng.standard_normal(F.shape)
        of_tensor = tensors.from_mandel((slopes.by_gradient @ H.reshape(-1, 9, 1))[:, :, 0])
        up, down = (solved(some, F + h * H, found.driving_tensor) for h in (1e-6, -1e-6))
        of_both = []
        for name, slope in {
            "first_piola_kirchhoff": np.einsum("niJkL,nkL->niJ", slopes.tangent, H),
            "driving_tensor": of_tensor,
        }.items():
            expected = (getattr(up, name) - getattr(down, name)) / 2e-6
            of_both.append(np.linalg.norm(slope - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2)))
        errors.append(np.maximum(*of_both))
    return np.array(errors)


@pytest.mark.parametrize("law, repulsion, driver, frame", COMBINATIONS)
def test_the_tangent_is_the_derivative(law: str, repulsion: str, driver: str, frame: str) -> None:
    rng = np.random.default_rng(1)
    some, F = points(law, repulsion, driver, frame, 40), deformations(40, rng)
    found = solved(some, F)
    assert found.converged.all()
    errors = tangent_errors(some, F, found, rng)
    assert np.median(errors) < 1e-7 and np.max(errors) < 1e-5


@pytest.mark.parametrize("driver, frame", [("cauchy", "material"), ("cauchy", "spatial"), ("pk2", "material")])
def test_cells_that_turn_by_less_than_the_noise_still_belong_to_their_stress(driver: str, frame: str) -> None:
    """Axes that stay up to what may be an error of D would be a jump, of cells that have no other."""
    rng = np.random.default_rng(3)
    some, F = points("explicit", "axes", driver, frame, 200, kappa=0.1), deformations(200, rng)
    before = solved(some, F)
    noise = 1e-8 * float(np.median(np.linalg.norm(before.driving_tensor, axis=(1, 2))))
    step = some.step._replace(cells=some.unit_cells(before), drive=some.step.drive._replace(noise=noise))
    some = replace(some, step=step)
    moved = F + noise * rng.uniform(0.0, 2.0, (200, 1, 1)) * rng.standard_normal((200, 3, 3))
    assert before.converged.all()
    assert solved(some, moved, before.driving_tensor).converged.all()


def test_points_without_tension_answer_nothing() -> None:
    """Their axes stay, and are none of the driver's: nothing is divided by what one has along the other."""
    some = points("relaxation", "axes", "cauchy", "material", 1)
    cells = UnitCell(some.step.cells.dimensions, np.eye(3)[None, [1, 2, 0]])
    some = replace(some, step=some.step._replace(cells=cells))
    strain = local_problem.Strain.of(np.diag([1.2, 1.1, 1.0])[None])
    with np.errstate(all="raise"):
        found = local_problem.ranked_response(
            some.step, strain, strain.inside(np.diag([-3.0, -2.0, -1.0])[None]), derivatives=True
        )
    assert not np.any(found.by_tensor) and not np.any(found.by_stretch)


def test_tension_hardly_above_noise_answers_by_the_switch_too() -> None:
    """There the size of the stress decides how much remodels, not its directions alone."""
    rng = np.random.default_rng(9)
    quiet, F = points("tensor", "log", "cauchy", "material", 20), deformations(20, rng)
    size = float(np.median(np.linalg.norm(solved(quiet, F).driving_tensor, axis=(1, 2))))
    some = points("tensor", "log", "cauchy", "material", 20, noise=size)
    found = solved(some, F)
    assert found.converged.all()
    assert tangent_errors(some, F, found, rng).max() < 1e-6


@pytest.mark.parametrize("frame, pairing", [("material", "sorted"), ("spatial", "sorted"), ("material", "continuous")])
def test_cells_by_rank_answer_to_the_driving_tensor_and_to_the_stretch(frame: str, pairing: str) -> None:
    """Each alone, with axes that the two do not share: at a solution they mostly do."""
    rng, h = np.random.default_rng(7), 1e-6
    some = points("relaxation", "axes", "cauchy", frame, 30, "random")
    step = with_pairing(some, spectral.PAIRINGS[pairing]).step
    R = Rotation.random(30, random_state=rng).as_matrix()
    X = np.swapaxes(R, 1, 2) @ ((rng.uniform(0.8, 1.2, (30, 3)) * [6.0, 3.0, 1.0])[:, :, None] * R)
    U, changes = np.tile(np.diag([0.8, 1.1, 1.3]), (30, 1, 1)), rng.standard_normal((30, 3, 3))
    H, strain = changes + np.swapaxes(changes, 1, 2), local_problem.Strain.of(U)
    found = local_problem.ranked_response(step, strain, strain.inside(X), derivatives=True)
    assert found.by_tensor is not None and (found.by_stretch is not None) == (frame == "material")
    for derivative, by_stretch in ((found.by_tensor, False), (found.by_stretch, True)):
        if derivative is None:
            continue
        up, down = (outside(step, U + d * H, X) if by_stretch else outside(step, U, X + d * H) for d in (h, -h))
        expected = numbers_of_the_change(outside(step, U, X), up, down) / (2 * h)
        answer = np.einsum("nab,nb->na", derivative, tensors.to_mandel(strain.inside(H)))
        np.testing.assert_allclose(answer, expected, rtol=1e-5, atol=1e-6)


def outside(step: local_problem.StepOfCells, U: Array, X: Array) -> UnitCell:
    """The cells that X makes at U, in the global basis."""
    strain = local_problem.Strain.of(U)
    cells = local_problem.ranked_response(step, strain, strain.inside(X), derivatives=False).cells
    assert cells.cell is not None
    return UnitCell(cells.cell.dimensions, cells.cell.axes @ np.swapaxes(strain.basis, 1, 2))


def numbers_of_the_change(at: UnitCell, up: UnitCell, down: UnitCell) -> Array:
    """Of lengths, and of the turns n_j . dn_i."""
    turns = np.einsum("nia,nja->nij", up.axes - down.axes, at.axes)
    return np.concatenate([up.dimensions - down.dimensions, *(turns[:, i, j, None] for i, j in tensors.PAIRS)], axis=1)


@pytest.mark.parametrize("law, repulsion, driver, frame", COMBINATIONS)
def test_the_cells_belong_to_the_stress(law: str, repulsion: str, driver: str, frame: str) -> None:
    """A pass of the law with the stress that the energy has with these cells gives the same cells again."""
    some, F = points(law, repulsion, driver, frame, 12), deformations(12, np.random.default_rng(2))
    found, step = solved(some, F), some.step
    cells = cells_of(some, found)
    P = stress_of_the_energy(some.tissue, F, cells)
    np.testing.assert_allclose(found.first_piola_kirchhoff, P, rtol=1e-7, atol=1e-7 * np.abs(P).max())
    S, J = np.linalg.solve(F, P), np.linalg.det(F)[:, None, None]
    b = F @ np.swapaxes(F, 1, 2)
    tensor = {"cauchy": P @ np.swapaxes(F, 1, 2) / J, "pk2": S, "finger": b}[driver]
    drive = step.drive._replace(deformation_gradient=F, tensor=(tensor + np.swapaxes(tensor, 1, 2)) / 2)
    again = LAWS[law].update(step.cells, drive, step.time_old, step.time_new)
    np.testing.assert_allclose(structure_tensor(*again[:2]), structure_tensor(*cells[:2]), atol=1e-6)


def cells_of(some: local_problem.LocalProblem, found: local_problem.LocalSolution) -> UnitCell:
    """Of the law for A the roots and axes of A."""
    if some.step.law.dimensions is not None:
        return some.unit_cells(found)
    values, vectors = np.linalg.eigh(found.structure)
    return UnitCell(np.sqrt(values), np.swapaxes(vectors, 1, 2))


def stress_of_the_energy(tissue: Tissue, F: Array, cells: UnitCell) -> Array:
    """P by central differences of W, the only place where the energy is written."""
    P, h = np.zeros_like(F), 1e-6
    for i, j in product(range(3), range(3)):
        H = np.zeros((3, 3))
        H[i, j] = h
        up, down = (tissue.strain_energy(F + sign * H, [cells]) for sign in (1, -1))
        P[:, i, j] = (up - down) / (2 * h)
    return P


@pytest.mark.parametrize("driver", ["cauchy", "pk2", "finger"])
@pytest.mark.parametrize("initial", ["isotropic", "random"])
def test_equal_eigenvalues_leave_the_tangent_exact(driver: str, initial: str) -> None:
    """C, D and A with two and three equal values: the law for A sees no axes."""
    rng = np.random.default_rng(3)
    stretches = np.repeat([[1.2, 1.2, 0.85], [1.3, 0.9, 0.9], [1.15, 1.15, 1.15], [1.2, 1.2 + 1e-9, 0.8]], 4, axis=0)
    R = Rotation.random(32, random_state=rng).as_matrix()
    F = R[:16] @ np.swapaxes(R[16:], 1, 2) @ (stretches[:, :, None] * R[16:])
    some = points("tensor", "log", driver, "material", 16, initial)
    found = solved(some, F)
    assert found.converged.all()
    errors = tangent_errors(some, F, found, rng, 4)
    assert np.median(errors) < 1e-7 and np.max(errors) < 1e-5


def test_the_order_of_the_axes_is_the_laws_own() -> None:
    """With the continuous pairing lengths and axes come back in the order of the cells, whatever the frame's is."""
    rng = np.random.default_rng(4)
    some, F = points("relaxation", "axes", "cauchy", "material", 20, "random"), deformations(20, rng)
    some = with_pairing(some, spectral.continued)
    found = solved(some, F)
    turned = np.argmax(np.abs(some.unit_cells(found).axes @ np.swapaxes(some.step.cells.axes, 1, 2)), axis=2)
    belongs = (np.sort(turned, axis=1) == np.arange(3)).all(axis=1)
    assert belongs.sum() > 10 and (turned[belongs] == np.arange(3)).all()
    ok = found.converged
    assert ok.sum() > 10 and np.median(tangent_errors(some, F, found, rng, 1)[:, ok]) < 1e-7


def test_points_without_a_solution_have_the_tangent_of_their_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """And points without tension keep their cells: there nothing answers."""
    rng = np.random.default_rng(6)
    some, F = points("explicit", "axes", "cauchy", "material", 10), deformations(10, rng)
    H, G = rng.standard_normal((2, 10, 3, 3))
    with monkeypatch.context() as none:
        none.setattr(local_problem, "LOCAL_ITERATIONS", 0)
        found = some.solve(F, G @ np.swapaxes(G, 1, 2))
    assert not found.converged.any()
    tangent, cells = some.tangent(found).tangent, some.unit_cells(found)
    still, up, down = (stress_with(some, F + h * H, cells) for h in (0.0, 1e-6, -1e-6))
    np.testing.assert_allclose(found.first_piola_kirchhoff, still, atol=1e-12)
    np.testing.assert_allclose(np.einsum("niJkL,nkL->niJ", tangent, H), (up - down) / 2e-6, rtol=1e-5, atol=1e-6)
    pressed = solved(some, np.tile(0.8 * np.eye(3), (10, 1, 1)), np.tile(-np.eye(3), (10, 1, 1)))
    np.testing.assert_allclose(structure_tensor(*some.unit_cells(pressed)[:2]), some.step.structure, atol=1e-14)


def stress_with(some: local_problem.LocalProblem, F: Array, cells: UnitCell) -> Array:
    """P with these cells."""
    strain = local_problem.Strain.of(F)
    inside = local_problem.LocalCells.of(UnitCell(cells.dimensions, cells.axes @ strain.basis))
    return F @ strain.outside(local_problem.stress(some.tissue, strain, inside, False, some.step).value)


def test_a_long_step_is_followed_where_newtons_method_does_not_find_its_end() -> None:
    """kappa dt = 10 from random cells: the branch that the cells at the start lead to, which 391 find of themselves."""
    rng = np.random.default_rng(8)
    R = Rotation.random(400, random_state=rng).as_matrix()
    F = np.swapaxes(R, 1, 2) @ ((1 + rng.uniform(-0.2, 0.3, (400, 3)))[:, :, None] * R)
    some = points("tensor", "log", "cauchy", "material", 400, "random", kappa=2.5)
    start = some.tensor_of(F, some.step.cells)
    found = some.solve(F, start)
    assert found.converged.sum() >= 398
    A = found.structure
    np.testing.assert_allclose(np.trace(A, axis1=1, axis2=2)[found.converged], 1.0, atol=1e-12)
    assert (np.linalg.eigvalsh(A) > -1e-12).all()


# ---------------------------------------------------------------- turnover
RULE = TurnoverRule(40.0, 1.1, 1.0, TURNOVER_RATES["tension"])


def turning_over(repulsion: str, driver: str, duration: float, rule: TurnoverRule = RULE) -> local_problem.LocalProblem:
    """With content and natural length of their own at the start of the step."""
    some, rng = points("tensor", repulsion, driver, "material", 40), np.random.default_rng(11)
    content, length = rng.uniform(0.7, 2.0, 40), rng.uniform(0.95, 1.3, 40)
    step = some.step._replace(time_new=some.step.time_old + duration, turnover=rule)
    return local_problem.LocalProblem(replace(some.tissue, content=content, natural_length=length), step)


@pytest.mark.parametrize("duration", [4.0, 1e3, 1e5])
@pytest.mark.parametrize(
    ("repulsion", "driver", "rates"),
    [("log", "cauchy", "tension"), ("length", "pk2", "cauchy"), ("log", "finger", "tension")],
)
def test_the_tangent_with_turnover_is_the_derivative(repulsion: str, driver: str, rates: str, duration: float) -> None:
    """Taylor remainders a quarter at half the way."""
    rng = np.random.default_rng(1)
    rule = RULE._replace(followed=TURNOVER_RATES[rates])
    some, F = turning_over(repulsion, driver, duration, rule), deformations(40, rng)
    found = solved(some, F)
    assert found.converged.mean() > 0.9
    tangent, ok = some.tangent(found).tangent, found.converged
    H = 2e-4 * rng.standard_normal((40, 3, 3))
    left = []
    for h in (1.0, 0.5):
        moved = some.solve(F + h * H, found.driving_tensor).first_piola_kirchhoff - found.first_piola_kirchhoff
        error = moved - h * np.einsum("niJkL,nkL->niJ", tangent, H)
        left.append(np.linalg.norm(error, axis=(1, 2))[ok])
    assert np.median(left[0] / left[1]) == pytest.approx(4.0, abs=0.1)


def test_content_and_natural_length_belong_to_the_end_of_the_step() -> None:
    """ln m and ln rho have changed by the rates at the end; the stress is that of W with them."""
    some, F = turning_over("log", "cauchy", 4.0), deformations(40, np.random.default_rng(2))
    found = solved(some, F)
    assert found.turnover is not None and found.converged.all()
    m, rho = np.exp(found.turnover.T)
    C, tissue = np.swapaxes(F, 1, 2) @ F, some.tissue
    r = np.sqrt(np.einsum("nij,nij->n", found.structure, C))
    end = replace(tissue, content=m, natural_length=rho)
    content, length = RULE.at_length(end, r)
    np.testing.assert_allclose(np.log(m / tissue.content), 4.0 * content, atol=1e-12)
    np.testing.assert_allclose(np.log(rho / tissue.natural_length), 4.0 * length, atol=1e-12)
    assert np.ptp(content) > 0.02  # some fall, some grow as fast as they can
    P = stress_of_the_energy(end, F, cells_of(some, found))
    np.testing.assert_allclose(found.first_piola_kirchhoff, P, rtol=1e-7, atol=1e-7 * np.abs(P).max())
    np.testing.assert_allclose(found.squared_lengths, (r * tissue.natural_length / rho) ** 2, rtol=1e-12)


def test_chains_that_turnover_cannot_follow_are_locked() -> None:
    """Within a step rho grows by (1 + k)/T (L/(lambda_h r0) - 1) at most; up to there r < rho L, beyond it not."""
    ones = np.ones(2)
    tissue = Tissue(*(v * ones for v in (27.3, 3.1, 1.57, 1.594, 1.0)), content=ones, natural_length=ones)
    largest = 1.594 * np.exp(20.0 * 2.0 / 40.0 * (1.594 / 1.1 - 1.0))
    r = largest * np.array([0.9999, 1.0001])
    ratio = r / turned_over_at_the_end(RULE, tissue, r, 20.0).natural_length / 1.594
    assert ratio[0] < 1.0 < ratio[1] and ratio == pytest.approx(1.0, abs=1e-3)


def test_a_step_without_end_leads_to_the_stretch_of_deposition() -> None:
    ones = np.ones(3)
    tissue = Tissue(*(v * ones for v in (27.3, 3.1, 1.57, 1.594, 1.0)), content=ones, natural_length=ones)
    found = turned_over_at_the_end(RULE, tissue, np.array([0.7, 1.1, 3.0]), 1e8)
    np.testing.assert_allclose(found.natural_length, np.array([0.7, 1.1, 3.0]) / 1.1, rtol=1e-5)
    np.testing.assert_allclose(found.natural_length_slope, 1.0, atol=1e-5)
