"""What tensor.c computes at points is what numpy does, without a mesh."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial.transform import Rotation

from remodel_fenicsx.kernels.tensor import CompiledProblem, TensorKernels, problem_of
from remodel_fenicsx.model import energy, local_problem, spectral
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.chains import CHAINS, Chain
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.local_problem import LocalProblem
from remodel_fenicsx.model.laws import Drive, explicit, ranked, tensor_target
from tests.model.test_local_problem import COMBINATIONS, deformations, points
from tests.model.test_tensor_law import cells_of, right_cauchy_green, structures

COUNT = 60


@pytest.fixture(scope="module")
def kernels() -> TensorKernels:
    return TensorKernels(MPI.COMM_SELF)


def test_derivatives_of_the_logarithm(kernels: TensorKernels) -> None:
    """Equal and nearly equal eigenvalues too, on both sides of the series' threshold."""
    C = right_cauchy_green()
    A = structures(len(C))
    expected, found = energy.log_derivatives(C, A), kernels.log_derivatives(C, A)
    np.testing.assert_allclose(found[0], expected[0], atol=1e-13)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-11 * np.abs(expected[1]).max())
    first, none = kernels.log_derivatives(C, A, second=False)
    assert none is None and np.array_equal(first, found[0])


def test_the_sum_of_the_energy(kernels: TensorKernels) -> None:
    F, cells = np.linalg.cholesky(right_cauchy_green()), cells_of(structures(26))
    expected = energy.log_sum(F, [cells], 1.0)
    np.testing.assert_allclose(kernels.log_sum(F, [cells], 1.0), expected, atol=1e-13)
    half = [UnitCell(*cells[:2], weight=0.5)] * 2
    np.testing.assert_allclose(kernels.log_sum(F, half, 1.0), expected, atol=1e-13)


@pytest.mark.parametrize("driver", ["cauchy", "pk2"])
@pytest.mark.parametrize("frame", ["material", "spatial"])
def test_the_target(kernels: TensorKernels, driver: str, frame: str) -> None:
    """Tension, compression, nothing, and values near the switch."""
    rng = np.random.default_rng(2)
    tensors = rng.standard_normal((40, 3, 3))
    tensors = tensors + np.swapaxes(tensors, 1, 2)
    tensors[:4] = np.array([0.0, -1.0, 3e-11, 1e200])[:, None, None] * np.eye(3)
    F = deformations(40, rng)
    drive = Drive(F, tensors, DRIVERS[driver], FRAMES[frame], 1e-14, np.zeros((40, 3)), np.ones(40), 0.025)
    for threshold, rounding in ((1e-14, 1e-14), (rng.uniform(0, 0.3, 40), 1e-14), (0.0, rng.uniform(0, 1e-4, 40))):
        asked = drive._replace(noise=threshold, rounding=rounding)
        expected, found = tensor_target(asked), kernels.target(asked)
        np.testing.assert_allclose(found.direction, expected.direction, atol=1e-12)
        np.testing.assert_allclose(found.switch, expected.switch, atol=1e-12)


def asked_of_numpy(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """At how many points, each time that numpy solves."""
    asked: list[int] = []
    solve = LocalProblem.solve
    monkeypatch.setattr(LocalProblem, "solve", lambda self, F, *given: asked.append(len(F)) or solve(self, F, *given))
    return asked


def compiled_twin(kernels: TensorKernels, some: LocalProblem) -> CompiledProblem:
    twin = problem_of(kernels, some.tissue, some.step)
    assert isinstance(twin, CompiledProblem)
    return twin


@pytest.mark.parametrize(("law", "repulsion", "driver", "frame"), COMBINATIONS)
def test_solution_and_slopes(kernels: TensorKernels, law: str, repulsion: str, driver: str, frame: str) -> None:
    """Random cells. Of the law for A a stress that is partly compression, and equal stretches at the last points."""
    rng = np.random.default_rng(11)
    F, kappa = deformations(COUNT, rng), np.linspace(0.0, 0.05, COUNT)  # of points in several regions
    if law == "tensor":  # by rank such points have several solutions, or none
        F += 0.05 * rng.standard_normal((COUNT, 3, 3))
        F[-4:] = np.array([1.2, 1.2, 1.2, 1.2, 1.2, 0.8, 0.9, 1.3, 1.3, 0.9, 0.9, 0.9]).reshape(4, 3, 1) * np.eye(3)
        kappa = 4 * kappa
    some = points(law, repulsion, driver, frame, COUNT, "random", kappa=kappa)
    twin, start = compiled_twin(kernels, some), some.tensor_of(F, some.step.cells)
    assert law != "tensor" or driver == "finger" or (np.linalg.eigvalsh(start) < 0).any()
    expected, found = some.solve(F, start), twin.solve(F, start)
    few = 0 if law == "tensor" else COUNT // 20  # by rank there are folds, where rounding decides
    assert (found.converged != expected.converged).sum() <= few
    ok = expected.converged & found.converged
    assert ok.mean() > (0.4 if driver == "pk2" and law != "tensor" else 0.85)  # it leaves many points without a state
    names = "driving_tensor", "structure", "first_piola_kirchhoff", "squared_lengths"
    pairs = {name: (getattr(found, name), getattr(expected, name)) for name in names}
    pairs |= {str(at): pair for at, pair in enumerate(zip(twin.tangent(found), some.tangent(expected), strict=True))}
    pairs["lengths"] = twin.unit_cells(found).dimensions, some.unit_cells(expected).dimensions
    for name, (of_c, of_numpy) in pairs.items():
        error = np.abs(of_c - of_numpy).reshape(COUNT, -1).max(axis=1) / np.abs(of_numpy[ok]).max()
        assert (error[ok] > 1e-8).sum() <= few and np.median(error[ok]) < 1e-12, name


def test_what_the_kernel_does_not_solve_numpy_does(kernels: TensorKernels, monkeypatch: pytest.MonkeyPatch) -> None:
    """kappa dt = 10: where Newton's method does not find the end of the step, it is followed; r >= L has none."""
    # where there is none all are spent, in every part of the step
    monkeypatch.setattr(local_problem, "LOCAL_ITERATIONS", 10)
    rng = np.random.default_rng(8)
    R = Rotation.random(COUNT, random_state=rng).as_matrix()
    F = np.swapaxes(R, 1, 2) @ ((1 + rng.uniform(-0.2, 0.3, (COUNT, 3)))[:, :, None] * R)
    F[0] = 3.0 * np.eye(3)
    some = points("tensor", "log", "cauchy", "material", COUNT, "random", kappa=2.5)
    twin, start = compiled_twin(kernels, some), some.tensor_of(F, some.step.cells)
    asked = asked_of_numpy(monkeypatch)
    expected, found = some.solve(F, start), twin.solve(F, start)
    assert asked[0] == COUNT and 0 < asked[1] < COUNT
    assert not expected.converged[0] and expected.converged[1:].all()
    np.testing.assert_array_equal(found.converged, expected.converged)
    solved = found.converged
    np.testing.assert_allclose(found.structure[solved], expected.structure[solved], atol=1e-9)
    tangent = some.tangent(expected).tangent[1:]
    np.testing.assert_allclose(twin.tangent(found).tangent[1:], tangent, atol=1e-7 * np.abs(tangent).max())


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_points_without_a_solution_have_the_tangent_of_their_cells(kernels: TensorKernels, share: float) -> None:
    """Some of the points, and all."""
    rng = np.random.default_rng(12)
    some, F = points("tensor", "log", "cauchy", "material", COUNT, "random"), deformations(COUNT, rng)
    twin, lost = compiled_twin(kernels, some), np.arange(COUNT) < share * COUNT
    found = twin.solve(F, some.tensor_of(F, some.step.cells))
    found.converged[lost] = False
    tangent = twin.tangent(found).tangent
    kept = some.tangent(found._replace(converged=np.zeros(COUNT, dtype=bool))).tangent
    np.testing.assert_allclose(tangent[lost], kept[lost], atol=1e-12 * np.abs(kept).max())
    assert lost.all() or np.abs(tangent[~lost] - kept[~lost]).max() > 1e-3


def test_where_principal_values_agree_numpy_decides(kernels: TensorKernels, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of laws by rank alone, whose axes are then those that were; points without a solution are not tried again."""
    rng = np.random.default_rng(4)
    F = deformations(COUNT, rng)
    F[: COUNT // 3] = np.diag([0.95, 0.95, 1.3])
    some = points("explicit", "axes", "cauchy", "material", COUNT, "isotropic", kappa=0.05)
    twin, start = compiled_twin(kernels, some), some.tensor_of(F, some.step.cells)
    asked = asked_of_numpy(monkeypatch)
    expected, found = some.solve(F, start), twin.solve(F, start)
    assert expected.converged.all() and found.converged.all() and asked == [COUNT, COUNT // 3]
    np.testing.assert_allclose(found.structure, expected.structure, atol=1e-10)
    tangent = some.tangent(expected).tangent
    np.testing.assert_allclose(twin.tangent(found).tangent, tangent, atol=1e-9 * np.abs(tangent).max())
    torn = np.tile(np.diag([0.9, 1.0, 2.5]), (COUNT, 1, 1)) + 0.01 * rng.standard_normal((COUNT, 3, 3))
    asked.clear()
    assert not twin.solve(torn, start).converged.any() and not asked


@pytest.mark.parametrize("law", ["tensor", "explicit"])
def test_a_rank_may_have_no_points(kernels: TensorKernels, law: str) -> None:
    none = np.empty((0, 3, 3))
    twin = compiled_twin(kernels, points(law, "log", "cauchy", "material", 2).at(np.arange(0)))
    found = twin.solve(none, none)
    assert twin.tangent(found).tangent.shape == (0, 3, 3, 3, 3) and not len(twin.unit_cells(found).dimensions)


def test_parts_that_the_kernel_does_not_know_are_numpys(kernels: TensorKernels) -> None:
    """Another chain, pairing or law: no silent stand-in."""
    some = points("explicit", "log", "cauchy", "material", 2)
    tissue, step = some.tissue, some.step
    curved = ranked(lambda l, l0, target, *rest: explicit(l, l0, target**2, *rest))
    for other, another in (
        (tissue, step._replace(law=curved)),
        (tissue, step._replace(drive=step.drive._replace(pairing=spectral.continued))),
        (replace(tissue, chain=SPRING), step),
    ):
        assert type(problem_of(kernels, other, another)) is LocalProblem
    assert type(problem_of(None, tissue, step)) is LocalProblem


SPRING = Chain(lambda r, L: 0.35 * r**2, lambda r, L: 0.7 + 0.0 * r, locks=False)
SOFTER = energy.Matrix(
    lambda *given: energy.neo_hookean.volumetric(*given) / 2,
    *(lambda *given, term=term: term(*given) / 2 for term in energy.neo_hookean.others),
    derivatives=lambda *given: tuple(
        None if value is None else value / 2 for value in energy.neo_hookean_derivatives(*given)
    ),
)


@pytest.mark.parametrize(
    "registry, name, part", [(CHAINS, "wormlike", SPRING), (energy.MATRICES, "neo-hookean", SOFTER)]
)
def test_a_part_under_a_name_that_c_knows_is_numpys(
    kernels: TensorKernels, monkeypatch: pytest.MonkeyPatch, registry: Any, name: str,
    part: Any,
) -> None:  # fmt: skip
    """C asks which part it is, not what it is called."""
    rng = np.random.default_rng(3)
    F, some = deformations(COUNT, rng), points("tensor", "log", "cauchy", "material", COUNT, "random")
    monkeypatch.setitem(registry, name, part)
    other = replace(some, tissue=replace(some.tissue, **{"chain" if registry is CHAINS else "matrix": part}))
    start = other.tensor_of(F, other.step.cells)
    expected = other.solve(F, start)
    found = problem_of(kernels, other.tissue, other.step).solve(F, start)
    np.testing.assert_array_equal(found.structure, expected.structure)
    of_c = compiled_twin(kernels, some).solve(F, start)
    assert np.abs(of_c.structure - expected.structure).max() > 1e-3
