"""Warnings of a run, each said once: elements that lock, noise, buckling, lost volume, fronts."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NamedTuple

import dolfinx.fem
import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.shape import Shape
from remodel_fenicsx.evolution.stepper import Step, Stepper, WarnsOnce
from remodel_fenicsx.fem.compat import geometry_dofmap
from remodel_fenicsx.fem.formulations import FORMULATIONS, NOT_LOCKING, STIFF_BULK
from remodel_fenicsx.system import NOTICE

if TYPE_CHECKING:
    from remodel_fenicsx.scene.scene import Scene

Array = NDArray[np.float64]


# ---------------------------------------------------------------- elements that hold a body back
# By a stiff bulk (they lock), or because the strain varies too much inside them.

# The part of its way that a body lacks, from which it is said. docs/what_may_go_wrong.md: estimate and error; the
# paper's bodies come to 3.6 % (artery with random cells, t = 5)
WARNED_SHARE = 0.05
# Of the matrix's energy: with less work it is not the loads that deform the body, but its cells. Elastic tubes have at
# least 0.93 (up to 0.9 of the pressure that bursts them), the paper's bodies 1.4
DRIVEN = 0.9
# Jumps between linear elements count so many times: at a wall, where strain varies most, an element has neighbours on
# one side, and half of the jump
JUMPS = 4.0
# Part of the motion across an elongated body that it lacks, over the share of volume changes in the
# matrix's energy: 1.6 to 3.3 where the tangent was asked (tubes, elongation 0.1, lambda/mu 8.8 to 250)
HELD_BACK = 2.5
TURNED_BY_NOISE = 2.0
"""Degrees by which noise of the pressure turns tensions, from which on it is said. Of 150 random tubes with lambda/mu
from 50 to 10,000 (benchmarks/fuzz.py) 108 had angles off by 1 degree or radii by 0.5 %: 2.4 and more. 5 of the others
had above 2. Bodies as soft as the paper's, which has up to 3.1, are as right as their mesh."""
REMEDY = f"set mesh.element = 'hexahedron' and mesh.formulation = {NOT_LOCKING!r}"


def remedy(scene: Scene) -> str:
    """What a scene may set whose elements lock, in words."""
    if needs := scene.needs_all_points():
        return f"set mesh.degree = 2 or a larger mesh.refinement, for {needs} needs mesh.formulation = 'displacement'"
    return REMEDY


class Missing(NamedTuple):
    """About which part of its way a body lacks: by changes of volume, and by changes of shape, inside elements."""

    volume: float
    shape: float


class ElementWarning(WarnsOnce):
    """What warnings of elements know of the tissue: lambda and mu at this rank's own points."""

    def __init__(self, stepper: Stepper, remedy: str = REMEDY):
        super().__init__(stepper)
        tissue, shape = self.state.parameters(stepper.tissue).at_points(), self.quadrature.shape
        self.stiffnesses = [self.quadrature.owned(v.reshape(shape)) for v in (tissue.lame_lambda, tissue.lame_mu)]
        self.ratio, self.remedy = self.quadrature.maximum(self.stiffnesses[0] / self.stiffnesses[1]), remedy


class LockingWarning(ElementWarning):
    """Says once that elements hold the body back, as soon as a solved state shows it."""

    name = "locking"

    def __init__(self, stepper: Stepper, locks: bool, remedy: str = REMEDY):
        super().__init__(stepper, remedy)
        self.locks = locks

    @classmethod
    def of(cls, scene: Scene, stepper: Stepper) -> LockingWarning | None:
        if stepper.state.kinematics.homogeneous:  # there are no elements that could hold it back
            return None
        return cls(stepper, FORMULATIONS[scene.mesh.formulation].locks, remedy(scene))

    def missing(self) -> Missing:
        """Return what the present state lacks; zero if neither loads nor prescribed displacements deform the body."""
        energy, volume, shape = self.energies()
        work, free_work = self.work()
        driven = Missing(volume / work, shape / work) if work > DRIVEN * energy > 0 else Missing(0.0, 0.0)
        if not max(free_work, 0.0) + self._energy_of_elongation() > DRIVEN * energy > 0:
            return driven
        # the work of a prescribed elongation hides that of the motion across, which elements hold back
        across = min(HELD_BACK * volume / energy, volume / free_work if free_work > 0 else np.inf)
        return max(driven, Missing(across, 0.0), key=sum)

    def _energy_of_elongation(self) -> float:
        """That a prescribed elongation e gives a matrix of constant volume: 3/2 mu e^2 over the body."""
        elongation = self.stepper.state.loading.values.get("elongation", 0.0)
        return self.quadrature.integral(1.5 * self.stiffnesses[1] * elongation**2) if elongation else 0.0

    def energies(self) -> tuple[float, float, float]:
        """Of the matrix, with the mean J of each element; of changes of J inside; twice that of changes of F there."""
        quadrature, (stiffness, shear) = self.quadrature, self.stiffnesses
        look = self.stepper.coupling.equilibrium.look()
        logarithm, F = np.log(look.jacobians), look.gradients.reshape(*stiffness.shape, 9)
        inside = quadrature.beyond(0, logarithm[..., None])[..., 0]
        matrix = stiffness * (logarithm - inside) ** 2 + shear * (np.square(F).sum(axis=-1) - 3 - 2 * logarithm)
        volume = stiffness * np.square(inside) * self.locks
        shape = 2 * shear * np.square(quadrature.beyond(quadrature.element_degree - 1, F)).sum(axis=-1)
        shape *= self._followed(shape, F)[:, None]
        weights = quadrature.owned(quadrature.volumes) / 2
        local = np.array([float((part * weights).sum()) for part in (matrix, volume, shape)])
        first, second, third = self.stepper.state.comm.allreduce(local).tolist()
        return first, second, third

    def _followed(self, shape: Array, F: Array) -> Array:
        """Which part of `shape` counts, by element: strain that linear elements do follow has no jumps between them."""
        # The strain of a twisted bar varies inside its elements, which have it exactly. What elements of degree 1 lack
        # jumps between them by as much as it varies. Elements of degree 2 err alike where they meet, and a linear
        # strain is none that they could lack.
        quadrature = self.quadrature
        if quadrature.element_degree > 1 or quadrature.shape[1] == 1:
            return np.ones(len(F))
        weights = quadrature.owned(quadrature.volumes)
        shear = (self.stiffnesses[1] * weights).sum(axis=1) / weights.sum(axis=1)
        inside = (shape * weights).sum(axis=1) / weights.sum(axis=1)
        jumps = JUMPS * 2 * shear * quadrature.jumps(F)
        return np.asarray(np.minimum(1.0, jumps / np.maximum(inside, np.finfo(float).tiny)))

    def work(self) -> tuple[float, float]:
        """Half of the internal nodal forces times the unknowns: the work of loads and supports if all were linear."""
        # The second number is that of the unknowns alone that nothing prescribes, the work of forces.
        state, equilibrium = self.stepper.state, self.stepper.coupling.equilibrium
        unknowns = state.unknown.x.array
        free = np.where(np.isnan(equilibrium.prescribed_values()), unknowns, 0.0)
        # shares of the ranks in a node's force are not added up: their sum over all ranks is the same
        forces = sum(dolfinx.fem.assemble_vector(form).array for form in equilibrium.internal_forms)
        local = np.array([forces @ unknowns, forces @ free])
        whole, of_forces = state.comm.allreduce(local).tolist()
        return whole / 2, of_forces / 2

    def look(self, step: Step) -> str:
        """Whether the body lacks more of its way than is noticed."""
        missing = self.missing()
        return self.in_words(missing) if sum(missing) > WARNED_SHARE else ""

    def in_words(self, missing: Missing) -> str:
        """What holds the body back, by how much, and what to set."""
        lacks = f"displacements are off by about {100 * min(sum(missing), 1.0):.2g} %"
        if missing.volume >= missing.shape:
            return (
                f"the elements lock, {lacks} (lambda/mu up to {self.ratio:.4g}); {self.remedy} "
                "(docs/theory.md, Volumetric locking)"
            )
        return (
            f"the elements are too large, {lacks}: strain varies inside them by more than they can follow; set "
            "mesh.degree = 2 or a larger mesh.refinement (docs/theory.md, Volumetric locking)"
        )


class PressureNoise(ElementWarning):
    """Says once that the pressure inside elements, not that of the body, decides where the cells turn."""

    name = "pressure_noise"

    @classmethod
    def of(cls, scene: Scene, stepper: Stepper) -> PressureNoise | None:
        remodeling, locks = stepper.remodeling, FORMULATIONS[scene.mesh.formulation].locks
        turns = remodeling.law.remodels and remodeling.driver.is_stress and not stepper.state.kinematics.homogeneous
        return cls(stepper, remedy(scene)) if locks and turns else None

    def degrees(self) -> float:
        """Mean over the body of the angle by which the noise turns the tensions of the present state."""
        quadrature, stiffness = self.quadrature, self.stiffnesses[0]
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

    def look(self, step: Step) -> str:
        """Whether it turns them by much."""
        if self.ratio <= min(STIFF_BULK.values()) or (turned := self.degrees()) <= TURNED_BY_NOISE:
            return ""
        return (
            f"the pressure inside elements is noise, which turns the tensions that drive the cells by {turned:.2g} "
            f"degrees on the mean: fibre angles and radii are off (lambda/mu up to {self.ratio:.4g}); {self.remedy} "
            "(docs/what_may_go_wrong.md, Cells that turn)"
        )


# ---------------------------------------------------------------- what a run says of its tissue
# Volume that is lost, chains that do not lie in the wall, and fronts.

# Of its volume a soft tissue is measured to lose a few per cent at most: what is beyond is a choice of lambda. The
# paper's tendon and artery, lambda/mu = 8.8, keep J above 0.92 at every point.
NOTED = 0.05  # mean loss that the log mentions at the end
MEAN_LOSS, LEAST_JACOBIAN = 0.2, 0.6  # from where on it is hardly meant
WEAK = 0.05  # the paper's tube by the law "tensor": angles were 0.02 degrees off at 0.014, 1.2 at 0.14, 12 at 1.4
RADIAL_SHARE = 0.5  # of the chains: more of them out of the wall are said
# degrees between two points of an element that are a front, not a slope: within its elements the paper's artery turns
# by up to 14 degrees; and the share of a layer that such elements make up
FRONT_ANGLE, FRONT_SHARE = 45.0, 0.5


class VolumeLoss(WarnsOnce):
    """Warns, once, where the tissue loses much of its volume, and says at the end how much it has lost at most."""

    name = "volume"
    initial = {"mean": 1.0, "mean_time": 0.0, "least": 1.0, "least_time": 0.0} | dict.fromkeys("xyz", 0.0)

    def solved(self, step: Step) -> None:
        """Look at every J, also when it was said: the most that is lost is said at the end."""
        self._measure(step)
        numbers = self._numbers
        if not self.said and (1 - numbers["mean"] >= MEAN_LOSS or numbers["least"] < LEAST_JACOBIAN):
            self.find(step, f"{self._in_words()}; set a larger material.lame_lambda (docs/commands.md)")
        elif step.is_last and 1 - numbers["mean"] >= NOTED:
            step.findings.append((logging.INFO, self._in_words()))

    def _measure(self, step: Step) -> None:
        numbers, jacobians = self._numbers, self.stepper.coupling.equilibrium.look().jacobians
        mean = self.quadrature.integral(jacobians) / self.quadrature.volume
        if mean < numbers["mean"]:
            numbers["mean"], numbers["mean_time"] = mean, step.time
        of_formulation = self.quadrature.owned(self.state.dilatation.jacobians())
        if of_formulation.shape[1]:
            jacobians = np.broadcast_to(of_formulation.min(axis=1)[:, None], jacobians.shape)
        least = self.quadrature.minimum(jacobians)
        if least < numbers["least"]:
            numbers["least"], numbers["least_time"] = least, step.time
            for name, value in zip("xyz", self.quadrature.place_of_largest(-jacobians), strict=True):
                numbers[name] = value

    def _in_words(self) -> str:
        found = {name: self._numbers[name] for name in self.initial}
        return (
            "the tissue has lost up to {lost:.2g} % of its volume at {x:.4g}, {y:.4g}, {z:.4g} (least J {least:.3g}, "
            "time {least_time:g}), {whole:.2g} % in all (mean J {mean:.3g}, time {mean_time:g})"
        ).format(lost=100 * (1 - found["least"]), whole=100 * (1 - found["mean"]), **found)


class WeakTension(WarnsOnce):
    """Says at the end that stresses were never far above those that count as rounding: cells turned too slowly."""

    name = "weak_tension"

    def completed(self, step: Step) -> None:
        """Look at the end, when the pass of the last stress is made."""
        if step.is_last and not self.said and (weakness := self.stepper.remodeling.weakness()) > WEAK:
            self.find(
                step,
                f"the loads are weak: a tension of {weakness:.2g} times the largest stress of the body counts by half, "
                "for smaller ones may be rounding; cells turned too slowly. Choose a unit or loads with larger strains",
            )


class ShapeWarning(WarnsOnce):
    """What a shape knows of the directions of chains."""

    def __init__(self, stepper: Stepper, shape: Shape):
        super().__init__(stepper)
        self.shape = shape

    @classmethod
    def of(cls, scene: Scene, stepper: Stepper) -> ShapeWarning | None:
        return cls(stepper, scene.geometry)


class RadialChains(ShapeWarning):
    """Says once that more than half of the chains point out of the wall."""

    name, level = "radial_chains", NOTICE

    def look(self, step: Step) -> str:
        """Measure their share."""
        cells = self.state.cells
        share = self.quadrature.mean(
            self.shape.radial_share(cells.dimension_values, cells.axis_values, cells.local_axes.axes)
        )
        if not share > RADIAL_SHARE:
            return ""
        return (
            f"more than half of the chains point out of the wall (radial_share {share:.2g}); the fibre angles are "
            "means over the other chains"
        )


class FrontsInLayers(ShapeWarning):
    """Warns at the end where a layer's mean fibre angle is one of two families, with a front between them."""

    name = "fronts"

    def due(self, step: Step) -> bool:
        return step.is_last

    def look(self, step: Step) -> str:
        """At the last state."""
        cells, quadrature = self.state.cells, self.quadrature
        if not self.shape.angle_layers:
            return ""
        depths = cells.local_axes.nodal_depth[geometry_dofmap(quadrature.mesh)]
        angles = self.shape.fibre_angle(cells.dimension_values, cells.axis_values, cells.local_axes.axes)
        known, found = ~np.isnan(angles), []
        least = np.where(known, angles, np.inf).min(axis=1)
        most = np.where(known, angles, -np.inf).max(axis=1)
        has_front = most - least > FRONT_ANGLE
        jump = "is a mean over elements in which the angle jumps from"
        for name, depth in self.shape.angle_layers.items():
            layer = (depths.min(axis=1) <= depth + 1e-6) & (depths.max(axis=1) >= depth - 1e-6)
            share = quadrature.mean_of_known(np.repeat(has_front[:, None] * 1.0, quadrature.shape[1], axis=1), layer)
            if share > FRONT_SHARE:
                inside = (layer & has_front)[:, None]
                low = quadrature.minimum(np.where(inside, least[:, None], np.inf))
                high = quadrature.maximum(np.where(inside, most[:, None], -np.inf))
                found.append(f"{name} {jump} {low:.3g} to {high:.3g} degrees")
        if not found:
            return ""
        return f"{'; '.join(found)}. A front lies there, so the mean depends on the mesh; set a larger mesh.refinement"
