"""What a run says of its tissue: volume that is lost, chains that do not lie in the wall, and fronts."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.body.shape import Shape
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.evolution.turnover import MUCH, Slowing
from remodel_fenicsx.fem.compat import geometry_dofmap
from remodel_fenicsx.model.energy import TURNED_OVER
from remodel_fenicsx.state.memory import Occasions
from remodel_fenicsx.system import NOTICE
from remodel_fenicsx.watch.once import WarnsOnce

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

# Of its volume a soft tissue is measured to lose a few per cent at most: what is beyond is a choice of lambda. The
# paper's tendon and artery, lambda/mu = 8.8, keep J above 0.92 at every point.
NOTED = 0.05  # mean loss that the log mentions at the end
MEAN_LOSS, LEAST_JACOBIAN = 0.2, 0.6  # from where on it is hardly meant
LONG = 10.0  # times of turnover, before which rates say little: walls that rest have risen and fall by then
FAR_FROM_REST = 0.01  # change of ln m or ln rho in a time of turnover
WEAK = 0.05  # the paper's tube by the law "tensor": angles were 0.02 degrees off at 0.014, 1.2 at 0.14, 12 at 1.4
RADIAL_SHARE = 0.5  # of the chains: more of them out of the wall are said
# degrees between two points of an element that are a front, not a slope: within its elements the paper's artery turns
# by up to 14 degrees; and the share of a layer that such elements make up
FRONT_ANGLE, FRONT_SHARE = 45.0, 0.5


class VolumeLoss(WarnsOnce):
    """Warns, once, where the tissue loses much of its volume, and says at the end how much it has lost at most.

    Where the formulation takes J at points of its own, J is that: at the others nothing holds it.
    """

    def __init__(self, stepper: Stepper):
        initial = {"mean": 1.0, "mean_time": 0.0, "least": 1.0, "least_time": 0.0}
        super().__init__(stepper, "volume", initial | dict.fromkeys("xyz", 0.0))

    def solved(self, step: Step) -> None:
        """Look at J."""
        numbers, look = self._numbers, self.stepper.coupling.equilibrium.look()
        jacobians = look.states[:, 1].reshape(look.stretches.shape)
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

    def committed(self, step: Step) -> None:
        """Say what there is to say."""
        numbers = self._numbers
        if not self.said and (1 - numbers["mean"] >= MEAN_LOSS or numbers["least"] < LEAST_JACOBIAN):
            self.say(step, f"{self._in_words()}; set a larger material.lame_lambda (docs/commands.md)")
        elif step.is_last and 1 - numbers["mean"] >= NOTED and self.state.comm.rank == 0:
            log.info("%s", self._in_words())

    def _in_words(self) -> str:
        found = {name: self._numbers[name] for name in self._numbers.initial}
        return (
            "the tissue has lost up to {lost:.2g} % of its volume at {x:.4g}, {y:.4g}, {z:.4g} (least J {least:.3g}, "
            "time {least_time:g}), {whole:.2g} % in all (mean J {mean:.3g}, time {mean_time:g})"
        ).format(lost=100 * (1 - found["least"]), whole=100 * (1 - found["mean"]), **found)


class WeakTension(WarnsOnce):
    """Says at the end that stresses were never far above those that count as rounding: cells turned too slowly.

    Parameters
    ----------
    stepper
        Whose passes take the stress.
    """

    def __init__(self, stepper: Stepper):
        super().__init__(stepper, "weak_tension")

    def committed(self, step: Step) -> None:
        """Look at the end."""
        if step.is_last and not self.said and (weakness := self.stepper.remodeling.weakness()) > WEAK:
            self.say(
                step,
                f"the loads are weak: a tension of {weakness:.2g} times the largest stress of the body counts by half, "
                "for smaller ones may be rounding; cells turned too slowly. Choose a unit or loads with larger strains",
            )


class GrowthWithoutRest(WarnsOnce):
    """Warns at the end where turnover goes on, and its rates do not fall as those do that come to rest (`Slowing`).

    Growth without bound is the mechanobiological instability (Latorre and Humphrey 2019). How much the tissue has grown
    tells nothing of that: it is a notice.

    Parameters
    ----------
    stepper
        Whose rates are looked at.
    held_from
        Time from which on no load changes.
    """

    def __init__(self, stepper: Stepper, held_from: float):
        super().__init__(stepper, "growth", {"noticed": 0} | Slowing.INITIAL)
        self.held_from, self._slowing = held_from, Slowing(self._numbers)
        self._text = self._notice = ""

    def solved(self, step: Step) -> None:
        """Look at the rates, and at what they have made."""
        turnover, elapsed = self.stepper.turnover, step.time - self.held_from
        rates, period = turnover.fastest_changes(), turnover.settings.time
        rate, self._text, self._notice = self.quadrature.maximum(rates), "", ""
        change = f"by up to {100 * rate * period:.2g} % in remodeling.turnover.time"
        for name in TURNED_OVER if not self._numbers["noticed"] else ():
            factors = turnover.factors(name)
            if self.quadrature.maximum(factors) > MUCH:
                self._notice = (
                    f"{name.replace('_', ' ')} has changed by more than a factor of {MUCH:g} at "
                    f"{self._place(factors)}; content or natural length now change {change} (docs/turnover.md)"
                )
        goes_on = elapsed > 0 and self._slowing.goes_on(elapsed, rate)
        if not (goes_on and step.is_last and elapsed >= LONG * period and rate * period >= FAR_FROM_REST):
            return
        self._text = (
            f"the tissue has not come to rest: content or natural length change {change}, most at "
            f"{self._place(rates)}, and since time {self.held_from + self._numbers['early_time']:g} the rates have "
            "fallen no faster than 1/t. It goes on without bound (mechanobiological instability, docs/turnover.md), or "
            "rests much later; with a larger remodeling.turnover.gain it rests sooner"
        )

    def _place(self, values: Array) -> str:
        """Where they are largest."""
        return f"({', '.join(f'{c:.4g}' for c in self.quadrature.place_of_largest(values))})"

    def committed(self, step: Step) -> None:
        """Say it."""
        if self._notice:
            said = self.said
            self.say(step, self._notice, NOTICE)
            self._numbers["noticed"], self._numbers["said"] = 1, said
        if self._text and not self.said:
            self.say(step, self._text)


class RadialChains(WarnsOnce):
    """Says once that more than half of the chains point out of the wall: the columns' angles are those of the others.

    A notice and no warning: the results are right, they have to be read otherwise.

    Parameters
    ----------
    stepper
        Whose solved states are looked at.
    radial_share
        Of dimensions, axes and local axes, as `Shape.radial_share`.
    """

    def __init__(self, stepper: Stepper, radial_share: Callable[[Array, Array, Array], Array]):
        super().__init__(stepper, "radial_chains", {"share": 0.0})
        self.radial_share = radial_share
        self._occasions = Occasions(stepper.state, "radial_chains")

    def solved(self, step: Step) -> None:
        """Measure from time to time, until it was said."""
        if not self.said and (self._occasions.due() or step.is_last):
            cells = self.state.cells
            share = self.radial_share(cells.dimension_values, cells.axis_values, cells.local_axes.axes)
            self._numbers["share"] = self.quadrature.mean(share)

    def committed(self, step: Step) -> None:
        """Say it."""
        if not self.said and self._numbers["share"] > RADIAL_SHARE:
            self.say(
                step,
                f"more than half of the chains point out of the wall (radial_share {self._numbers['share']:.2g}); the "
                "fibre angles are means over the other chains",
                NOTICE,
            )


class FrontsInLayers(Watcher):
    """Warns at the end where a layer's mean fibre angle is one of two families, with a front between them.

    Inside of an element a front lies between two points, wherever it would be: the mean over the element moves by steps
    with the mesh. What is no mean over a single layer of elements hardly notices.

    Parameters
    ----------
    stepper
        Whose last state is looked at.
    shape
        With the layers (`Shape.angle_layers`) and the angles.
    """

    def __init__(self, stepper: Stepper, shape: Shape):
        self.state, self.shape, self._found = stepper.state, shape, list[tuple[str, float, float]]()
        nodes = geometry_dofmap(self.state.cells.quadrature.mesh)
        depths = self.state.cells.local_axes.nodal_depth[nodes] if shape.angle_layers else np.zeros(nodes.shape)
        self._layers = {
            name: (depths.min(axis=1) <= share + 1e-6) & (depths.max(axis=1) >= share - 1e-6)
            for name, share in shape.angle_layers.items()
        }

    def solved(self, step: Step) -> None:
        """Look at the last state."""
        self._found = []
        if not step.is_last:
            return
        cells, quadrature = self.state.cells, self.state.cells.quadrature
        angles = self.shape.fibre_angle(cells.dimension_values, cells.axis_values, cells.local_axes.axes)
        known = ~np.isnan(angles)
        least = np.where(known, angles, np.inf).min(axis=1)
        most = np.where(known, angles, -np.inf).max(axis=1)
        has_front = most - least > FRONT_ANGLE
        for name, layer in self._layers.items():
            share = quadrature.mean(np.repeat(has_front[:, None], quadrature.shape[1], axis=1).astype(float), layer)
            if share > FRONT_SHARE:
                inside = (layer & has_front)[:, None]
                low = quadrature.minimum(np.where(inside, least[:, None], np.inf))
                high = quadrature.maximum(np.where(inside, most[:, None], -np.inf))
                self._found.append((name, low, high))

    def committed(self, step: Step) -> None:
        """Say it."""
        for name, low, high in self._found if self.state.comm.rank == 0 else ():
            log.warning(
                "time %g: %s is a mean over elements in which the angle jumps from %.3g to %.3g degrees. A front lies "
                "there, so the mean depends on the mesh; set a larger mesh.refinement",
                step.time,
                name,
                low,
                high,
            )
