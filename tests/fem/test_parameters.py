"""Material parameters as arguments: one number for the body or one for each element; tissue without chains."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import pytest
import ufl
from mpi4py import MPI

from remodel_fenicsx import Scene
from remodel_fenicsx.evolution.stepper import Stepper
from remodel_fenicsx.fem import jit
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.schema.settings import Cells, Remodeling
from tests import parts
from tests.parts import cube
from tests.runs import simulated

PARAMETERS = ("lame_lambda", "lame_mu", "network_modulus", "contour_length", "end_to_end_length")
FORCE = 6.0
ELASTIC = Remodeling(law="none")


def bar() -> parts.Body:
    """Eight elements of isotropic cells, pulled along z."""
    return parts.body(cube(refinement=2, comm=MPI.COMM_SELF), Cells(initial="isotropic")).supported()


@cache
def refusing() -> parts.Body:
    """Such a bar for what is refused: nobody changes it."""
    return bar()


def tissue() -> Tissue:
    """The paper's."""
    return parts.MATERIAL.tissue(1.0)


def regions(mesh: Any, lower: float, upper: float) -> Any:
    """A DG0 Function with one value below z = 1/2 and one above."""
    function = dolfinx.fem.Function(dolfinx.fem.functionspace(mesh, ("DG", 0)))
    function.interpolate(lambda x: np.where(x[2] < 0.5, lower, upper))
    return function


def everywhere(mesh: Any, kind: str, value: float) -> Any:
    """One value for the body, as a Constant or as a Function."""
    return dolfinx.fem.Constant(mesh, value) if kind == "Constant" else regions(mesh, value, value)


def pulled(made: parts.Body, tissue: Tissue, force: float = FORCE) -> Stepper:
    """In equilibrium with the force, after two steps."""
    stepper = Stepper(made.state(), tissue, ELASTIC, parts.TIGHT, lambda t: {"force": t * force / 2})
    for time in (1.0, 2.0):
        stepper.advance(time)
    return stepper


def heights(made: parts.Body) -> np.ndarray:
    """Mean displacement along z at z = 0, 1/2, 1."""
    moved = made.displacement.x.array.reshape(-1, 3)[:, 2]
    return np.array([moved[np.isclose(made.nodes[:, 2], z)].mean() for z in (0.0, 0.5, 1.0)])


# ---------------------------------------------------------------- one number, or one for each element
@pytest.mark.parametrize("kind", ["Constant", "Function"])
def test_one_value_everywhere_is_the_number(kind: str) -> None:
    """Equilibrium, energy, limits, the pass and its power."""
    found = {}
    for wrap in (False, True):
        made = bar()
        mesh = made.domain.mesh
        material = tissue().map(lambda _, value: everywhere(mesh, kind, value) if wrap else value)
        stepper = pulled(made, material)
        # the same solver of the same numbers: what is left is rounding
        equilibrium = stepper.coupling.equilibrium
        remodeling = parts.RemodelingPass(stepper.state, material, Remodeling(driver="cauchy"))
        power = remodeling.apply(2.0, 3.5)
        scalars = [equilibrium.stored_energy(), equilibrium.extension().max_chain_extension, power, heights(made)[2]]
        found[wrap] = np.concatenate([scalars, made.displacement.x.array, made.cells.structure_tensor().ravel()])
        stepper.close()
    np.testing.assert_allclose(found[True], found[False], rtol=1e-12, atol=1e-12)
    assert abs(found[True][2]) > 1e-3 and found[True][3] > 0.1


def test_each_half_of_a_bar_has_its_own_stiffness() -> None:
    """Without lambda and with soft chains nothing happens across the load: F/A = mu (a - 1/a) in each half."""
    made = bar()
    mesh, mu = made.domain.mesh, (2.0, 6.0)
    constants = tissue().map(lambda _, value: regions(mesh, value, value))
    none, few, long = regions(mesh, 0.0, 0.0), regions(mesh, 1e-13, 1e-13), regions(mesh, 80.0, 30.0)
    material = replace(
        constants, lame_mu=regions(mesh, *mu), lame_lambda=none, network_modulus=few, contour_length=long
    )
    stepper = pulled(made, material)
    stretches = 1 + np.diff(heights(made)) / 0.5
    exact = [FORCE / m / 2 + np.hypot(FORCE / m / 2, 1) for m in mu]
    np.testing.assert_allclose(stretches, exact, rtol=1e-9)
    # r/L with the L of each half, and where it is largest
    extension = stepper.coupling.equilibrium.extension()
    lengths = [np.sqrt((2 + a**2) / 3) for a in exact]
    assert extension.max_chain_extension == pytest.approx(lengths[1] / 30.0, rel=1e-9)
    assert extension.worst_point[2] > 0.5 and lengths[1] < lengths[0]
    stepper.close()


def test_a_constant_stays_the_users_and_compiles_nothing() -> None:
    """A new value is there at the next solve; in whatever order constants are made, the kernels are the same."""
    other = bar()
    pulled(other, replace(tissue(), lame_mu=6.0), 1.5 * FORCE).close()
    known = len(jit.compiled_kernels())
    made = bar()
    mu = dolfinx.fem.Constant(made.domain.mesh, 3.103)
    stepper = pulled(made, replace(tissue(), lame_mu=mu))
    soft = heights(made)[2]
    mu.value = 6.0
    stepper.advance(3.0)
    stepper.close()
    assert heights(made)[2] == pytest.approx(heights(other)[2], rel=1e-9) and abs(heights(made)[2] / soft - 1) > 0.01
    assert len(jit.compiled_kernels()) == known


def functions(mesh: Any) -> dict[str, Any]:
    """Functions that are no DG0 Function of a mesh, or not of this one."""
    other = cube(comm=MPI.COMM_SELF).mesh
    quadrature = basix.ufl.quadrature_element("hexahedron", degree=2)
    spaces = {"DG1": (mesh, ("DG", 1)), "P1": (mesh, ("Lagrange", 1)), "vector": (mesh, ("DG", 0, (3,))),
              "points": (mesh, quadrature), "another mesh": (other, ("DG", 0))}  # fmt: skip
    made = {name: dolfinx.fem.Function(dolfinx.fem.functionspace(*space)) for name, space in spaces.items()}
    return made | {"nan": regions(mesh, np.nan, 1.0), "another mesh's Constant": dolfinx.fem.Constant(other, 1.0)}


BAD = [np.ones(8), np.array(2.0), "3.1", None, True, 1j, ufl.as_ufl(2.0), [1.0], float("nan"), float("inf")]
KINDS = ("DG1", "P1", "vector", "points", "another mesh", "another mesh's Constant", "nan")


@pytest.mark.parametrize(
    "parameter, bad", [*(("lame_mu", kind) for kind in KINDS), *((name, bad) for name in PARAMETERS for bad in BAD)]
)
def test_whatever_else_is_refused(parameter: str, bad: Any) -> None:
    made = refusing()
    value = functions(made.domain.mesh)[bad] if isinstance(bad, str) and bad in KINDS else bad
    with pytest.raises((TypeError, ValueError), match=f"^{parameter}") as caught:
        Stepper(made.state(), replace(tissue(), **{parameter: value}), ELASTIC, parts.TIGHT, lambda t: {})
    assert "\n" not in str(caught.value) and "must be" in str(caught.value)


# ---------------------------------------------------------------- without chains
def neo_hookean_stretch(stress: float, lame_lambda: float, lame_mu: float) -> float:
    """Stretch a of a bar under a nominal stress: P_zz = stress and P_xx = 0 of eq. (4a), by Newton's method."""
    a, b = 1.0, 1.0
    for fraction in np.linspace(0.0, 1.0, 201)[1:]:
        for _ in range(50):
            log_jacobian = np.log(a * b**2)
            residual = np.array([
                (lame_lambda * log_jacobian - lame_mu) / a + lame_mu * a - fraction * stress,
                (lame_lambda * log_jacobian - lame_mu) / b + lame_mu * b,
            ])  # fmt: skip
            slope = np.array([
                [(lame_lambda - lame_lambda * log_jacobian + lame_mu) / a**2 + lame_mu, 2 * lame_lambda / (a * b)],
                [lame_lambda / (a * b), (2 * lame_lambda - lame_lambda * log_jacobian + lame_mu) / b**2 + lame_mu],
            ])  # fmt: skip
            a, b = np.array([a, b]) - np.linalg.solve(slope, residual)
    assert np.abs(residual).max() < 1e-10
    return float(a)


@pytest.mark.parametrize("law", ["none", "explicit"])
def test_without_chains_nothing_locks(law: str) -> None:
    """Cells may turn and grow as they like: the body is its matrix, far beyond the contour length."""
    scene = Scene(
        geometry={"shape": "cube"},
        material={"chain_density": 0.0},
        loads={"force": {"value": 30.0, "ramp": [[0.0, 0.0], [10.0, 1.0]]}},
        remodeling={"law": law},
        time={"end": 11.0},
    )
    with simulated(scene) as (simulation, rows):
        exact = neo_hookean_stretch(30.0, scene.material.lame_lambda, scene.material.lame_mu)
        assert exact > 3 * scene.material.contour_length
        assert rows[-1]["mean_stretch"] == pytest.approx(exact, rel=1e-8)
        assert {row["max_chain_extension"] for row in rows} == {0.0}
        assert {row["remodeling_power"] for row in rows} == {0.0}
        # no chain is in the kernels: constants of the matrix and the size of the body; the only field is displacement
        (energy,) = simulation.stepper.coupling.equilibrium.energies
        assert energy.coefficients() == (simulation.unknown,)
        assert {float(c.value) for c in energy.constants()} == {27.293, 3.103, scene.geometry.side}


# ---------------------------------------------------------------- a mesh of the user's
TUBE = {"preset": "kuhl-holzapfel-2007", "time": {"end": 1.0},
        "geometry": {"shape": "tube", "inner_radius": 1.0, "outer_radius": 2.0, "length": 1.0}}  # fmt: skip
