"""Evolution laws: what the unit cells become while a drive acts on them. Pure functions on arrays.

A law is `update(cells, drive, time_old, time_new) -> cells` with cells of shape (n, 3) and (n, 3, 3). The paper's laws
(eq. 11, eq. 10 over a step, and a form of it without the time) change the dimensions towards a target while the axes
turn at once: `ranked` makes a law of such a function. `rotation` is the older law that the paper argues against: the
axes turn gradually and the dimensions stay. `tensor` is consistent: one equation for A (`tensor_law`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model import spectral, tensor_law
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.chains import NO_PARAMETERS, NO_VALUES, Formula, Parameter, UflOrArray
from remodel_fenicsx.model.drivers import Driver, Frame, carried_axes
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.tensor_law import Target

Array = NDArray[np.float64]
Tension = Callable[[UflOrArray], UflOrArray]
RankedFunction = Callable[[Array, Array, Array, Array | float, float, float], Array]
Weights = Sequence[float]

COMPLEX_STEP = 1e-30  # its square vanishes beside 1: derivatives are exact to rounding


class PrincipalKernels(Protocol):
    """What computes principal directions: `spectral` itself, or its functions in C."""

    @property
    def principal(self) -> spectral.Pairing: ...

    @property
    def positive_direction(self) -> Formula[tuple[Array, NDArray[np.bool_]]]: ...


class Drive(NamedTuple):
    """What acts on the cells of n points during a step.

    Attributes
    ----------
    deformation_gradient
        F, (n, 3, 3).
    tensor
        The driving tensor, symmetric, (n, 3, 3).
    driver, frame
        Where the tensor's eigenvectors live, and what becomes of them.
    noise
        Principal values up to this size are zero, in the unit of the tensor; (n,) or a number.
    initial_dimensions
        l0_I by rank, (n, 3), in link lengths.
    end_to_end_length
        r0, in link lengths; (n,) or a number.
    kappa
        Speed of remodeling, in 1/time; (n,) or a number.
    pairing
        Of `spectral.PAIRINGS`: principal values and axes, in the order in which they belong to the cell's dimensions.
    rotation_time
        Time in which the law `rotation` turns a small angle to 1/e of it.
    kernels
        Whose `principal` and `positive_direction` are called: those of `spectral`, or of C (`kernels`).
    rounding
        The part of the noise that is the rounding of a stress, in its unit; (n,) or a number.
    exponent, least_tension
        Of `tensor_law.target` and `tensor_law.awake`.
    parameters
        Values of the law's own (`Law.parameters`) by their names.

    Examples
    --------
    One cell under tension along z makes one step of the paper's law:

    >>> import numpy as np
    >>> from remodel_fenicsx.extend import DRIVERS, FRAMES, LAWS, Drive, UnitCell
    >>> cells = UnitCell(np.full((1, 3), 3**-0.5), np.eye(3)[None])
    >>> stress = np.diag([0.0, 0.0, 2.0])[None]
    >>> drive = Drive(np.eye(3)[None], stress, DRIVERS["cauchy"], FRAMES["spatial"], noise=1e-9,
    ...               initial_dimensions=cells.dimensions, end_to_end_length=1.0, kappa=0.1)
    >>> after = LAWS["explicit"].update(cells, drive, 0.0, 1.0)
    >>> after.dimensions.round(4)  # by rank of the principal values, in link lengths
    array([[0.6176, 0.5224, 0.5224]])
    """

    deformation_gradient: Array
    tensor: Array
    driver: Driver
    frame: Frame
    noise: Array | float
    initial_dimensions: Array
    end_to_end_length: Array | float
    kappa: Array | float
    pairing: spectral.Pairing = spectral.principal
    rotation_time: float = 40.0
    kernels: PrincipalKernels = spectral
    rounding: Array | float = 0.0
    exponent: float = 2.0
    least_tension: float = 0.0
    parameters: Mapping[str, float] = NO_VALUES

    @property
    def kappas(self) -> Array | float:
        """kappa beside arrays (n, 3)."""
        return np.reshape(self.kappa, (-1, 1)) if np.ndim(self.kappa) else self.kappa

    @property
    def floor(self) -> Array | float:
        """Tension below which a principal value counts as none, (n,) or a number, in the unit of the tensor."""
        return tensor_law.floor_above(self.noise, self.rounding)


def relaxed(old: UnitCell, new: UnitCell, factor: Array | float) -> UnitCell:
    """The cells that a pass has reached with a share of its change: A = A_old + factor (A_new - A_old).

    A = sum_I l_I^2 n_I (x) n_I; the dimensions are the roots of its eigenvalues, the axes its eigenvectors, in the
    order of the new axes that they continue. Where eigenvalues agree, the new axes decide. Arrays of n points; the
    factor is (n,) or a number, which at 1 gives the new cells as they are.
    """
    if np.ndim(factor) == 0 and factor == 1.0:
        return new
    before, after = structure_tensor(*old[:2]), structure_tensor(*new[:2])
    squared, axes = spectral.continued(before + np.reshape(factor, (-1, 1, 1)) * (after - before), new.axes)
    return UnitCell(np.sqrt(np.maximum(squared, 0.0)), axes)


@dataclass(frozen=True)
class Law:
    """An evolution law.

    Attributes
    ----------
    update
        New cells from (cells, drive, time_old, time_new).
    has_limit
        Whether the cells tend to a limit under a constant drive that does not depend on the way there.
    remodels
        False where cells never change: then there is no pass at all.
    of_absolute_time
        Whether a pass makes up for what the ones before have left out. The cells of other laws change by steps: those
        that make a share of each are slower.
    target, follow
        Of laws whose cells tend to a tensor: ``target(drive)`` and ``follow(cells, target, r0, kappa dt)``, of which
        `update` is made; r0 and kappa dt are (n,) or numbers. A scheme of second order needs them apart.
    is_ranked
        Whether dimensions follow the rank of principal values (`ranked`).
    keeps_symmetry
        Whether planes of symmetry of cells and drive stay such: False where the law turns an axis to one of two sides.
    asks_kappa
        Whether kappa = 0 means that cells never change, so that there is no pass at all.
    share
        Cells that have made a share of a change, from (old, new, factor); `relaxed` where the law has none of its own.
    over_corrects
        Whether the coupling "staggered" may leave a symmetric solution with it.
    takes_set_points
        Whether `target` takes the exponent and the threshold of a drive, and goes with turnover.
    parameters
        Numbers of its own, keys of `[remodeling]`: `speed` takes them by their names, and the drive has them.
    speed
        The kappa that acts, from (kappa of the scene, temperature in K), where it is another.
    Examples
    --------
    Collagen that is lost, whatever acts on it (`ranked` makes laws of the paper's kind):

    >>> import numpy as np
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import LAWS, Law, UnitCell
    >>> def lost(cells, drive, time_old, time_new):
    ...     return UnitCell(cells.dimensions * np.exp(-drive.kappas * (time_new - time_old)), cells.axes)
    >>> LAWS["lost"] = Law(lost)
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"remodeling.law": "lost", "time.end": 2.0})
    >>> simulation = Simulation(scene)
    >>> for step in simulation.steps():
    ...     pass
    >>> (simulation.cells.dimension_values / simulation.cells.initial_dimensions)[0, 0].round(4)
    array([0.9512, 0.9512, 0.9512])
    >>> del LAWS["lost"]
    """

    update: Callable[[UnitCell, Drive, float, float], UnitCell]
    has_limit: bool = False
    remodels: bool = True
    of_absolute_time: bool = False
    target: Callable[[Drive], tensor_law.Target] | None = None
    follow: Callable[[UnitCell, tensor_law.Target, Array | float, Array | float], UnitCell] | None = None
    share: Callable[[UnitCell, UnitCell, float], UnitCell] = relaxed
    is_ranked: bool = False
    keeps_symmetry: bool = False
    asks_kappa: bool = False
    over_corrects: bool = False
    takes_set_points: bool = False
    parameters: Mapping[str, Parameter] = field(default=NO_PARAMETERS, compare=False)
    speed: Formula[float] | None = None


def ranked(function: RankedFunction, has_limit: bool = False, of_absolute_time: bool = False) -> Law:
    """A law of the paper's kind (eqs. 8 to 11): axes at the drive's principal directions, dimensions by rank.

    Parameters
    ----------
    function
        ``function(l, l0, target, kappa, time_old, time_new) -> l_new`` with l and l0 (n, 3) by rank (column 0: largest
        principal value; with the pairing "continuous" by axis instead), target = r0 e, ``e = lambda^+ / |lambda^+|``,
        kappa a number, or (n, 1) where regions differ. Points without a positive value, or kappa, keep their cells.
    has_limit, of_absolute_time
        As in `Law`.
    Returns
    -------
    Law
        For `LAWS`.

    Examples
    --------
    Relaxation by Euler's explicit method:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import LAWS, ranked
    >>> def euler(l, l0, target, kappa, time_old, time_new):
    ...     return l + kappa * (time_new - time_old) * (target - l)
    >>> LAWS["euler"] = ranked(euler, has_limit=True)
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"remodeling.law": "euler", "time.end": 3.0})
    >>> [round(step.row["mean_fibre_angle"], 3) for step in Simulation(scene).steps()]
    [54.736, 53.554, 52.378]
    >>> del LAWS["euler"]
    """

    def update(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
        return by_rank(function, cells, drive, time_old, time_new)

    return Law(
        update,
        has_limit,
        of_absolute_time=of_absolute_time,
        keeps_symmetry=True,
        asks_kappa=True,
        is_ranked=True,
    )


def by_rank(function: RankedFunction, cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
    """Axes at the principal directions (eqs. 8 and 9), dimensions towards r0 e (eqs. 10 and 11)."""
    values, axes = principal_directions(drive, cells.axes, drive.pairing)
    direction, active = drive.kernels.positive_direction(values, threshold=drive.noise)
    target = np.reshape(drive.end_to_end_length, (-1, 1)) * direction
    if np.ndim(drive.kappa):
        active = active & (np.asarray(drive.kappa) > 0.0)
    dimensions = function(cells.dimensions, drive.initial_dimensions, target, drive.kappas, time_old, time_new)
    new = UnitCell(dimensions, framed(drive, axes, None if drive.pairing is spectral.principal else dimensions))
    if not active.all():
        new = UnitCell(
            np.where(active[:, None], new.dimensions, cells.dimensions),
            np.where(active[:, None, None], new.axes, cells.axes),
        )
    return new


def principal_directions(drive: Drive, previous: Array, pairing: spectral.Pairing) -> tuple[Array, Array]:
    """Principal values and directions of the drive, in the space in which it lives; `previous`: the cells' axes."""
    if not drive.driver.material and drive.frame.carries_axes:
        previous = carried_axes(drive.deformation_gradient, previous)
    function: spectral.Pairing = drive.kernels.principal if pairing is spectral.principal else pairing
    return function(drive.tensor, previous, threshold=drive.noise)


def framed(drive: Drive, axes: Array, dimensions: Array | None = None) -> Array:
    """Axes of the cells from the drive's principal directions, by rank or in an order of their own."""
    # A frame may treat its axes in their order (the material one takes the first as it is). By rank it is the largest
    # principal value that comes first. With `dimensions` it is the largest dimension: where two of them change their
    # order they are equal, so that A does not depend on which is first, and does not jump.
    if drive.driver.material:
        return axes
    if dimensions is None:
        return drive.frame.axes(drive.deformation_gradient, axes)
    order = np.argsort(-dimensions, axis=1, kind="stable")[:, :, None]
    framed = drive.frame.axes(drive.deformation_gradient, np.take_along_axis(axes, order, axis=1))
    return np.take_along_axis(framed, np.argsort(order, axis=1), axis=1)


def explicit(l: Array, l0: Array, target: Array, kappa: Array | float, time_old: float, time_new: float) -> Array:
    """Eq. (11): l = l0 + (r0 e - l0)(1 - exp(-kappa t)), a function of the absolute time and the present target."""
    return l0 - (target - l0) * np.expm1(-kappa * time_new)


def rate(l: Array, l0: Array, target: Array, kappa: Array | float, time_old: float, time_new: float) -> Array:
    """Eq. (10): dl/dt = kappa (r0 e - l0) exp(-kappa t), integrated exactly over the step with e frozen."""
    return l - (target - l0) * np.exp(-kappa * time_old) * np.expm1(-kappa * (time_new - time_old))


def relaxation(l: Array, l0: Array, target: Array, kappa: Array | float, time_old: float, time_new: float) -> Array:
    """Autonomous form dl/dt = kappa (r0 e - l), integrated exactly over the step with e frozen."""
    return l - (target - l) * np.expm1(-kappa * (time_new - time_old))


def rotation(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
    """Remark 5: the fibre turns gradually towards the largest tension, the other axes turn along, dimensions stay."""
    # n <- exp(dt [omega]) n with omega = n_new x n_max / tau (tau: `Drive.rotation_time`, n_new: at the end of the
    # step). The fibre n is the axis of the largest dimension (the first of equal ones). n_max is the principal
    # direction of the largest value, a line: of its two senses the one nearer to n. Where n is orthogonal to it within
    # `spectral.DECISIVE`, both are as near, and the one nearer to the next of the cell's axes is taken. Where the
    # largest values agree, n_max is the direction of their plane that is nearest to n. Points without tension keep
    # their cells.
    order = (np.argmax(cells.dimensions, axis=1)[:, None] + np.arange(3)) % 3
    axes = np.take_along_axis(cells.axes, order[:, :, None], axis=1)
    values, towards = principal_directions(drive, axes, spectral.principal)
    _, active = spectral.positive_direction(values, threshold=drive.noise)
    largest = spectral.with_signs_of(axes, framed(drive, towards))[:, 0]
    vectors = _turn_towards(axes[:, 0], largest, (time_new - time_old) / drive.rotation_time)
    return UnitCell(cells.dimensions, turned(cells.axes, np.where(active[:, None], vectors, 0.0)))


def _turn_towards(fibre: Array, goal: Array, relative_step: float) -> Array:
    """Rotation vectors dt omega (n, 3) of Remark 5's implicit step, |dt omega| = dt/tau sin(angle at its end)."""
    across = np.cross(fibre, goal)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.einsum("na,na->n", fibre, goal))
    turn = angle - angle_left(angle, relative_step)
    return across * np.divide(turn, sine, out=np.zeros_like(sine), where=sine > 0.0)[:, None]  # 0: parallel


def angle_left(angle: Array, relative_step: float) -> Array:
    """The root a of a + (dt/tau) sin a = angle: what an implicit step leaves of angles (n,) in [0, pi/2], radians."""
    # Newton's method from angle / (1 + dt/tau), which is below the root: the left side is increasing and concave, so
    # each iterate comes nearer from below.
    left = np.asarray(angle / (1.0 + relative_step), dtype=np.float64)
    for _ in range(50):
        missing = angle - left - relative_step * np.sin(left)
        correction = missing / (1.0 + relative_step * np.cos(left))
        left = np.asarray(left + correction, dtype=np.float64)
        if np.all(correction <= 1e-15 * angle):
            return left
    raise FloatingPointError(f"no angle is left by a rotation with a step of {relative_step:g} rotation times")


def turned(axes: Array, vectors: Array) -> Array:
    """Axes (n, 3, 3), rows, after rotations by vectors (n, 3): axis times angle in radians (Rodrigues' formula)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    # sin(a)/a and (1 - cos a)/a^2, both without cancellation; np.sinc(x) is sin(pi x)/(pi x)
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    along = np.broadcast_to(vectors[:, None], axes.shape)
    once = np.cross(along, axes)
    return axes + first * once + second * np.cross(along, once)


def turned_in_part(old: UnitCell, new: UnitCell, factor: float) -> UnitCell:
    """The old cells after a share of the rotation, of less than 180 degrees, that leads to the axes of the new ones."""
    if factor == 1.0:
        return new
    across = 0.5 * np.cross(old.axes, new.axes).sum(axis=1)  # sin(angle) times the axis
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.einsum("nia,nia->n", old.axes, new.axes) - 1.0))
    part = factor * np.divide(angle, sine, out=np.zeros_like(sine), where=sine > 0.0)
    return UnitCell(new.dimensions, turned(old.axes, part[:, None] * across))


def keep(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
    """The same cells."""
    return cells


def tensor_target(drive: Drive) -> tensor_law.Target:
    """What the structure tensor tends to (`tensor_law.target`, `tensor_law.awake`)."""
    found = tensor_law.target(material_tensor(drive), drive.floor, drive.exponent)
    if not drive.least_tension:
        return found
    return found._replace(switch=found.switch * tensor_law.awake(drive.tensor, drive.least_tension))


def follow_tensor(
    cells: UnitCell, target: tensor_law.Target, end_to_end_length: Array | float, kappa_dt: Array | float
) -> UnitCell:
    """Cells whose structure tensor is `tensor_law.follow`; where its eigenvalues agree, the axes stay."""
    # Lengths are NaN where the target, extrapolated, makes the tensor indefinite by more than rounding.
    structure = tensor_law.follow(structure_tensor(*cells[:2]), target, end_to_end_length, kappa_dt)
    squared, axes = spectral.continued(structure, cells.axes)
    rounding = spectral.ROUNDING * np.abs(squared).max(axis=-1, keepdims=True)
    return UnitCell(np.where(squared < -rounding, np.nan, np.sqrt(np.maximum(squared, 0.0))), axes)


def tensor(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
    """dA/dt = kappa s (r0^2 E - A) with E and s frozen over the step (docs/theory.md, "The consistent variant")."""
    return follow_tensor(cells, tensor_target(drive), drive.end_to_end_length, drive.kappa * (time_new - time_old))


LAWS: dict[str, Law] = {
    "explicit": ranked(explicit, has_limit=True, of_absolute_time=True),
    "rate": replace(ranked(rate), over_corrects=True),
    "relaxation": ranked(relaxation, has_limit=True),
    "tensor": Law(
        tensor,
        has_limit=True,
        target=tensor_target,
        follow=follow_tensor,
        keeps_symmetry=True,
        asks_kappa=True,
        takes_set_points=True,
    ),
    "rotation": Law(rotation, share=turned_in_part),
    "none": Law(keep, remodels=False, keeps_symmetry=True),
}


# ---------------------------------------------------------------- means over load cases
# What cells follow that are in several states by turns. Pure functions on arrays.
# With weights w_i, the shares of time, and the states' F_i = R_i U_i: D = sum_i w_i R_i^T sigma_i R_i, which takes
# each driving tensor to material space. Remodeling takes days and a cycle a second, so that cells see the mean of
# many cycles.


def material_tensor(drive: Drive) -> Array:
    """The driving tensor in material space, (n, 3, 3)."""
    if drive.driver.material:
        return drive.tensor
    return drive.frame.tensor(drive.deformation_gradient, drive.tensor)


def mean_tensor(drives: Sequence[Drive], weights: Weights) -> Drive:
    """The first state's drive with the weighted mean of all driving tensors, and of what may be an error in them."""
    tensor = _weighted([material_tensor(drive) for drive in drives], weights)
    return _with(
        drives[0],
        tensor,
        _weighted([drive.noise for drive in drives], weights),
        _weighted([drive.rounding for drive in drives], weights),
    )


def largest_tension(drives: Sequence[Drive], weights: Weights) -> Drive:
    """At each point the driving tensor of the state whose largest principal value is the largest one."""
    tensors = np.array([material_tensor(drive) for drive in drives])
    chosen = np.linalg.eigvalsh(tensors)[..., -1].argmax(axis=0)
    shape, points = tensors.shape[:2], np.arange(tensors.shape[1])
    noise, rounding = (
        np.array([np.broadcast_to(getattr(drive, name), shape[1]) for drive in drives])[chosen, points]
        for name in ("noise", "rounding")
    )
    return _with(drives[0], tensors[chosen, points], noise, rounding)


def mean_target(targets: Sequence[Target], weights: Weights) -> Target:
    """The weighted mean of sE: what acts on A is linear in it (`Target.towards`)."""
    pulled = _weighted([target.switch[:, None, None] * target.direction for target in targets], weights)
    switch = np.einsum("nii->n", pulled)
    return Target(pulled / np.where(switch > 0.0, switch, 1.0)[:, None, None], switch)


def _with(drive: Drive, tensor: Array, noise: Array | float, rounding: Array | float) -> Drive:
    driver = replace(drive.driver, material=True)  # the tensor is in material space already
    return drive._replace(tensor=tensor, driver=driver, noise=noise, rounding=rounding)


def _weighted(values: Sequence[Array | float], weights: Weights) -> Array:
    return np.asarray(sum(weight * value for weight, value in zip(weights, values, strict=True)))


@dataclass(frozen=True)
class Mean:
    """What becomes of several drives."""

    meaning: str
    drive: Callable[[Sequence[Drive], Weights], Drive] = mean_tensor
    of_targets: bool = False


MEANS_OF_CASES: dict[str, Mean] = {
    "tensor": Mean("the weighted mean of the driving tensors"),
    "target": Mean("the weighted mean of the targets that each case has, for the law 'tensor'", of_targets=True),
    "largest": Mean("at each point the load case with the largest tension, whatever its weight", largest_tension),
}
"""By the name that `remodeling.mean` has."""


# ---------------------------------------------------------------- turnover
# Collagen is removed in time and deposited under a stretch. m is the amount of the chains and rho their natural
# length, each over that at the start; lambda_e = r/(rho r0), and lambda_h is the stretch of deposition. The rates
# `cauchy` are those of Cyron, Aydin and Humphrey (2016): with S(lambda) = g(lambda r0) lambda^2, proportional to the
# Cauchy stress of a chain, s = S(lambda_e)/S(lambda_h), a = d ln S / d ln lambda and p = max(1 + k (s - 1), 0), the
# production over the removal,
#     dm/dt / m = (p - 1)/T,    drho/dt / rho = p (1 - 1/s)/(a T).
# The rates `tension` are those of version 0.3.0: with tau(lambda) = g(lambda r0) lambda, proportional to its force,
#     dm/dt / m = k/T (tau(lambda_e)/tau(lambda_h) - 1), limited to k/T,
#     drho/dt / rho = (1/T + (dm/dt / m)^+) (lambda_e/lambda_h - 1).


class TurnoverRates(NamedTuple):
    """Of content and natural length: d ln m / dt and d ln rho / dt, 1/time, (n,)."""

    content: Array
    natural_length: Array


class Followed(NamedTuple):
    """What amount and natural length follow: their rates, and the power of lambda beside g in it."""

    rates: Callable[[TurnoverRule, Tension, Array], TurnoverRates]
    power: int


class TurnoverRule(NamedTuple):
    """How collagen is turned over: T, lambda_h, k, and one of `TURNOVER_RATES`."""

    time: float
    deposition_stretch: float
    gain: float
    followed: Followed

    def rates(self, tissue: Tissue, stretch: Array) -> TurnoverRates:
        """Where chains have a stretch lambda_e (n,)."""
        chain, r0, contour = tissue.chain, tissue.end_to_end_length, tissue.contour_length
        assert chain is not None
        return self.followed.rates(self, lambda some: chain.stiffness(some * r0, contour) * some, stretch)

    def at_length(self, tissue: Tissue, length: Array) -> TurnoverRates:
        """Where chains have a length."""
        return self.rates(tissue, tissue.relative(length) / tissue.end_to_end_length)

    def rest(self, tissue: Tissue) -> tuple[float, float]:
        """k a, which must be above 2 for a wall to come to rest, and the time in which it does so by a factor of e."""
        # The time of a small change near rest: E T/(k a - 2), E = d ln(g - g0/lambda^2)/d ln lambda at lambda_h, where
        # chains and repulsion act together. Of a tissue of numbers.
        deposited = self.deposition_stretch * (1.0 + 1j * COMPLEX_STEP)
        chain, r0, contour = tissue.chain, tissue.end_to_end_length, tissue.contour_length
        assert chain is not None
        secant = chain.stiffness(deposited * r0, contour)
        both = secant - chain.stiffness(r0, contour) / deposited**2
        what = secant * deposited**self.followed.power
        steep, stiff = (float(np.log(some).imag) / COMPLEX_STEP for some in (what, both))
        return self.gain * steep, stiff * self.time / (self.gain * steep - 2)


def by_stress(rule: TurnoverRule, tension: Tension, stretch: Array) -> TurnoverRates:
    """Rates `cauchy`."""

    def steepness(some: Array) -> Array:
        return 1.0 + np.log(tension(some * (1.0 + 1j * COMPLEX_STEP))).imag / COMPLEX_STEP

    steep = steepness(stretch)
    relative = tension(stretch) * stretch / (tension(rule.deposition_stretch) * rule.deposition_stretch)
    produced = 1.0 + rule.gain * (relative - 1.0)
    produced = np.maximum(produced, 0.0)
    return TurnoverRates((produced - 1.0) / rule.time, produced * (1.0 - 1.0 / relative) / (steep * rule.time))


def by_tension(rule: TurnoverRule, tension: Tension, stretch: Array) -> TurnoverRates:
    """Rates `tension`."""
    relative = tension(stretch) / tension(rule.deposition_stretch) - 1.0
    content = rule.gain / rule.time * np.clip(relative, -1.0, 1.0)
    turned_over = 1.0 / rule.time + np.maximum(content, 0.0)
    return TurnoverRates(content, turned_over * (stretch / rule.deposition_stretch - 1.0))


TURNOVER_RATES = {"cauchy": Followed(by_stress, 2), "tension": Followed(by_tension, 1)}
"""By the name that `remodeling.turnover.rates` has."""
