"""Warnings of a run: locking, pressure noise, lost volume, weak tension, radial chains, fronts."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NamedTuple

import dolfinx.fem
import numpy as np

from remodel_fenicsx.body.shape import Shape
from remodel_fenicsx.evolution.stepper import Step, Stepper, WarnsOnce
from remodel_fenicsx.fem.compat import geometry_dofmap
from remodel_fenicsx.fem.formulations import FORMULATIONS, NOT_LOCKING, STIFF_BULK
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.system import NOTICE

if TYPE_CHECKING:
    from remodel_fenicsx.scene.scene import Scene


# ---------------------------------------------------------------- spurious stiffness
# Elements are too stiff if nearly incompressible tissue makes them lock, or if the strain varies
# too much inside them.

# Missing fraction of the displacement above which a run warns. docs/reliability.md has the
# estimate and its error. The paper's bodies have at most 3.6 % (artery with random cells, t = 5).
MAX_MISSING_FRACTION = 0.05
# Work / energy of the matrix. With less work the cells deform the body, not the loads.
# Elastic tubes have at least 0.93 (up to 0.9 of the pressure that bursts them), the paper's bodies
# 1.4.
DRIVEN = 0.9
# Factor on jumps between linear elements. At a wall, where strain varies most, an element has
# neighbours on one side only, and half of the jump.
JUMPS = 4.0
# Missing fraction of the motion across an elongated body / fraction of volume changes in the
# matrix's energy. By the tangent it is 1.6 to 3.3 (tubes, elongation 0.1, lambda/mu 8.8 to
# 250).
HELD_BACK = 2.5
MAX_NOISE_ROTATION_DEGREES = 2.0
"""Angle in degrees between principal tensions with and without pressure noise, above which a run
warns. Of 150 random tubes with lambda/mu from 50 to 10,000 (benchmarks/fuzz.py) 108 had errors of 1
degree in angles or 0.5 % in radii. All of these had 2.4 degrees or more; 5 of the remaining tubes
had more than 2. Bodies as soft as the paper's, which have up to 3.1 degrees, are as accurate as
their mesh."""
REMEDY = f"set mesh.element = 'hexahedron' and mesh.formulation = {NOT_LOCKING!r}"


def remedy(scene: Scene) -> str:
    """Return a remedy for locking elements as text, with the scene's keys."""
    if needs := scene.displacement_reason():
        return (
            "set mesh.degree = 2 or a larger mesh.refinement, "
            f"because {needs} needs mesh.formulation = 'displacement'"
        )
    return REMEDY


class MissingDeformation(NamedTuple):
    """Missing fraction of the deformation, by changes of volume and of shape inside elements."""

    volume: float
    shape: float


class ElementWarning(WarnsOnce):
    """Warning of elements, with lambda and mu at this rank's own points."""

    def __init__(self, stepper: Stepper, remedy: str = REMEDY):
        super().__init__(stepper)
        tissue, shape = self.state.parameters(stepper.tissue).at_points(), self.quadrature.shape
        self.stiffnesses = [
            self.quadrature.owned(v.reshape(shape)) for v in (tissue.lame_lambda, tissue.lame_mu)
        ]
        self.ratio, self.remedy = (
            self.quadrature.maximum(self.stiffnesses[0] / self.stiffnesses[1]),
            remedy,
        )


class LockingWarning(ElementWarning):
    """Warning that elements lock or are too large for the strain."""

    name = "locking"

    def __init__(self, stepper: Stepper, locks: bool, remedy: str = REMEDY):
        super().__init__(stepper, remedy)
        self.locks = locks

    @classmethod
    def for_scene(cls, scene: Scene, stepper: Stepper) -> LockingWarning | None:
        if stepper.state.kinematics.homogeneous:  # uniform strain has no spurious stiffness
            return None
        return cls(stepper, FORMULATIONS[scene.mesh.formulation].locks, remedy(scene))

    def missing_deformation(self) -> MissingDeformation:
        """Return the missing deformation; zero if only the cells deform the body. Collective."""
        energy, volume, shape = self.energies()
        work, free_work = self.work()
        driven = (
            MissingDeformation(volume / work, shape / work)
            if work > DRIVEN * energy > 0
            else MissingDeformation(0.0, 0.0)
        )
        if not max(free_work, 0.0) + self._energy_of_elongation() > DRIVEN * energy > 0:
            return driven
        # The work of a prescribed elongation hides that of the motion across, which is
        # underestimated.
        across = min(HELD_BACK * volume / energy, volume / free_work if free_work > 0 else np.inf)
        return max(driven, MissingDeformation(across, 0.0), key=sum)

    def _energy_of_elongation(self) -> float:
        """Return the energy 3/2 mu e^2 of a prescribed isochoric elongation. Collective."""
        loads = self.state.loading.values
        elongation = loads.get("elongation", 0.0)
        return (
            self.quadrature.integral(1.5 * self.stiffnesses[1] * elongation**2)
            if elongation
            else 0.0
        )

    def energies(self) -> tuple[float, float, float]:
        """Return energies: with mean J per element, of varying J, twice varying F. Collective."""
        quadrature, (stiffness, shear) = self.quadrature, self.stiffnesses
        equilibrium = self.stepper.coupling.equilibrium
        look = equilibrium.evaluate()
        logarithm, F = np.log(look.jacobians), look.gradients.reshape(*stiffness.shape, 9)
        inside = quadrature.polynomial_residual(0, logarithm[..., None])[..., 0]
        matrix = stiffness * (logarithm - inside) ** 2 + shear * (
            np.square(F).sum(axis=-1) - 3 - 2 * logarithm
        )
        volume = stiffness * np.square(inside) * self.locks
        shape = (
            2
            * shear
            * np.square(quadrature.polynomial_residual(quadrature.element_degree - 1, F)).sum(
                axis=-1
            )
        )
        shape *= self._followed(shape, F)[:, None]
        weights = quadrature.owned(quadrature.volumes) / 2
        local = np.array([float((part * weights).sum()) for part in (matrix, volume, shape)])
        first, second, third = self.state.comm.allreduce(local).tolist()
        return first, second, third

    def _followed(self, shape: Array, F: Array) -> Array:
        """Return the fraction of `shape` that counts as missing, (owned elements,). Collective."""
        # The strain of a twisted bar varies inside its elements, which represent it exactly. Strain
        # that elements of degree 1 cannot represent jumps between them by as much as it varies.
        # Elements of degree 2 have equal errors where they meet, and represent a linear strain.
        quadrature = self.quadrature
        if quadrature.element_degree > 1 or quadrature.shape[1] == 1:
            return np.ones(len(F))
        weights = quadrature.owned(quadrature.volumes)
        shear = (self.stiffnesses[1] * weights).sum(axis=1) / weights.sum(axis=1)
        inside = (shape * weights).sum(axis=1) / weights.sum(axis=1)
        jumps = JUMPS * 2 * shear * quadrature.jumps(F)
        return np.minimum(1.0, jumps / np.maximum(inside, np.finfo(float).tiny))

    def work(self) -> tuple[float, float]:
        """Return the linearised work of loads and supports, and of loads alone. Collective."""
        # The work is half of the internal nodal forces times the unknowns; for loads alone, times
        # the free unknowns.
        state, equilibrium = self.stepper.state, self.stepper.coupling.equilibrium
        unknowns = state.unknown.x.array
        free = np.where(np.isnan(equilibrium.prescribed_values()), unknowns, 0.0)
        # The ranks' contributions to a node's force are not summed, because the sum over all ranks
        # is the same.
        forces = sum(dolfinx.fem.assemble_vector(form).array for form in equilibrium.internal_forms)
        local = np.array([forces @ unknowns, forces @ free])
        whole, of_forces = state.comm.allreduce(local).tolist()
        return whole / 2, of_forces / 2

    def check(self, step: Step) -> str:
        """Return a warning if too much of the deformation is missing. Collective."""
        missing = self.missing_deformation()
        return self.in_words(missing) if sum(missing) > MAX_MISSING_FRACTION else ""

    def in_words(self, missing: MissingDeformation) -> str:
        """Return cause, size and remedy of the missing deformation as text."""
        lacks = f"displacements too small by about {100 * min(sum(missing), 1.0):.2g} %"
        if missing.volume >= missing.shape:
            return (
                f"volumetric locking: {lacks} (lambda/mu up to {self.ratio:.4g}); {self.remedy} "
                "(docs/solver.md, Volumetric locking)"
            )
        return (
            f"elements too large: {lacks}, because strain varies too much inside elements; set "
            "mesh.degree = 2 or a larger mesh.refinement (docs/solver.md, Volumetric locking)"
        )


class PressureNoise(ElementWarning):
    """Warning that pressure noise inside elements reorients the cells."""

    name = "pressure_noise"

    @classmethod
    def for_scene(cls, scene: Scene, stepper: Stepper) -> PressureNoise | None:
        remodeling, locks = stepper.remodeling, FORMULATIONS[scene.mesh.formulation].locks
        turns = (
            remodeling.law.remodels
            and remodeling.driver.is_stress
            and not stepper.state.kinematics.homogeneous
        )
        return cls(stepper, remedy(scene)) if locks and turns else None

    def degrees(self) -> float:
        """Return the mean angle between principal tensions with and without noise. Collective."""
        quadrature, stiffness = self.quadrature, self.stiffnesses[0]
        F, tensor = (
            values[: stiffness.size] for values in self.stepper.remodeling.driving_tensor()
        )
        J = np.linalg.det(F)
        logarithm = np.log(J).reshape(stiffness.shape)
        noise = quadrature.polynomial_residual(
            quadrature.element_degree - 1, (stiffness * logarithm)[..., None]
        ).reshape(-1, 1, 1)
        driver = self.stepper.remodeling.driver
        if driver.material:
            quiet = tensor - noise * np.linalg.inv(F.swapaxes(1, 2) @ F)
        else:
            quiet = tensor - noise / J[:, None, None] * np.eye(3)
        with_noise, without = (
            np.maximum(np.linalg.eigvalsh(stress), 0.0) for stress in (tensor, quiet)
        )
        lengths = np.linalg.norm(with_noise, axis=1) * np.linalg.norm(without, axis=1)
        # The angle is 0 without tension in both, and 90 degrees without tension in one of them.
        cosine = np.where(
            lengths > 0, (with_noise * without).sum(axis=1), (with_noise + without).sum(axis=1) == 0
        )
        turned = np.degrees(
            np.arccos(np.clip(cosine / np.where(lengths > 0, lengths, 1.0), -1.0, 1.0))
        )
        return quadrature.integral(turned.reshape(stiffness.shape)) / quadrature.volume

    def check(self, step: Step) -> str:
        """Return a warning if the mean angle is large. Collective."""
        if (
            self.ratio <= min(STIFF_BULK.values())
            or (turned := self.degrees()) <= MAX_NOISE_ROTATION_DEGREES
        ):
            return ""
        return (
            f"pressure oscillations change the principal tensions by {turned:.2g} degrees on "
            "average; fibre angles and radii are inaccurate "
            f"(lambda/mu up to {self.ratio:.4g}); {self.remedy} "
            "(docs/reliability.md, Spurious reorientation by pressure noise)"
        )


# ---------------------------------------------------------------- tissue
# Lost volume, weak tension, chains out of the wall, and fronts.

# Soft tissues were measured to lose a few per cent of their volume at most; more is due to lambda.
# The paper's tendon and artery, lambda/mu = 8.8, keep J above 0.92 at every point.
REPORTED_VOLUME_LOSS = 0.05  # mean loss of volume that the log reports at the end
MEAN_LOSS, LEAST_JACOBIAN = 0.2, 0.6  # mean loss and smallest J that are probably not intended
# Relative threshold of tensions above which a run warns. In the paper's tube with the law "tensor"
# angles had errors of 0.02 degrees at 0.014, 1.2 at 0.14 and 12 at 1.4.
WARNED_THRESHOLD = 0.05
RADIAL_SHARE = 0.5  # fraction of chains out of the wall above which the log reports it
# Degrees between two points of an element at a front, and the fraction of a layer that such
# elements make up. In the paper's artery angles inside elements differ by up to 14 degrees.
FRONT_ANGLE, FRONT_SHARE = 45.0, 0.5


class VolumeLoss(WarnsOnce):
    """Warning of a large loss of volume, with a report of the largest loss at the end."""

    name = "volume"
    initial = {"mean": 1.0, "mean_time": 0.0, "least": 1.0, "least_time": 0.0} | dict.fromkeys(
        "xyz", 0.0
    )

    def solved(self, step: Step) -> None:
        """Update the largest loss of volume, also after the warning. Collective."""
        self._measure(step)
        numbers = self._numbers
        if not self.is_reported and (
            1 - numbers["mean"] >= MEAN_LOSS or numbers["least"] < LEAST_JACOBIAN
        ):
            self.emit(
                step, f"{self._in_words()}; set a larger material.lame_lambda (docs/commands.md)"
            )
        elif step.is_last and 1 - numbers["mean"] >= REPORTED_VOLUME_LOSS:
            step.findings.append((logging.INFO, self._in_words()))

    def _measure(self, step: Step) -> None:
        numbers, equilibrium = self._numbers, self.stepper.coupling.equilibrium
        jacobians = equilibrium.evaluate().jacobians
        mean = self.quadrature.integral(jacobians) / self.quadrature.volume
        if mean < numbers["mean"]:
            numbers["mean"], numbers["mean_time"] = mean, step.time
        if self.state.dilatation.jacobian is not None:
            of_formulation = self.quadrature.owned(self.state.dilatation.jacobians())
            jacobians = np.broadcast_to(of_formulation.min(axis=1)[:, None], jacobians.shape)
        least = self.quadrature.minimum(jacobians)
        if least < numbers["least"]:
            numbers["least"], numbers["least_time"] = least, step.time
            for name, value in zip("xyz", self.quadrature.argmax_position(-jacobians), strict=True):
                numbers[name] = value

    def _in_words(self) -> str:
        values = {name: self._numbers[name] for name in self.initial}
        return (
            "the tissue has lost up to {lost:.2g} % of its volume at {x:.4g}, {y:.4g}, {z:.4g} "
            "(minimum J {least:.3g}, time {least_time:g}), {whole:.2g} % overall "
            "(mean J {mean:.3g}, time {mean_time:g})"
        ).format(lost=100 * (1 - values["least"]), whole=100 * (1 - values["mean"]), **values)


class WeakTension(WarnsOnce):
    """Warning at the end that stresses were near rounding errors, so that cells were too slow."""

    name = "weak_tension"

    def completed(self, step: Step) -> None:
        """Check the threshold of tensions after the last pass. Collective."""
        if (
            step.is_last
            and not self.is_reported
            and (weakness := self.stepper.remodeling.relative_switch_threshold()) > WARNED_THRESHOLD
        ):
            self.emit(
                step,
                "loads too small: where the stress is near the rounding threshold "
                f"({weakness:.2g} of the largest stress), cells remodel at half speed or less. "
                "Increase the loads",
            )


class ShapeWarning(WarnsOnce):
    """Warning that needs a shape's measures of chain directions."""

    def __init__(self, stepper: Stepper, shape: Shape):
        super().__init__(stepper)
        self.shape = shape

    @classmethod
    def for_scene(cls, scene: Scene, stepper: Stepper) -> ShapeWarning | None:
        return cls(stepper, scene.geometry)


class RadialChains(ShapeWarning):
    """Report that more than half of the chains point out of the wall."""

    name, level = "radial_chains", NOTICE

    def check(self, step: Step) -> str:
        """Return a report if the fraction is large. Collective."""
        cells = self.state.cells
        share = self.quadrature.mean(
            self.shape.radial_share(
                cells.dimension_values, cells.axis_values, cells.local_axes.axes
            )
        )
        if not share > RADIAL_SHARE:
            return ""
        return (
            f"more than half of the chains point out of the wall (radial_share {share:.2g}); "
            "the fibre angles are means over the remaining chains"
        )


class FrontsInLayers(ShapeWarning):
    """Warning at the end that a layer's mean fibre angle is over two families with a front."""

    name = "fronts"

    def due(self, step: Step) -> bool:
        return step.is_last

    def check(self, step: Step) -> str:
        """Return a warning for layers with a front in most elements. Collective."""
        if not self.shape.angle_layers:
            return ""
        cells, quadrature = self.state.cells, self.quadrature
        depths = cells.local_axes.nodal_depth[geometry_dofmap(quadrature.mesh)]
        angles = self.shape.fibre_angle(
            cells.dimension_values, cells.axis_values, cells.local_axes.axes
        )
        known, jumps = ~np.isnan(angles), []
        least = np.where(known, angles, np.inf).min(axis=1)
        most = np.where(known, angles, -np.inf).max(axis=1)
        has_front = most - least > FRONT_ANGLE
        jump = "is a mean over elements in which the angle jumps from"
        for name, depth in self.shape.angle_layers.items():
            layer = (depths.min(axis=1) <= depth + 1e-6) & (depths.max(axis=1) >= depth - 1e-6)
            share = quadrature.nanmean(
                np.repeat(has_front[:, None] * 1.0, quadrature.shape[1], axis=1), layer
            )
            if share > FRONT_SHARE:
                inside = (layer & has_front)[:, None]
                low = quadrature.minimum(np.where(inside, least[:, None], np.inf))
                high = quadrature.maximum(np.where(inside, most[:, None], -np.inf))
                jumps.append(f"{name} {jump} {low:.3g} to {high:.3g} degrees")
        if not jumps:
            return ""
        return (
            f"{'; '.join(jumps)}. A front lies in these elements, so the mean depends on the mesh; "
            "set a larger mesh.refinement"
        )
