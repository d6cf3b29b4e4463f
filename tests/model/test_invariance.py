"""What must not depend on the observer: the deformed body turned, everything turned; and the material frame.

Objectivity: F -> Q F with the reference kept. The frame `material` is objective, the frame `spatial`, which is the
printed eq. (9), is not (docs/model.md, erratum 4): shown here, with numbers. Equivariance: F -> Q F Q^T with
n_I(0) -> Q n_I(0), which both are.
"""

from __future__ import annotations

from functools import cache

import dolfinx.fem
import dolfinx.mesh
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from remodel_fenicsx.model.cells import angle_to_axis
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES, material_frame
from remodel_fenicsx.schema.settings import Cells
from tests import parts
from tests.parts import cube
from tests.values import assert_orthonormal

QUARTER = parts.rotation((1.0, 0.0, 0.0), 90.0)  # carries the load axis z to -y
OBLIQUE = parts.rotation((1.0, -2.0, 0.7), 71.0)
RAMP, TURN, END = 4, 6, 12  # times: the loads are held, everything is turned, the end


# ---------------------------------------------------------------- whole bodies
class Bar:
    """A cube with random cells, clamped at the bottom: a dead force on the top and a follower pressure on a side."""

    FORCE, PRESSURE = 4.0, 1.0

    def __init__(self, driver: str, frame: str, turned_reference: np.ndarray | None = None):
        domain = cube(refinement=2)
        if turned_reference is not None:
            domain.mesh.geometry.x[:] = domain.mesh.geometry.x @ turned_reference.T
        self.body = made = parts.body(domain, Cells(initial="random", seed=4))
        if turned_reference is not None:
            made.cells.set(
                made.cells.dimension_values.copy(), made.cells.axis_values @ turned_reference.T
            )
        self.support = dolfinx.fem.Function(made.displacement.function_space)
        facets = domain.facet_tags.find(domain.faces["z0"])
        dofs = dolfinx.fem.locate_dofs_topological(made.displacement.function_space, 2, facets)
        made.loading.boundary_conditions.append(dolfinx.fem.dirichletbc(self.support, dofs))
        for component, name in enumerate(("force_x", "force_y", "force_z")):
            made.loading.add_dead_force(name, "z1", component)
        made.loading.add_follower_pressure("pressure", "x1")
        self.turn = np.eye(3) if turned_reference is None else turned_reference
        self.remodeling = made.remodeling(driver=driver, frame=frame)
        self.problem = made.problem()

    def rotate_observer(self, turn: np.ndarray) -> None:
        """x -> Q x for the deformed body, its supports and the direction of its dead load; the reference stays."""
        made = self.body
        position = made.nodes + made.displacement.x.array.reshape(-1, 3)
        made.set_displacement(position @ turn.T - made.nodes)
        self.support.x.array[:] = (made.nodes @ turn.T - made.nodes).ravel()
        self.turn = turn @ self.turn

    def march(self, start: int, end: int) -> None:
        """Solve and remodel step by step; the loads rise until RAMP."""
        for time in range(start + 1, end + 1):
            factor = min(time / RAMP, 1.0)
            force = factor * self.FORCE * self.turn[:, 2]
            self.body.loading.set(
                {
                    **dict(zip(("force_x", "force_y", "force_z"), force)),
                    "pressure": factor * self.PRESSURE,
                }
            )
            self.problem.solve()
            self.remodeling.apply(float(time - 1), float(time))

    @property
    def position(self) -> np.ndarray:
        """Deformed nodes, turned back to the unturned observer."""
        made = self.body
        return (made.nodes + made.displacement.x.array.reshape(-1, 3)) @ self.turn

    @property
    def lengths(self) -> np.ndarray:
        """l_I."""
        return self.body.cells.dimension_values.copy()

    @property
    def tensor(self) -> np.ndarray:
        """The structure tensor: all reference angles in one."""
        return self.body.cells.structure_tensor()


@cache
def unturned(driver: str, frame: str) -> Bar:
    """At its end."""
    bar = Bar(driver, frame)
    bar.march(0, END)
    return bar


def pair(driver: str, frame: str, turn: np.ndarray) -> tuple[Bar, Bar]:
    """Two bars with one history, the second turned during the hold."""
    still, turned = unturned(driver, frame), Bar(driver, frame)
    turned.march(0, TURN)
    turned.rotate_observer(turn)
    turned.march(TURN, END)
    return still, turned


@pytest.mark.parametrize("turn", [QUARTER, OBLIQUE], ids=["quarter", "oblique"])
@pytest.mark.parametrize(
    "driver, frame", [*((driver, "material") for driver in DRIVERS), ("pk2", "spatial")]
)
def test_turning_the_body_during_the_hold_changes_nothing(
    driver: str, frame: str, turn: np.ndarray
) -> None:
    still, turned = pair(driver, frame, turn)
    assert (
        np.ptp(still.lengths) > 0.5 and np.abs(still.position - still.body.nodes).max() > 0.3
    )  # it did something
    np.testing.assert_allclose(turned.lengths, still.lengths, rtol=0, atol=1e-10)
    np.testing.assert_allclose(turned.tensor, still.tensor, rtol=0, atol=1e-10)
    np.testing.assert_allclose(turned.position, still.position, rtol=0, atol=1e-10)
    assert turned.problem.stored_energy() == pytest.approx(still.problem.stored_energy(), rel=1e-10)


def test_turning_the_body_during_the_hold_changes_everything_in_the_spatial_frame() -> None:
    """Erratum 4, shown: spatial eigenvectors taken for material axes put the chains across the load."""
    still, turned = pair("cauchy", "spatial", QUARTER)
    # measured: places 0.16 of a cube of side 1, structure tensor 0.78 r0^2, dimensions 0.07 r0, stored energy 8 %
    assert np.abs(turned.position - still.position).max() > 0.1
    assert np.abs(turned.tensor - still.tensor).max() > 0.5
    assert np.abs(turned.lengths - still.lengths).max() > 0.03
    assert abs(turned.problem.stored_energy() / still.problem.stored_energy() - 1) > 0.05
    # the chains follow the observer: their mean reference angle to the axis of the bar goes from 50 to 64 degrees
    axis = np.array([0.0, 0.0, 1.0])
    angles = [
        float(np.mean(angle_to_axis(bar.lengths, bar.body.cells.axis_values, axis)))
        for bar in (still, turned)
    ]
    assert angles[0] == pytest.approx(50.1, abs=1.0) and angles[1] == pytest.approx(64.3, abs=1.0)


@pytest.mark.parametrize("frame", ["material", "spatial"])
@pytest.mark.parametrize("driver", ["cauchy", "pk2", "finger"])
def test_turning_reference_loads_and_first_axes_together_turns_the_answer(
    driver: str, frame: str
) -> None:
    straight, turned = unturned(driver, frame), Bar(driver, frame, turned_reference=OBLIQUE)
    turned.march(0, END)
    np.testing.assert_allclose(turned.lengths, straight.lengths, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        turned.tensor, OBLIQUE @ straight.tensor @ OBLIQUE.T, rtol=0, atol=1e-8
    )
    np.testing.assert_allclose(turned.position, straight.position, rtol=0, atol=1e-9)
    assert np.abs(turned.tensor - straight.tensor).max() > 0.3


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("driver", ["cauchy", "pk2"])
def test_nothing_remodels_without_load(driver: str, frame: str) -> None:
    """The body is turned, and its stresses are rounding: l and n stay, bit by bit."""
    bar = Bar(driver, frame)
    bar.rotate_observer(OBLIQUE)
    lengths, tensor = bar.lengths, bar.tensor
    assert bar.remodeling.apply(3.0, 10.0) == 0.0
    np.testing.assert_array_equal(bar.lengths, lengths)
    np.testing.assert_array_equal(bar.tensor, tensor)


# ---------------------------------------------------------------- the frame


def deformations(rng: np.random.Generator, size: float = 0.12) -> np.ndarray:
    """Stretched and turned, (64, 3, 3)."""
    return parts.random_rotations(rng, 64) @ (np.eye(3) + rng.uniform(-size, size, (64, 3, 3)))


SEEDS = st.integers(min_value=0, max_value=2**32 - 1)


@given(seed=SEEDS)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_material_frame(seed: int) -> None:
    """Orthonormal, right-handed, blind to rotations; n_1 is carried onto m_1, n_2 into the plane of m_1 and m_2."""
    rng = np.random.default_rng(seed)
    F, spatial = deformations(rng, 0.4), parts.random_rotations(rng, 64)
    F = F[np.linalg.det(F) > 0.1]
    spatial = spatial[: len(F)]
    axes = material_frame(F, spatial)
    assert_orthonormal(axes)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-12)
    carried = axes @ np.swapaxes(F, 1, 2)
    along = np.sum(carried[:, 0] * spatial[:, 0], axis=1) / np.linalg.norm(carried[:, 0], axis=1)
    np.testing.assert_allclose(along, 1.0, atol=1e-12)
    np.testing.assert_allclose(np.sum(carried[:, 1] * spatial[:, 2], axis=1), 0.0, atol=1e-11)
    turn = parts.random_rotations(rng, len(F))
    turned = material_frame(turn @ F, spatial @ np.swapaxes(turn, 1, 2))
    np.testing.assert_allclose(turned, axes, atol=1e-10)
    # a rotation alone is undone
    np.testing.assert_allclose(
        material_frame(turn, spatial @ np.swapaxes(turn, 1, 2)), spatial, atol=1e-12
    )
