"""Elements that hold a body back: by a stiff bulk (they lock), or because the strain varies too much inside them."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import dolfinx.fem
import dolfinx.la
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.evolution.stepper import Step, Stepper
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.formulations import NOT_LOCKING, STIFF_BULK
from remodel_fenicsx.model.tensors import cofactor
from remodel_fenicsx.state.memory import Occasions
from remodel_fenicsx.state.parameters import at_points
from remodel_fenicsx.watch.once import WarnsOnce

Array = NDArray[np.float64]

# The part of its way that a body lacks, from which it is said. docs/locking.md: estimate and error over lambda/mu and
# radii; the paper's bodies come to 3.6 % (artery with random cells, t = 5)
WARNED_SHARE = 0.05
# Of the matrix's energy: with less work it is not the loads that deform the body, but its cells. Elastic tubes have at
# least 0.93 (up to 0.9 of the pressure that bursts them), the paper's bodies 1.4
DRIVEN = 0.9
# Jumps between linear elements count so many times: at a wall, where strain varies most, an element has neighbours on
# one side, and half of the jump
JUMPS = 4.0
NEWS = 0.1  # relative change of energies from which on the work, an assembly, is asked for again
# Of the matrix's energy: less of it, lost inside elements, costs no noticeable part of the way. Energies go with
# squares of displacements; where 5.1 % of the way are missing, 8e-4 was measured
NOTICEABLE = 1e-4
TURNED_BY_NOISE = 2.0
"""Degrees by which noise of the pressure turns tensions, from which on it is said. Of 150 random tubes with lambda/mu
from 50 to 10,000 (benchmarks/fuzz.py) 108 had angles off by 1 degree or radii by 0.5 %: 2.4 and more. 5 of the others
had above 2. Bodies as soft as the paper's, which has up to 3.1, are as right as their mesh."""
REMEDY = f"set mesh.element = 'hexahedron' and mesh.formulation = {NOT_LOCKING!r}"
# Change of a displacement, over its largest value, by which forces of the elements are differentiated
DIFFERENCE = 1e-4
MOST_HELD = 0.99  # part of a motion that elements hold back, in the sum of a geometric series


class Missing(NamedTuple):
    """About which part of its way a body lacks: by changes of volume, and by changes of shape, inside elements."""

    volume: float
    shape: float


class LockingWarning(WarnsOnce):
    """Says once that elements hold the body back, as soon as a solved state shows it.

    What an element cannot represent costs work. Two integrals over the body estimate how much,

        volume = int lambda/2 (ln J - ln J_e)^2 dV / (f . u / 2),    J_e the element's,
        shape  = int mu |F - F_e|^2 dV / (f . u / 2),                F_e the element's,

    f the internal nodal forces: ln J_e is the mean of ln J over the element, F_e the polynomial through F of one
    degree less than the displacement. An element that cannot keep its volume spends all of `volume` in vain. Of the
    strain that it cannot follow, `shape` counts twice what it has: about as much again is what it lacks (in a thick
    tube the radial strain, constant in an element, beside the circumferential one). Their sum is about the part of its
    way that the body lacks. (The stored energy is no scale: chains have some without any load.)

    The work is no scale either where an elongation is prescribed: that work drives the free part of the motion only in
    part. So `VolumeResponse` asks the tangent how the body would move if changes of volume inside elements cost
    nothing. That answer bounds `volume`, and it counts by itself against the work of the free unknowns.

    Parameters
    ----------
    stepper
        Whose states are looked at.
    locks
        Whether differences of J inside an element cost energy (`Formulation.locks`).
    remedy
        What the scene may set against it, in words.
    """

    def __init__(self, stepper: Stepper, locks: bool, remedy: str = REMEDY):
        super().__init__(stepper, "locking", {"energy": 0, "vain": 0})
        tissue = at_points(stepper.tissue, self.quadrature)
        shape = self.quadrature.shape
        self.stiffnesses = [self.quadrature.owned(v.reshape(shape)) for v in (tissue.lame_lambda, tissue.lame_mu)]
        self.locks, self.remedy = locks, remedy
        self.response = VolumeResponse(stepper, self.stiffnesses[0])
        self.homogeneous = stepper.state.kinematics.homogeneous  # then there are no elements that could hold it back
        self._occasions = Occasions(stepper.state, "locking")

    def stiffness_ratio(self) -> float:
        """Largest lambda/mu in the body."""
        return self.quadrature.maximum(self.stiffnesses[0] / self.stiffnesses[1])

    def missing(self) -> Missing:
        """Of the present state; zero where neither loads nor prescribed displacements deform the body."""
        return self._missing(*self.energies())

    def _missing(self, energy: float, volume: float, shape: float, enough: float = 0.0) -> Missing:
        """With these energies. Where it is certainly not more than `enough`, a bound: the tangent is not asked."""
        work, free_work = self.work()
        driven = Missing(0.0, 0.0)
        if work > DRIVEN * energy > 0:
            driven = Missing(volume / work, shape / work)
        if volume <= NOTICEABLE * energy:
            return driven
        moved = max(free_work, 0.0) + self._energy_of_elongation() >= DRIVEN * energy
        of_forces = volume / free_work if free_work > 0 else np.inf
        bound = max(driven, Missing(of_forces if moved else 0.0, 0.0), key=sum)
        if sum(bound) <= enough or (lacking := self.response()) is None:
            return bound if sum(bound) <= enough else driven
        driven = driven._replace(volume=min(driven.volume, lacking))
        return max(driven, Missing(min(lacking, of_forces) if moved else 0.0, 0.0), key=sum)

    def _energy_of_elongation(self) -> float:
        """That a prescribed elongation e gives a matrix of constant volume: 3/2 mu e^2 over the body."""
        elongation = self.stepper.state.loading.values.get("elongation", 0.0)
        return self.quadrature.integral(1.5 * self.stiffnesses[1] * elongation**2) if elongation else 0.0

    def energies(self) -> tuple[float, float, float]:
        """Of the matrix, with the mean J of each element; of changes of J inside; twice that of changes of F there."""
        quadrature, (stiffness, shear) = self.quadrature, self.stiffnesses
        states = self.stepper.coupling.equilibrium.look().states.reshape(*stiffness.shape, 11)
        logarithm, F = np.log(states[..., 1]), states[..., 2:]
        inside = quadrature.beyond(0, logarithm[..., None])[..., 0]
        matrix = stiffness * (logarithm - inside) ** 2 + shear * (np.square(F).sum(axis=-1) - 3 - 2 * logarithm)
        volume = stiffness * np.square(inside) * self.locks
        shape = 2 * shear * np.square(quadrature.beyond(quadrature.element_degree - 1, F)).sum(axis=-1)
        shape *= self._followed(shape, F)[:, None]
        weights = quadrature.owned(quadrature.volumes) / 2
        local = np.array([float((part * weights).sum()) for part in (matrix, volume, shape)])
        first, second, third = self.stepper.state.comm.allreduce(local, MPI.SUM).tolist()
        return first, second, third

    def _followed(self, shape: Array, F: Array) -> Array:
        """Which part of `shape` counts, by element: strain that linear elements do follow has no jumps between them.

        The strain of a twisted bar varies inside its elements, which have it exactly. What elements of degree 1 lack
        jumps between them by as much as it varies. Elements of degree 2 err alike where they meet, and a linear strain
        is none that they could lack.
        """
        quadrature = self.quadrature
        if quadrature.element_degree > 1 or quadrature.shape[1] == 1:
            return np.ones(len(F))
        weights = quadrature.owned(quadrature.volumes)
        shear = (self.stiffnesses[1] * weights).sum(axis=1) / weights.sum(axis=1)
        inside = (shape * weights).sum(axis=1) / weights.sum(axis=1)
        jumps = JUMPS * 2 * shear * quadrature.jumps(F)
        return np.asarray(np.minimum(1.0, jumps / np.maximum(inside, np.finfo(float).tiny)))

    def work(self) -> tuple[float, float]:
        """Half of the internal nodal forces times the unknowns: the work of loads and supports if all were linear.

        The second number is that of the unknowns alone that nothing prescribes, the work of forces.
        """
        state, equilibrium = self.stepper.state, self.stepper.coupling.equilibrium
        unknowns = state.unknown.x.array
        free = np.where(np.isnan(equilibrium.prescribed_values()), unknowns, 0.0)
        # shares of the ranks in a node's force are not added up: their sum over all ranks is the same
        forces = sum(dolfinx.fem.assemble_vector(form).array for form in equilibrium.internal_forms)
        local = np.array([forces @ unknowns, forces @ free])
        whole, of_forces = state.comm.allreduce(local, MPI.SUM).tolist()
        return whole / 2, of_forces / 2

    def solved(self, step: Step) -> None:
        """Look, until it was said."""
        if self.homogeneous or self.said or not self._occasions.due():
            return
        energies = self.energies()
        if not self._are_news(*energies):
            return
        missing = self._missing(*energies, WARNED_SHARE)
        if sum(missing) > WARNED_SHARE:
            self.find(self.in_words(missing))

    def _are_news(self, energy: float, *vain: float) -> bool:
        """Whether energies differ from those of the last look."""
        known = self._numbers["energy"], self._numbers["vain"]
        news = any(abs(now - old) > NEWS * old for now, old in zip((energy, sum(vain)), known, strict=True))
        if news:
            self._numbers["energy"], self._numbers["vain"] = energy, sum(vain)
        return news

    def in_words(self, missing: Missing) -> str:
        """What holds the body back, by how much, and what to set."""
        lacks = f"displacements are off by about {100 * min(sum(missing), 1.0):.2g} %"
        if missing.volume >= missing.shape:
            return (
                f"the elements lock, {lacks} (lambda/mu up to {self.stiffness_ratio():.4g}); {self.remedy} "
                "(docs/theory.md, Volumetric locking)"
            )
        return (
            f"the elements are too large, {lacks}: strain varies inside them by more than they can follow; set "
            "mesh.degree = 2 or a larger mesh.refinement (docs/theory.md, Volumetric locking)"
        )


class PressureNoise(WarnsOnce):
    """Says once that the pressure inside elements, not that of the body, decides where the cells turn.

    lambda ln J varies inside an element by more than a displacement of its degree k can follow: what no polynomial of
    degree k - 1 has is noise. Displacements hardly see it, for it has no mean. Cells take the stress at each point.
    The sensor takes the noise out of the driving stress and measures by how much that turns the principal tensions
    (s_1, s_2, s_3), those below 0 being none.

    Parameters
    ----------
    stepper
        Whose passes take the stress.
    remedy
        What the scene may set against it, in words.
    """

    def __init__(self, stepper: Stepper, remedy: str = REMEDY):
        super().__init__(stepper, "pressure_noise")
        self.remedy = remedy
        points = at_points(stepper.tissue, self.quadrature)
        lame = points.lame_lambda.reshape(self.quadrature.shape)
        self.stiffness = self.quadrature.owned(lame)
        self.ratio = self.quadrature.maximum(lame / points.lame_mu.reshape(self.quadrature.shape))
        self._occasions = Occasions(stepper.state, "pressure_noise")

    def degrees(self) -> float:
        """Mean over the body of the angle by which the noise turns the tensions of the present state."""
        quadrature, stiffness = self.quadrature, self.stiffness
        F, tensor = (values[: stiffness.size] for values in self.stepper.remodeling.driving_tensor())
        J = np.linalg.det(F)
        logarithm = np.log(J).reshape(stiffness.shape)
        noise = quadrature.beyond(quadrature.element_degree - 1, (stiffness * logarithm)[..., None]).reshape(-1, 1, 1)
        if self.stepper.remodeling.driver.material:
            quiet = tensor - noise * np.linalg.inv(F.swapaxes(1, 2) @ F)
        else:
            quiet = tensor - noise / J[:, None, None] * np.eye(3)
        with_noise, without = (np.maximum(np.linalg.eigvalsh(stress), 0.0) for stress in (tensor, quiet))
        lengths = np.linalg.norm(with_noise, axis=1) * np.linalg.norm(without, axis=1)
        # no tension in both: nothing turns; in one alone: everything does
        cosine = np.where(lengths > 0, (with_noise * without).sum(axis=1), (with_noise + without).sum(axis=1) == 0)
        turned = np.degrees(np.arccos(np.clip(cosine / np.where(lengths > 0, lengths, 1.0), -1.0, 1.0)))
        return quadrature.integral(turned.reshape(stiffness.shape)) / quadrature.volume

    def solved(self, step: Step) -> None:
        """Look, until it was said."""
        if self.ratio <= min(STIFF_BULK.values()) or self.said or not self._occasions.due():
            return
        if (turned := self.degrees()) <= TURNED_BY_NOISE:
            return
        self.find(
            f"the pressure inside elements is noise, which turns the tensions that drive the cells by {turned:.2g} "
            f"degrees on the mean: fibre angles and radii are off (lambda/mu up to {self.ratio:.4g}); {self.remedy} "
            "(docs/locking.md)"
        )


class VolumeResponse:
    """How the body would move on if changes of volume inside its elements cost nothing.

    The stress P = lambda (ln J - ln J_e) F^-T of these changes has the nodal forces r. Without them the body moves on
    by (K - C)^-1 r, with the tangent K and the derivative C of r by the unknowns. That is about d / (1 - s): d = K^-1 r
    is the answer of the present tangent, and s = d.C d / d.r is the share of the stiffness along d which C makes.

    Parameters
    ----------
    stepper
        Whose states are looked at, and whose factors of the tangent, perhaps of an earlier state, are used.
    stiffness
        lambda at the points of this rank's elements, (elements, points).
    """

    def __init__(self, stepper: Stepper, stiffness: Array):
        self.stepper, self.state, self.stiffness = stepper, stepper.state, stiffness
        self.quadrature = stepper.state.cells.quadrature

    def __call__(self) -> float | None:
        """Which part of its way the body lacks, from 0 to 1.

        None where it is not known: the solver keeps no factors, or elements of a single point have nothing inside.
        """
        factors = self.stepper.coupling.newton.factorisation()
        if factors is None or self.quadrature.shape[1] == 1 or not factors.getOperators()[0].assembled:
            return None
        stress = self._stress()
        forces, first = factors.getOperators()[0].createVecs()
        self._assemble(stress, forces)
        factors.apply(forces, first)
        self._refine(first, forces, factors)
        resisted = first.dot(forces)
        if not resisted > 0:
            lacking = 0.0
        else:
            share = first.dot(self._derivative(first)) / resisted
            lacking = self._part_of_the_way(first, 1 / (1 - min(max(share, 0.0), MOST_HELD)))
        for vector in (forces, first):
            vector.destroy()
        return lacking

    @staticmethod
    def _refine(answer: Any, forces: Any, factors: Any) -> None:
        """One step of iterative refinement, with the matrix that was factorised: factors may have few digits."""
        left, better = forces.duplicate(), forces.duplicate()
        factors.getOperators()[0].mult(answer, left)
        left.aypx(-1.0, forces)
        factors.apply(left, better)
        answer.axpy(1.0, better)
        for vector in (left, better):
            vector.destroy()

    def _stress(self) -> Array:
        """P of the present unknowns, (elements, points, 3, 3); cof F = J F^-T."""
        quadrature = self.quadrature
        states = quadrature.owned(self.stepper.coupling.equilibrium.states())
        changes = quadrature.beyond(0, np.log(states[..., 1])[..., None])[..., 0]
        F = states[..., 2:].reshape(*changes.shape, 3, 3)
        stress: Array = (self.stiffness * changes / states[..., 1])[..., None, None] * cofactor(F)
        return stress

    def _assemble(self, stress: Array, forces: Any) -> None:
        """Nodal forces of a stress, zero where displacements are prescribed."""
        quadrature, (function, form) = self.quadrature, self._form
        quadrature.owned(quadrature.values(function, (3, 3)))[:] = stress
        function.x.scatter_forward()
        local = dolfinx.fem.assemble_vector(form)
        local.scatter_reverse(dolfinx.la.InsertMode.add)
        prescribed = self.stepper.coupling.equilibrium.prescribed_values()
        number = self.state.number_of_owned_unknowns
        forces.array[:] = np.where(np.isnan(prescribed), local.array, 0.0)[:number]

    @cached_property
    def _form(self) -> tuple[Any, Any]:
        """P as a function of the points, and its virtual work, compiled."""
        state, quadrature = self.state, self.quadrature
        function = quadrature.function("stress_in_vain", (3, 3))
        test = ufl.TestFunction(state.unknown.function_space)
        variation = ufl.derivative(state.kinematics.elastic_gradient(state.unknown), state.unknown, test)
        weight = state.kinematics.stress_free_weight(quadrature.mesh)
        return function, jit.form(ufl.inner(function, variation) * weight * quadrature.dx)

    def _derivative(self, direction: Any) -> Any:
        """C times a change of the unknowns, by central differences; the unknowns are restored."""
        values, change = self.state.unknown.x.array, self._function(direction).x.array
        start = values.copy()
        largest = [self.state.comm.allreduce(float(np.abs(v).max(initial=0.0)), MPI.MAX) for v in (start, change)]
        step = DIFFERENCE * largest[0] / largest[1]
        ends = [direction.duplicate() for _ in range(2)]
        try:
            for sign, end in zip((1.0, -1.0), ends, strict=True):
                values[:] = start + sign * step * change
                self._assemble(self._stress(), end)
        finally:
            values[:] = start
        ends[0].axpy(-1.0, ends[1])
        ends[0].scale(1 / (2 * step))
        ends[1].destroy()
        return ends[0]

    def _part_of_the_way(self, first: Any, factor: float) -> float:
        """Of the missing motion, its component along the way: each direction of space counts by what it lacks."""
        state, number = self.state, self._number_of_nodes
        has = state.kinematics.nodal_displacement(state.unknown)[:number].copy()
        lacks = factor * state.kinematics.nodal_displacement(self._function(first))[:number]
        way = has + lacks
        along, squares = (state.comm.allreduce((values * way).sum(axis=0), MPI.SUM) for values in (lacks, way))
        lengths = np.sqrt(squares)
        missing = np.abs(along) / np.where(lengths > 0, lengths, 1.0)
        return float(missing @ missing / (missing @ lengths)) if missing.any() else 0.0

    @cached_property
    def _number_of_nodes(self) -> int:
        """That this rank owns."""
        space = self.state.kinematics.nodal_space(self.state.unknown)
        return int(space.dofmap.index_map.size_local)

    def _function(self, vector: Any) -> Any:
        """A change of the unknowns as a dolfinx function, ghosts included."""
        change = self.state.unknown.copy()
        change.x.array[: self.state.number_of_owned_unknowns] = vector.array_r
        change.x.scatter_forward()
        return change
