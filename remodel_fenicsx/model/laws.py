"""Evolution laws of the unit cells under a drive, means over load cases, and turnover.

Pure functions on arrays. A law is `update(cells, drive, time_old, time_new) -> cells` with cells of
shape (n, 3) and (n, 3, 3). The paper's laws (eq. 11, eq. 10 over a step, and an autonomous form of
eq. 10) move the dimensions towards a target and set the axes directly to the principal directions;
`ranked` turns such a function into a law. `rotation` is the older law that the paper rejects: the
axes rotate gradually and the dimensions stay. `tensor` is consistent: one equation for A
(`tensor_law`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from remodel_fenicsx._renamed import with_old_arguments, with_old_names
from remodel_fenicsx.model import spectral, tensor_law
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.chains import NO_PARAMETERS, NO_VALUES, Formula, Parameter, UflOrArray
from remodel_fenicsx.model.drivers import Driver, Frame, convected_axes
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.tensor_law import Target
from remodel_fenicsx.model.tensors import Array, Flags

Tension = Callable[[UflOrArray], UflOrArray]
RankedFunction = Callable[[Array, Array, Array, Array | float, float, float], Array]
Weights = Sequence[float]

# Its square is negligible against 1, so that derivatives are exact to rounding.
COMPLEX_STEP = 1e-30


class PrincipalKernels(Protocol):
    """Functions that compute principal directions: those of `spectral`, or their versions in C."""

    @property
    def principal(self) -> spectral.Pairing: ...

    @property
    def positive_direction(self) -> Formula[tuple[Array, Flags]]: ...


class Drive(NamedTuple):
    """Drive of the cells at n points during a step.

    Attributes
    ----------
    deformation_gradient
        F, (n, 3, 3).
    tensor
        The driving tensor, symmetric, (n, 3, 3).
    driver, frame
        Driver of the tensor, and the map from its eigenvectors to cell axes.
    noise
        Principal values up to this size count as zero, in the unit of the tensor; (n,) or a number.
    initial_dimensions
        l0_I by rank, (n, 3), in link lengths.
    end_to_end_length
        r0, in link lengths; (n,) or a number.
    kappa
        Rate of remodeling, in 1/time; (n,) or a number.
    pairing
        One of `spectral.PAIRINGS`: returns principal values and axes in the order of the cell's
        dimensions.
    rotation_time
        Time in which the law `rotation` reduces a small angle to 1/e.
    kernels
        Provider of `principal` and `positive_direction`: `spectral`, or the C functions
        (`kernels`).
    rounding
        Contribution of a stress's rounding to the noise, in the unit of the tensor; (n,) or a
        number.
    exponent, least_tension
        Exponent of `tensor_law.target`, and threshold of the activation.
    parameters
        Values of the law's additional parameters (`Law.parameters`) by name.

    Examples
    --------
    One step of the paper's law for a cell under tension along z:

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
        """Rate kappa as a number or (n, 1), to multiply arrays (n, 3)."""
        return np.reshape(self.kappa, (-1, 1)) if np.ndim(self.kappa) else self.kappa

    @property
    def floor(self) -> Array | float:
        """Tension at which the switch is 1/2, (n,) or a number (`tensor_law.switch_threshold`)."""
        return tensor_law.switch_threshold(self.noise, self.rounding)


def relaxed(old: UnitCell, new: UnitCell, factor: Array | float) -> UnitCell:
    """Return cells of the relaxed structure tensor A = A_old + factor (A_new - A_old)."""
    # The dimensions are the square roots of the eigenvalues of A, the axes its eigenvectors, in the
    # order of the new axes that they continue. If eigenvalues agree, the new axes decide. The
    # factor is (n,) or a number; the number 1 returns the new cells unchanged.
    if np.ndim(factor) == 0 and factor == 1.0:
        return new
    before, after = structure_tensor(*old[:2]), structure_tensor(*new[:2])
    return cells_from_structure(
        before + np.reshape(factor, (-1, 1, 1)) * (after - before), new.axes
    )


def cells_from_structure(structure: Array, previous: Array) -> UnitCell:
    """Compute cells from structure tensors, in the order of the previous axes."""
    squared, axes = spectral.principal_by_continuity(structure, previous)
    return UnitCell(np.sqrt(np.maximum(squared, 0.0)), axes)


@with_old_names
@dataclass(frozen=True)
class Law:
    """Evolution law of the unit cells.

    Attributes
    ----------
    update
        Function of (cells, drive, time_old, time_new) that returns the new cells.
    has_limit
        Whether the cells tend to a limit under a constant drive that does not depend on the path.
    remodels
        False if the cells never change; then there is no remodeling pass.
    depends_on_absolute_time
        Whether the law depends on the absolute time, so that a pass makes up for changes that
        earlier passes have omitted. Cells of other laws change by increments: relaxation slows them
        down.
    target, follow
        Functions of laws whose structure tensor tends to a target: ``target(drive)`` and
        ``follow(cells, target, r0, kappa dt)``. `update` combines both; a second-order scheme needs
        them separately. r0 and kappa dt are (n,) or numbers.
    is_ranked
        Whether dimensions follow the order of principal values (`ranked`).
    keeps_symmetry
        Whether the law preserves planes of symmetry of cells and drive. False if it rotates an axis
        to one of two sides.
    stops_at_zero_kappa
        Whether kappa = 0 means that cells never change, so that there is no remodeling pass.
    relax
        Function of (old, new, factor) that returns relaxed cells; default: `relaxed`.
    over_corrects
        Whether the coupling "staggered" may leave a symmetric solution with this law.
    uses_exponent_and_threshold
        Whether `target` uses the exponent and the threshold of the drive, and the law is compatible
        with turnover.
    parameters
        Additional parameters, keys of `[remodeling]`. `speed` takes them by their names, and the
        drive holds them.
    speed
        Function of (kappa of the scene, temperature in K) that returns the effective kappa; None if
        both are equal.

    Examples
    --------
    Collagen that decays under any drive (`ranked` makes laws of the paper's kind):

    >>> import numpy as np
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import LAWS, Law, UnitCell
    >>> def lost(cells, drive, time_old, time_new):
    ...     decay = np.exp(-drive.kappas * (time_new - time_old))
    ...     return UnitCell(cells.dimensions * decay, cells.axes)
    >>> LAWS["lost"] = Law(lost)
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube")
    >>> scene = scene.with_values({"remodeling.law": "lost", "time.end": 2.0})
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
    depends_on_absolute_time: bool = False
    target: Callable[[Drive], tensor_law.Target] | None = None
    follow: (
        Callable[[UnitCell, tensor_law.Target, Array | float, Array | float], UnitCell] | None
    ) = None
    relax: Callable[[UnitCell, UnitCell, float], UnitCell] = relaxed
    is_ranked: bool = False
    keeps_symmetry: bool = False
    stops_at_zero_kappa: bool = False
    over_corrects: bool = False
    uses_exponent_and_threshold: bool = False
    parameters: Mapping[str, Parameter] = field(default=NO_PARAMETERS, compare=False)
    speed: Formula[float] | None = None


@partial(with_old_arguments, "ranked")
def ranked(
    function: RankedFunction, has_limit: bool = False, depends_on_absolute_time: bool = False
) -> Law:
    """Make a law that sets axes to principal directions and changes dimensions (eqs. 8 to 11).

    Parameters
    ----------
    function
        ``function(l, l0, target, kappa, time_old, time_new) -> l_new``. l and l0 are (n, 3) by
        rank: column 0 belongs to the largest principal value. With the pairing "continuous" they
        are by axis instead. The target is r0 e with ``e = lambda^+ / |lambda^+|``. kappa is a
        number, or (n, 1) if regions differ. Points without a positive principal value or with
        kappa = 0 keep their cells.
    has_limit, depends_on_absolute_time
        See `Law`.

    Returns
    -------
    Law
        A law for `LAWS`.

    Examples
    --------
    Relaxation by Euler's explicit method:

    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> from remodel_fenicsx.extend import LAWS, ranked
    >>> def euler(l, l0, target, kappa, time_old, time_new):
    ...     return l + kappa * (time_new - time_old) * (target - l)
    >>> LAWS["euler"] = ranked(euler, has_limit=True)
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube")
    >>> scene = scene.with_values({"remodeling.law": "euler", "time.end": 3.0})
    >>> [round(step.row["mean_fibre_angle"], 3) for step in Simulation(scene).steps()]
    [54.736, 53.554, 52.378]
    >>> del LAWS["euler"]
    """

    return Law(
        partial(by_rank, function),
        has_limit,
        depends_on_absolute_time=depends_on_absolute_time,
        keeps_symmetry=True,
        stops_at_zero_kappa=True,
        is_ranked=True,
    )


def by_rank(
    function: RankedFunction, cells: UnitCell, drive: Drive, time_old: float, time_new: float
) -> UnitCell:
    """Set principal axes (eqs. 8 and 9), and move dimensions towards r0 e (eqs. 10 and 11)."""
    values, axes = principal_directions(drive, cells.axes, drive.pairing)
    direction, active = drive.kernels.positive_direction(values, threshold=drive.noise)
    target = np.reshape(drive.end_to_end_length, (-1, 1)) * direction
    if np.ndim(drive.kappa):
        active = active & (np.asarray(drive.kappa) > 0.0)
    dimensions = function(
        cells.dimensions, drive.initial_dimensions, target, drive.kappas, time_old, time_new
    )
    new = UnitCell(
        dimensions, framed(drive, axes, None if drive.pairing is spectral.principal else dimensions)
    )
    if not active.all():
        new = UnitCell(
            np.where(active[:, None], new.dimensions, cells.dimensions),
            np.where(active[:, None, None], new.axes, cells.axes),
        )
    return new


def principal_directions(
    drive: Drive, previous: Array, pairing: spectral.Pairing
) -> tuple[Array, Array]:
    """Return principal values and directions of the drive; `previous` are the cells' axes."""
    if not drive.driver.material and drive.frame.carries_axes:
        previous = convected_axes(drive.deformation_gradient, previous)
    function: spectral.Pairing = (
        drive.kernels.principal if pairing is spectral.principal else pairing
    )
    return function(drive.tensor, previous, threshold=drive.noise)


def framed(drive: Drive, axes: Array, dimensions: Array | None = None) -> Array:
    """Return cell axes from the drive's principal directions, ordered by value or by dimension."""
    # A frame may depend on the order of the axes: the material frame keeps the direction of the
    # first axis. Without `dimensions` the axis of the largest principal value comes first, with
    # them that of the largest dimension. Two dimensions that change their order are equal at that
    # moment, so that A does not jump.
    if drive.driver.material:
        return axes
    if dimensions is None:
        return drive.frame.axes(drive.deformation_gradient, axes)
    order = np.argsort(-dimensions, axis=1, kind="stable")[:, :, None]
    framed = drive.frame.axes(drive.deformation_gradient, np.take_along_axis(axes, order, axis=1))
    return np.take_along_axis(framed, np.argsort(order, axis=1), axis=1)


def explicit(
    l: Array, l0: Array, target: Array, kappa: Array | float, time_old: float, time_new: float
) -> Array:
    """Return l = l0 + (r0 e - l0)(1 - exp(-kappa t)), t = time_new, for current e (eq. 11)."""
    return l0 - (target - l0) * np.expm1(-kappa * time_new)


def rate(
    l: Array, l0: Array, target: Array, kappa: Array | float, time_old: float, time_new: float
) -> Array:
    """Integrate dl/dt = kappa (r0 e - l0) exp(-kappa t) exactly over a step, e frozen (eq. 10)."""
    return l - (target - l0) * np.exp(-kappa * time_old) * np.expm1(-kappa * (time_new - time_old))


def relaxation(
    l: Array, l0: Array, target: Array, kappa: Array | float, time_old: float, time_new: float
) -> Array:
    """Integrate the autonomous form dl/dt = kappa (r0 e - l) exactly over the step, e frozen."""
    return l - (target - l) * np.expm1(-kappa * (time_new - time_old))


def rotation(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
    """Rotate the fibre, with the other axes, towards the largest tension (Remark 5)."""
    # n <- exp(dt [omega]) n with omega = n_new x n_max / tau (tau: `Drive.rotation_time`, n_new: at
    # the end of the step). The fibre n is the axis of the largest dimension
    # (the first of equal ones). n_max is the principal direction of the largest value, a line,
    # taken in the sense that is nearer to n. If n is orthogonal to the line within
    # `spectral.MIN_OVERLAP`, both senses are equally near; the sense nearer to the next axis of the
    # cell is taken. If the largest values agree, n_max is the direction of their plane that is
    # nearest to n. Points without tension keep their cells.
    order = (np.argmax(cells.dimensions, axis=1)[:, None] + np.arange(3)) % 3
    axes = np.take_along_axis(cells.axes, order[:, :, None], axis=1)
    values, towards = principal_directions(drive, axes, spectral.principal)
    _, active = spectral.positive_direction(values, threshold=drive.noise)
    largest = spectral.align_signs(axes, framed(drive, towards))[:, 0]
    vectors = _turn_towards(axes[:, 0], largest, (time_new - time_old) / drive.rotation_time)
    return UnitCell(cells.dimensions, turned(cells.axes, np.where(active[:, None], vectors, 0.0)))


def _turn_towards(fibre: Array, goal: Array, relative_step: float) -> Array:
    """Return rotation vectors dt omega (n, 3) of Remark 5's implicit step."""
    # |dt omega| = dt/tau sin(angle at the end of the step).
    across = np.cross(fibre, goal)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.einsum("na,na->n", fibre, goal))
    increment = angle - remaining_angle(angle, relative_step)
    # The sine is zero if fibre and goal are parallel.
    return across * np.divide(increment, sine, out=np.zeros_like(sine), where=sine > 0.0)[:, None]


def remaining_angle(angle: Array, relative_step: float) -> Array:
    """Return the root a of a + (dt/tau) sin a = angle after an implicit step; (n,) in [0, pi/2]."""
    # Newton's method starts from angle / (1 + dt/tau), which is below the root. The left side is
    # increasing and concave, so that the iterates approach the root from below.
    remaining = np.asarray(angle / (1.0 + relative_step), dtype=np.float64)
    for _ in range(50):
        residual = angle - remaining - relative_step * np.sin(remaining)
        correction = residual / (1.0 + relative_step * np.cos(remaining))
        remaining = np.asarray(remaining + correction, dtype=np.float64)
        if np.all(correction <= 1e-15 * angle):
            return remaining
    raise FloatingPointError(f"no convergence of a step of {relative_step:g} rotation times")


def turned(axes: Array, vectors: Array) -> Array:
    """Rotate axes (n, 3, 3), rows, by vectors (n, 3), axis times angle in radians (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    # sin(a)/a and (1 - cos a)/a^2 without cancellation; np.sinc(x) is sin(pi x)/(pi x).
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    along = np.broadcast_to(vectors[:, None], axes.shape)
    once = np.cross(along, axes)
    return axes + first * once + second * np.cross(along, once)


def rotate_partially(old: UnitCell, new: UnitCell, factor: float) -> UnitCell:
    """Rotate the old axes by a fraction of the rotation to the new ones, less than 180 degrees."""
    if factor == 1.0:
        return new
    across = 0.5 * np.cross(old.axes, new.axes).sum(axis=1)  # sin(angle) times the axis
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.einsum("nia,nia->n", old.axes, new.axes) - 1.0))
    scale = factor * np.divide(angle, sine, out=np.zeros_like(sine), where=sine > 0.0)
    return UnitCell(new.dimensions, turned(old.axes, scale[:, None] * across))


def keep(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
    """Return cells unchanged, without remodeling."""
    return cells


def tensor_target(drive: Drive) -> tensor_law.Target:
    """Return the target of the structure tensor, with a switch reduced below the threshold."""
    target = tensor_law.target(material_tensor(drive), drive.floor, drive.exponent)
    if not drive.least_tension:
        return target
    return target._replace(
        switch=target.switch * tensor_law.activation(drive.tensor, drive.least_tension)
    )


def follow_tensor(
    cells: UnitCell,
    target: tensor_law.Target,
    end_to_end_length: Array | float,
    kappa_dt: Array | float,
) -> UnitCell:
    """Return cells with A of `tensor_law.relax_exactly`; axes of equal eigenvalues stay."""
    # Dimensions are NaN if an extrapolated target makes the tensor indefinite by more than
    # rounding.
    structure = tensor_law.relax_exactly(
        structure_tensor(*cells[:2]), target, end_to_end_length, kappa_dt
    )
    squared, axes = spectral.principal_by_continuity(structure, cells.axes)
    rounding = spectral.ROUNDING * np.abs(squared).max(axis=-1, keepdims=True)
    return UnitCell(np.where(squared < -rounding, np.nan, np.sqrt(np.maximum(squared, 0.0))), axes)


def tensor(cells: UnitCell, drive: Drive, time_old: float, time_new: float) -> UnitCell:
    """Integrate dA/dt = kappa s (r0^2 E - A) over a step with E and s frozen."""
    return follow_tensor(
        cells, tensor_target(drive), drive.end_to_end_length, drive.kappa * (time_new - time_old)
    )


LAWS: dict[str, Law] = {
    "explicit": ranked(explicit, has_limit=True, depends_on_absolute_time=True),
    "rate": replace(ranked(rate), over_corrects=True),
    "relaxation": ranked(relaxation, has_limit=True),
    "tensor": Law(
        tensor,
        has_limit=True,
        target=tensor_target,
        follow=follow_tensor,
        keeps_symmetry=True,
        stops_at_zero_kappa=True,
        uses_exponent_and_threshold=True,
    ),
    "rotation": Law(rotation, relax=rotate_partially),
    "none": Law(keep, remodels=False, keeps_symmetry=True),
}


# ---------------------------------------------------------------- means over load cases
# Mean drive of cells that pass through several load cases in turn. Pure functions on arrays. With
# weights w_i, the fractions of time, and F_i = R_i U_i: D = sum_i w_i R_i^T sigma_i R_i, with each
# driving tensor in material space. Remodeling takes days and a cycle takes a second, so that cells
# follow the mean of many cycles.


def material_tensor(drive: Drive) -> Array:
    """Return the driving tensor in material space, (n, 3, 3)."""
    if drive.driver.material:
        return drive.tensor
    return drive.frame.tensor(drive.deformation_gradient, drive.tensor)


def mean_tensor(drives: Sequence[Drive], weights: Weights) -> Drive:
    """Return the first drive with the weighted means of driving tensors, noise and rounding."""
    tensor = _weighted([material_tensor(drive) for drive in drives], weights)
    return _with(
        drives[0],
        tensor,
        _weighted([drive.noise for drive in drives], weights),
        _weighted([drive.rounding for drive in drives], weights),
    )


def largest_tension(drives: Sequence[Drive], weights: Weights) -> Drive:
    """Return the first drive with the tensor of the largest tension at each point."""
    tensors = np.array([material_tensor(drive) for drive in drives])
    chosen = np.linalg.eigvalsh(tensors)[..., -1].argmax(axis=0)
    shape, points = tensors.shape[:2], np.arange(tensors.shape[1])
    noise, rounding = (
        np.array([np.broadcast_to(getattr(drive, name), shape[1]) for drive in drives])[
            chosen, points
        ]
        for name in ("noise", "rounding")
    )
    return _with(drives[0], tensors[chosen, points], noise, rounding)


def mean_target(targets: Sequence[Target], weights: Weights) -> Target:
    """Return the weighted mean of sE; the rate of A is linear in sE (`Target.towards`)."""
    pulled = _weighted(
        [target.switch[:, None, None] * target.direction for target in targets], weights
    )
    switch = np.einsum("nii->n", pulled)
    return Target(pulled / np.where(switch > 0.0, switch, 1.0)[:, None, None], switch)


def _with(drive: Drive, tensor: Array, noise: Array | float, rounding: Array | float) -> Drive:
    driver = replace(drive.driver, material=True)  # the tensor is in material space already
    return drive._replace(tensor=tensor, driver=driver, noise=noise, rounding=rounding)


def _weighted(values: Sequence[Array | float], weights: Weights) -> Array:
    return np.asarray(sum(weight * value for weight, value in zip(weights, values, strict=True)))


@dataclass(frozen=True)
class CaseAverage:
    """Average over the drives or targets of load cases."""

    meaning: str
    drive: Callable[[Sequence[Drive], Weights], Drive] = mean_tensor
    of_targets: bool = False


MEANS_OF_CASES: dict[str, CaseAverage] = {
    "tensor": CaseAverage("the weighted mean of the driving tensors"),
    "target": CaseAverage(
        "the weighted mean of the targets that each case has, for the law 'tensor'", of_targets=True
    ),
    "largest": CaseAverage(
        "at each point the load case with the largest tension, whatever its weight", largest_tension
    ),
}
"""Averages by the name in `remodeling.mean`."""


# ---------------------------------------------------------------- turnover
# Collagen is removed and deposited under a stretch. m is the content of chains and rho their
# natural length, each relative to its initial value; lambda_e = r/(rho r0), and lambda_h is the
# deposition stretch. The rates `cauchy` are those of Cyron, Aydin and Humphrey (2016).
# S(lambda) = g(lambda r0) lambda^2 is proportional to the Cauchy stress of a chain,
# s = S(lambda_e)/S(lambda_h), a = d ln S / d ln lambda, and p = max(1 + k (s - 1), 0) is production
# over removal:
#     dm/dt / m = (p - 1)/T,    drho/dt / rho = p (1 - 1/s)/(a T).
# The rates `tension` are those of version 0.3.0. tau(lambda) = g(lambda r0) lambda is proportional
# to the chain force:
#     dm/dt / m = k/T (tau(lambda_e)/tau(lambda_h) - 1), limited to k/T,
#     drho/dt / rho = (1/T + (dm/dt / m)^+) (lambda_e/lambda_h - 1).


class TurnoverRates(NamedTuple):
    """Rates of content and natural length, d ln m / dt and d ln rho / dt, in 1/time, (n,)."""

    content: Array
    natural_length: Array


class TurnoverStimulus(NamedTuple):
    """Turnover rates, and the power of lambda in their stimulus, g(lambda r0) lambda^power."""

    rates: Callable[[TurnoverRule, Tension, Array], TurnoverRates]
    power: int


class TurnoverRule(NamedTuple):
    """Rule of turnover: T, lambda_h, k, and one of `TURNOVER_RATES`."""

    time: float
    deposition_stretch: float
    gain: float
    followed: TurnoverStimulus

    def rates(self, tissue: Tissue, stretch: Array) -> TurnoverRates:
        """Return the rates at the stretch lambda_e (n,) of chains."""
        secant = _secant(tissue)
        return self.followed.rates(self, lambda lambda_e: secant(lambda_e) * lambda_e, stretch)

    def at_length(self, tissue: Tissue, length: Array) -> TurnoverRates:
        """Return the rates at the length r (n,) of chains."""
        return self.rates(tissue, tissue.normalised_length(length) / tissue.end_to_end_length)

    def gain_and_recovery_time(self, tissue: Tissue) -> tuple[float, float]:
        """Return k a, which must exceed 2 for a steady state of a wall, and the time constant."""
        # Near the steady state a small change decays by a factor of e in E T/(k a - 2) with E = d
        # ln(g - g0/lambda^2)/d ln lambda at lambda_h, the slope for chains and repulsion together.
        # The parameters of the tissue must be numbers.
        deposited = self.deposition_stretch * (1.0 + 1j * COMPLEX_STEP)
        secant = _secant(tissue)(deposited)
        total_force = secant - _secant(tissue)(1.0) / deposited**2
        stimulus = secant * deposited**self.followed.power
        stimulus_slope, force_slope = (
            float(np.log(value).imag) / COMPLEX_STEP for value in (stimulus, total_force)
        )
        return self.gain * stimulus_slope, force_slope * self.time / (
            self.gain * stimulus_slope - 2
        )


def _secant(tissue: Tissue) -> Tension:
    """Return g(lambda r0), the secant stiffness of chains, as a function of lambda."""
    chain, r0 = tissue.chain, tissue.end_to_end_length
    contour = tissue.contour_length
    assert chain is not None
    return lambda stretch: chain.stiffness(stretch * r0, contour)


def by_stress(rule: TurnoverRule, tension: Tension, stretch: Array) -> TurnoverRates:
    """Return the rates `cauchy`, which follow the stress of chains."""

    def steepness(lambda_e: Array) -> Array:
        return 1.0 + np.log(tension(lambda_e * (1.0 + 1j * COMPLEX_STEP))).imag / COMPLEX_STEP

    slope = steepness(stretch)
    relative = (
        tension(stretch) * stretch / (tension(rule.deposition_stretch) * rule.deposition_stretch)
    )
    produced = 1.0 + rule.gain * (relative - 1.0)
    produced = np.maximum(produced, 0.0)
    return TurnoverRates(
        (produced - 1.0) / rule.time, produced * (1.0 - 1.0 / relative) / (slope * rule.time)
    )


def by_tension(rule: TurnoverRule, tension: Tension, stretch: Array) -> TurnoverRates:
    """Return the rates `tension`, which follow the force of chains."""
    relative = tension(stretch) / tension(rule.deposition_stretch) - 1.0
    content = rule.gain / rule.time * np.clip(relative, -1.0, 1.0)
    turned_over = 1.0 / rule.time + np.maximum(content, 0.0)
    return TurnoverRates(content, turned_over * (stretch / rule.deposition_stretch - 1.0))


TURNOVER_RATES = {
    "cauchy": TurnoverStimulus(by_stress, 2),
    "tension": TurnoverStimulus(by_tension, 1),
}
"""Rates by the name in `remodeling.turnover.rates`."""
