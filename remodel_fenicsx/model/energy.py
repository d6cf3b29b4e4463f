"""Strain energy of tissue with remodeling collagen, in UFL or on arrays; it is written only here.

Stresses, drivers, residual and tangent follow by differentiation. Per reference volume
(docs/model.md, Energy):

    W      = W_iso + W_chn + W_rep
    W_iso  = lambda/2 ln^2 J + mu/2 (tr C - 3) - mu ln J
    W_chn  = c psi(r),  r^2 = sum_I l_I^2 I_I,  I_I = n_I . C n_I = f_I . f_I,  f_I = F n_I
    W_rep  = -c/2 g(r0) sum_I l_I^2 ln I_I

With a prestretch G_e of elastin W_iso takes F G_e (docs/turnover.md, Elastin).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx._lazy import Late
from remodel_fenicsx.model import tensors
from remodel_fenicsx.model.cells import UnitCell, structure_tensor
from remodel_fenicsx.model.chains import (
    CHAINS,
    NO_PARAMETERS,
    NO_VALUES,
    Chain,
    Formula,
    Parameter,
    UflOrArray,
    WithParameters,
)
from remodel_fenicsx.model.tensors import Array, det, is_array, ln, sqrt, squared_norm

ufl = Late("ufl")
Term = Formula[UflOrArray]  # of F or J, lambda and mu
TURNED_OVER = ("content", "natural_length")  # parameters that turnover changes at every point
ELASTIN = ("elastin_circumferential", "elastin_axial")  # prestretch of the matrix
AXES_ON_THE_RADIUS = np.eye(3)[[1, 2, 0]]
"""Circumferential, axial and radial axes as rows, where x, y and z are the radial, circumferential
and axial directions: in kinematics on one radius, and in `model.residual_stress`."""
# Every tissue has these parameters.
PARAMETERS = ("lame_lambda", "lame_mu", "network_modulus", "contour_length", "end_to_end_length")


@with_old_names
class Matrix:
    """Matrix energy with a separate volumetric part, as `fem.formulations` require it.

    A call with F, lambda and mu returns the total energy. The terms are added one by one: another
    grouping would change the last digits.

    Parameters
    ----------
    volumetric
        Volumetric energy, a function of J, lambda and mu, with zero value and slope at J = 1.
    others
        All other terms, functions of F, lambda and mu; their sum is zero and stress-free at F = I.
    parameters
        Additional parameters, keys of `[material]`. All functions take them by their names.

    If a tube is closed from a sector or cut, the terms get arrays of complex numbers: use
    np.maximum(x, 0), not |x|. For the kinematics that solve a tube on one radius, x, y and z are
    the radial, circumferential and axial directions.

    Examples
    --------
    A matrix that resists changes of volume by (J - 1)^2:

    >>> import numpy as np
    >>> from remodel_fenicsx.extend import MATRICES, Matrix, neo_hookean
    >>> MATRICES["quadratic"] = Matrix(
    ...     lambda J, lame_lambda, mu: lame_lambda / 2 * (J - 1) ** 2, *neo_hookean.others)
    >>> float(MATRICES["quadratic"](np.eye(3), 27.293, 3.103))
    0.0
    >>> del MATRICES["quadratic"]
    """

    def __init__(
        self,
        volumetric: Term,
        *others: Term,
        parameters: Mapping[str, Parameter] = NO_PARAMETERS,
    ):
        self.volumetric, self.others = volumetric, others
        self.parameters, self.values = parameters, NO_VALUES

    def with_parameters(self, values: Mapping[str, UflOrArray]) -> Matrix:
        """Return the matrix with bound values of its parameters.

        Parameters
        ----------
        values
            Numbers, arrays or UFL by the names of `parameters`.
        """
        matrix = copy.copy(self)
        matrix.values, matrix.volumetric = values, partial(self.volumetric, **values)
        matrix.others = tuple(partial(term, **values) for term in self.others)
        return matrix

    def __call__(
        self, deformation_gradient: UflOrArray, lame_lambda: UflOrArray, lame_mu: UflOrArray
    ) -> UflOrArray:
        """Return the total energy of the matrix."""
        volumetric = self.volumetric(det(deformation_gradient), lame_lambda, lame_mu)
        return sum(
            (term(deformation_gradient, lame_lambda, lame_mu) for term in self.others), volumetric
        )

    def distortional(
        self, deformation_gradient: UflOrArray, lame_lambda: UflOrArray, lame_mu: UflOrArray
    ) -> UflOrArray:
        """Return the energy without the volumetric part.

        Parameters
        ----------
        deformation_gradient
            F, UFL of shape (3, 3) or array (..., 3, 3).
        lame_lambda, lame_mu
            Lame constants in the unit of stress.
        """
        first, *remaining = (
            term(deformation_gradient, lame_lambda, lame_mu) for term in self.others
        )
        return sum(remaining, first)


def logarithmic_dilatation(
    jacobian: UflOrArray, lame_lambda: UflOrArray, lame_mu: UflOrArray, **own: UflOrArray
) -> UflOrArray:
    """Return U = lambda/2 ln^2 J, the volumetric part of eq. (4a); J dU/dJ = lambda ln J."""
    return lame_lambda / 2 * ln(jacobian) ** 2


# The terms ignore the parameters of a matrix that adds other terms to them.
neo_hookean = Matrix(
    logarithmic_dilatation,
    lambda F, lame_lambda, lame_mu, **own: lame_mu / 2 * (squared_norm(F) - 3),
    lambda F, lame_lambda, lame_mu, **own: -(lame_mu * ln(det(F))),
)
"""W_iso = lambda/2 ln^2 J + mu/2 (tr C - 3) - mu ln J (eq. 4a)."""


def mixture_matrix(matrices: Sequence[Matrix]) -> Matrix:
    """Combine matrices to one sum, weighted by its parameters share_0, share_1, ..."""
    names = [f"share_{number}" for number in range(len(matrices))]
    numbers = {name: number for matrix in matrices for name, number in matrix.parameters.items()}
    numbers |= {name: Parameter(0.0, "1 in regions with this matrix, else 0.") for name in names}

    def weighted_matrices(
        values: Mapping[str, UflOrArray],
    ) -> Iterator[tuple[UflOrArray, UflOrArray]]:
        for key, matrix in zip(names, matrices, strict=True):
            yield values[key], matrix.with_parameters(
                {name: values[name] for name in matrix.parameters}
            )

    return Matrix(
        lambda J, lam, mu, **values: sum(
            weight * matrix.volumetric(J, lam, mu) for weight, matrix in weighted_matrices(values)
        ),
        lambda F, lam, mu, **values: sum(
            weight * matrix.distortional(F, lam, mu) for weight, matrix in weighted_matrices(values)
        ),
        parameters=numbers,
    )


MATRICES: dict[str, Term] = {"neo-hookean": neo_hookean}
"""Matrix energies by name: functions of F, lambda and mu (UFL or arrays), zero and stress-free at
F = I. Formulations other than "displacement" require a `Matrix`."""


# ---------------------------------------------------------------- repulsion: W_rep = -c/2 g(r0) M
# The repulsion makes the unloaded tissue stress-free. M has several forms. `axes` is the paper's
# (eq. 4c) and depends on the axes of a cell. `log` depends only on the structure tensor A = sum_I
# l_I^2 n_I (x) n_I. It equals `axes` if C and the cell are coaxial, is isotropic for isotropic
# cells in every frame, and leaves C = I stress-free for every A (docs/model.md, "Repulsions of the
# structure tensor"). `length` is the simplest function of A; isotropic cells give it no shear
# stiffness.


def squared_end_to_end_length(
    deformation_gradient: UflOrArray, cells: Sequence[UnitCell]
) -> UflOrArray:
    """Return r^2 = sum_I l_I^2 n_I . C n_I, the squared end-to-end length of the chains (eq. 5).

    Parameters
    ----------
    deformation_gradient
        F, UFL of shape (3, 3) or array (..., 3, 3).
    cells
        One whole cell, or weighted cells.

    Returns
    -------
    UFL or array (...,)
        r^2 in squared link lengths.

    Examples
    --------
    >>> import numpy as np
    >>> from remodel_fenicsx.extend import UnitCell, squared_end_to_end_length
    >>> cell = UnitCell(np.array([0.6, 0.0, 0.8]), np.eye(3))
    >>> round(float(squared_end_to_end_length(np.diag([1.0, 1.0, 2.0]), [cell])), 4)
    2.92
    """
    return sum(
        cell.weight * cell.dimensions[..., i] ** 2 * stretch
        for cell in cells
        for i, stretch in enumerate(cell.squared_stretches(deformation_gradient))
    )


def axes_sum(
    deformation_gradient: UflOrArray, cells: Sequence[UnitCell], end_to_end_length: UflOrArray
) -> UflOrArray:
    """Return M = sum_I l_I^2 ln(n_I . C n_I) of the paper's repulsive energy (eq. 4c).

    Parameters
    ----------
    deformation_gradient
        F, UFL of shape (3, 3) or array (..., 3, 3).
    cells
        One whole cell, or weighted cells.
    end_to_end_length
        r0 in link lengths; not used in this form.

    Returns
    -------
    UFL or array (...,)
        M in squared link lengths; zero at F = I.

    Examples
    --------
    >>> import numpy as np
    >>> from remodel_fenicsx.extend import UnitCell, axes_sum
    >>> cell = UnitCell(np.full(3, 3**-0.5), np.eye(3))
    >>> float(axes_sum(np.eye(3), [cell], 1.0))
    0.0
    >>> round(float(axes_sum(np.diag([1.0, 1.0, 2.0]), [cell], 1.0)), 4)
    0.4621
    """
    return sum(
        cell.weight * cell.dimensions[..., i] ** 2 * ln(stretch)
        for cell in cells
        for i, stretch in enumerate(cell.squared_stretches(deformation_gradient))
    )


def length_sum(
    deformation_gradient: UflOrArray, cells: Sequence[UnitCell], end_to_end_length: UflOrArray
) -> UflOrArray:
    """Return M = r0^2 ln(r^2 / r0^2) with r^2 = A : C; UFL or arrays."""
    squared = squared_end_to_end_length(deformation_gradient, cells)
    return end_to_end_length**2 * ln(squared / end_to_end_length**2)


def log_sum(
    deformation_gradient: Array, cells: Sequence[UnitCell], end_to_end_length: UflOrArray
) -> UflOrArray:
    """Return M = A : ln C of arrays; for complex F to first order in the imaginary part."""
    C, A = np.swapaxes(deformation_gradient, -1, -2) @ deformation_gradient, total_structure_tensor(
        cells
    )
    M = (A * tensors.logarithm(C.real)).sum(axis=(-1, -2))
    return (
        M + 1j * (log_derivatives(C.real, A, False)[0] * C.imag).sum(axis=(-1, -2))
        if np.iscomplexobj(C)
        else M
    )


def total_structure_tensor(cells: Sequence[UnitCell]) -> Array:
    """Return A of one cell or of weighted cells, (n, 3, 3); the weights are numbers."""
    tensors = (cell.weight * structure_tensor(cell.dimensions, cell.axes) for cell in cells)
    return sum(tensors)  # type: ignore


def log_derivatives(C: Array, A: Array, second: bool = True) -> tuple[Array, Array | None]:
    """Return dM/dC (n, 3, 3) and, if `second`, d^2M/dC^2 (n, 6, 6) of M = A : ln C."""
    values, vectors = np.linalg.eigh(C)
    components = tensors.rotated(A, vectors)
    transposed = np.swapaxes(vectors, -1, -2)
    first = tensors.rotated(tensors.first_divided_differences(values) * components, transposed)
    if not second:
        return first, None
    rotation = tensors.congruence(vectors)
    return first, rotation @ tensors.second_derivative(values, components) @ np.swapaxes(
        rotation, 1, 2
    )


@dataclass(frozen=True)
class Repulsion(WithParameters):
    """Form of the repulsive energy.

    Attributes
    ----------
    sum
        Function M of (F, cells, r0): arrays, and UFL too unless there are `derivatives`.
    derivatives
        Function of arrays (C, A, second), needed if UFL has no closed expression of M. It returns
        dM/dC (n, 3, 3) and, if `second`, d^2M/dC^2 as Mandel matrices (n, 6, 6).
    parameters
        Additional parameters, keys of `[material]`. All functions take them by their names.
    values
        Values of the parameters (`with_parameters`).

    Examples
    --------
    With M = r^2 the unloaded tissue is stress-free too:

    >>> from remodel_fenicsx.extend import REPULSIONS, Repulsion, squared_end_to_end_length
    >>> REPULSIONS["squared"] = Repulsion(lambda F, cells, r0: squared_end_to_end_length(F, cells))
    >>> from remodel_fenicsx import preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube")
    >>> scene.with_values({"material.repulsion": "squared"}).material.repulsion
    'squared'
    >>> del REPULSIONS["squared"]
    """

    sum: Callable[[UflOrArray, Sequence[UnitCell], UflOrArray], UflOrArray]
    derivatives: Formula[tuple[Array, Array | None]] | None = None
    parameters: Mapping[str, Parameter] = field(default=NO_PARAMETERS, compare=False)
    values: Mapping[str, UflOrArray] = field(default=NO_VALUES, compare=False)
    functions = ("sum", "derivatives")


REPULSIONS: dict[str, Repulsion] = {
    "axes": Repulsion(axes_sum),
    "log": Repulsion(log_sum, log_derivatives),
    "length": Repulsion(length_sum),
}


# ---------------------------------------------------------------- the tissue


class Stresses(NamedTuple):
    """Stress tensors of one state (paper, eqs. 6 and 7), in the unit of the Lame constants.

    Attributes
    ----------
    first_piola_kirchhoff
        P = dW/dF, UFL, (3, 3).
    second_piola_kirchhoff
        S = F^-1 P, UFL, (3, 3).
    cauchy
        sigma = P F^T / J, UFL, (3, 3).
    collagen
        The same three of the network alone; None in these.

    Examples
    --------
    Drivers are functions of the stresses:

    >>> from remodel_fenicsx.extend import DRIVERS, Stresses
    >>> stresses = Stresses(first_piola_kirchhoff="P", second_piola_kirchhoff="S", cauchy="sigma")
    >>> DRIVERS["cauchy"].tensor("F", stresses), DRIVERS["pk2"].tensor("F", stresses)
    ('sigma', 'S')
    """

    first_piola_kirchhoff: UflOrArray
    second_piola_kirchhoff: UflOrArray
    cauchy: UflOrArray
    collagen: Stresses | None = None

    def over(self, volume_ratio: UflOrArray) -> Stresses:
        """Divide all stresses by the volume ratio of growth.

        Parameters
        ----------
        volume_ratio
            J_g, UFL.
        """
        collagen = self.collagen and self.collagen.over(volume_ratio)
        first, second, cauchy = (stress / volume_ratio for stress in self[:3])
        return Stresses(first, second, cauchy, collagen)

    def plus(
        self, deformation_gradient: UflOrArray, second_piola_kirchhoff: UflOrArray
    ) -> Stresses:
        """Add a second Piola-Kirchhoff stress that `Tissue.strain_energy` does not contain in UFL.

        Parameters
        ----------
        deformation_gradient
            F, UFL, (3, 3).
        second_piola_kirchhoff
            Stress to add to S, UFL, (3, 3).

        Returns
        -------
        Stresses
            The sums.
        """
        F, S = deformation_gradient, second_piola_kirchhoff
        P = ufl.dot(F, S)
        collagen = self.collagen and self.collagen.plus(F, S)
        first, second, cauchy = self[:3]
        return Stresses(first + P, second + S, cauchy + ufl.dot(P, F.T) / ufl.det(F), collagen)


@with_old_names
@dataclass(frozen=True)
class Tissue:
    """Constitutive parameters of matrix and collagen network, with energy and stresses.

    Every parameter is a number, a dolfinx Constant, a DG0 function (regions) or an array over
    points. The same functions serve forms and arrays; `fem.assembly` converts the parameters.

    Attributes
    ----------
    lame_lambda, lame_mu
        Lame constants of the matrix, in a unit of stress.
    network_modulus
        c = omega k theta n_chn / (4 A_p), in the same unit.
    contour_length
        L, in link lengths. A chain law that does not lock may use it differently, or not at all.
    end_to_end_length
        r0, the initial length of a chain (erratum 3), in link lengths.
    chain
        Law of a single chain; None for a matrix without chains, which does not lock.
    matrix
        Energy of the matrix (`MATRICES`).
    repulsion
        Form of the repulsive energy (`REPULSIONS`).
    content, natural_length
        Density m and natural length rho of the chains, relative to their initial values
        (`model.laws`): W_net = m c (w(r/rho) - g(r0) M / 2). None if they stay 1.
    elastin_circumferential, elastin_axial
        Prestretch of the matrix, whose radial stretch keeps the volume: det G_e = 1. None without
        prestretch.
    elastin_axes
        Circumferential, axial and radial unit vectors as rows, (3, 3) or (..., 3, 3); by default
        those of the kinematics on one radius, y, z and x.

    Examples
    --------
    The same functions take arrays and UFL:

    >>> import numpy as np
    >>> from remodel_fenicsx import parts
    >>> from remodel_fenicsx.extend import UnitCell
    >>> tissue = parts.Tissue(lame_lambda=27.293, lame_mu=3.103, network_modulus=2.0,
    ...                       contour_length=2.125, end_to_end_length=1.0)
    >>> cell = UnitCell(np.full(3, 3**-0.5), np.eye(3))
    >>> still, pulled = np.eye(3), np.diag([0.9, 0.9, 1.3])
    >>> W0, W = (tissue.strain_energy(F, [cell]) for F in (still, pulled))
    >>> round(float(W - W0), 4)  # in the unit of the Lame constants
    0.4364
    """

    lame_lambda: UflOrArray
    lame_mu: UflOrArray
    network_modulus: UflOrArray
    contour_length: UflOrArray
    end_to_end_length: UflOrArray
    chain: Chain | None = CHAINS["wormlike"]
    matrix: Term = neo_hookean
    repulsion: Repulsion = REPULSIONS["axes"]
    content: UflOrArray = None
    natural_length: UflOrArray = None
    elastin_circumferential: UflOrArray = None
    elastin_axial: UflOrArray = None
    elastin_axes: UflOrArray = field(default_factory=AXES_ON_THE_RADIUS.copy, compare=False)

    @property
    def locking_length(self) -> UflOrArray:
        """Length at which a chain locks, rho L, in link lengths; None if no chain locks."""
        if self.chain is None or not self.chain.locks:
            return None
        return (
            self.contour_length
            if self.natural_length is None
            else self.natural_length * self.contour_length
        )

    @property
    def current_modulus(self) -> UflOrArray:
        """Current modulus of the network, m c."""
        return self.network_modulus if self.content is None else self.content * self.network_modulus

    def normalised_length(self, length: UflOrArray) -> UflOrArray:
        """Return the normalised length r/rho.

        Parameters
        ----------
        length
            r, in link lengths; number, array or UFL.
        """
        return length if self.natural_length is None else length / self.natural_length

    def stiffness(self, end_to_end_length: UflOrArray) -> UflOrArray:
        """Return a stiffness whose product with eps is the rounding error of a stress.

        The stiffness of matrix and network at length r is
        lambda + 2 mu + m c (x^2 d(g x)/dx + g(r0) r0^2) with x = r/rho. Near the contour length a
        small change of r changes the chain force by much more than the force itself.

        Parameters
        ----------
        end_to_end_length
            r, in link lengths; numbers, arrays or UFL.
        """
        matrix = self.lame_lambda + 2 * self.lame_mu
        if self.chain is None:
            return matrix
        r, r0 = self.normalised_length(end_to_end_length), self.end_to_end_length
        L, g = self.contour_length, self.chain.stiffness
        h = 1e-6 * r * (1 - r / L if self.chain.locks else 1)
        slope = ((r + h) * g(r + h, L) - (r - h) * g(r - h, L)) / (2 * h)
        return matrix + self.current_modulus * (r**2 * slope + g(r0, L) * r0**2)

    @property
    def parameters(self) -> dict[str, UflOrArray]:
        """All parameters by name, with those of turnover, elastin, and additional ones."""
        optional = [name for name in TURNED_OVER + ELASTIN if getattr(self, name) is not None]
        values = {name: getattr(self, name) for name in (*PARAMETERS, *optional)}
        for additional in self._own_parameters.values():
            values |= additional
        return values

    @property
    def _own_parameters(self) -> dict[str, Mapping[str, UflOrArray]]:
        """Additional parameters by component: chain, matrix or repulsion."""
        values = {
            name: getattr(getattr(self, name), "values", None)
            for name in ("chain", "matrix", "repulsion")
        }
        return {name: bound for name, bound in values.items() if bound}

    def map(self, function: Callable[[str, UflOrArray], UflOrArray]) -> Tissue:
        """Return the tissue with function(name, value) in place of every parameter.

        Parameters
        ----------
        function
            Function of a parameter's name and value that returns the new value.
        """
        values = {name: function(name, value) for name, value in self.parameters.items()}
        components = {
            component: getattr(self, component).with_parameters(
                {name: values[name] for name in names}
            )
            for component, names in self._own_parameters.items()
        }
        known = PARAMETERS + TURNED_OVER + ELASTIN
        own = {name: values[name] for name in values if name in known}
        return replace(self, **own, **components)

    def is_round(self) -> bool:
        """Return whether a rotation about z before the deformation keeps the matrix energy."""
        pulled, (c, s) = np.diag([1.1, 1.3, 1.2]), (0.8, 0.6)
        rotated = pulled @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        energy, rotated_energy = (
            self.matrix(F, self.lame_lambda, self.lame_mu) for F in (pulled, rotated)
        )
        return bool(np.isclose(energy, rotated_energy, rtol=1e-9))

    @property
    def elastin_stretches(self) -> list[UflOrArray]:
        """Circumferential, axial and radial prestretch of the matrix, det G_e = 1."""
        around, along = self.elastin_circumferential, self.elastin_axial
        return [1.0, 1.0, 1.0] if along is None else [around, along, 1 / (around * along)]

    @property
    def elastin_prestretch(self) -> Array:
        """Prestretches `elastin_stretches` of numbers or arrays as one array, (..., 3)."""
        return np.stack(np.broadcast_arrays(*self.elastin_stretches), axis=-1)

    def matrix_gradient(self, deformation_gradient: UflOrArray) -> UflOrArray:
        """Return F_m = F G_e, the deformation gradient of the matrix.

        Parameters
        ----------
        deformation_gradient
            F, UFL of shape (3, 3) or array (..., 3, 3).
        """
        F = deformation_gradient
        if self.elastin_axial is None:
            return F
        axes = self.elastin_axes
        if is_array(F):
            return F @ tensors.stretch_tensor(self.elastin_prestretch, axes)
        directions = enumerate(self.elastin_stretches)
        return ufl.dot(F, sum(s * ufl.outer(axes[i, :], axes[i, :]) for i, s in directions))

    def strain_energy(
        self, deformation_gradient: UflOrArray, cells: Sequence[UnitCell]
    ) -> UflOrArray:
        """Return W per reference volume (eqs. 3 and 4 with errata 1 and 2).

        Parameters
        ----------
        deformation_gradient
            F, UFL of shape (3, 3) or array (..., 3, 3).
        cells
            One whole cell, or cells whose weights add up to one.

        Returns
        -------
        UFL or array (...,)
            W in the unit of the Lame constants. In UFL it lacks a repulsion with
            `Repulsion.derivatives`, which enter forms as values at the quadrature points
            (`solver.equilibrium.PointwiseRepulsion`).
        """
        F_m = self.matrix_gradient(deformation_gradient)
        energy = self.matrix(F_m, self.lame_lambda, self.lame_mu)
        return self._with_network(energy, deformation_gradient, cells)

    def distortional_energy(
        self, deformation_gradient: UflOrArray, cells: Sequence[UnitCell]
    ) -> UflOrArray:
        """Return W without the volumetric part of the matrix; see `strain_energy`."""
        F_m = self.matrix_gradient(deformation_gradient)
        energy = self._parts().distortional(F_m, self.lame_lambda, self.lame_mu)
        return self._with_network(energy, deformation_gradient, cells)

    def volumetric_energy(self, jacobian: UflOrArray) -> UflOrArray:
        """Return the volumetric energy of the matrix, U(J).

        Parameters
        ----------
        jacobian
            J, UFL or array.
        """
        return self._parts().volumetric(jacobian, self.lame_lambda, self.lame_mu)

    def _parts(self) -> Matrix:
        if isinstance(self.matrix, Matrix):
            return self.matrix
        raise TypeError(
            "no separate volumetric part in this matrix energy; use remodel_fenicsx.extend.Matrix"
        )

    def _with_network(
        self, energy: UflOrArray, deformation_gradient: UflOrArray, cells: Sequence[UnitCell]
    ) -> UflOrArray:
        """Add the network's energy, if there are chains."""
        if self.chain is None:
            return energy
        length = sqrt(squared_end_to_end_length(deformation_gradient, cells))
        chains = self.chain.energy(self.normalised_length(length), self.contour_length)
        if not is_array(deformation_gradient) and self.repulsion.derivatives is not None:
            return energy + self.current_modulus * chains
        stiffness = self.chain.stiffness(self.end_to_end_length, self.contour_length)
        repulsion = (
            -stiffness / 2 * self.repulsion.sum(deformation_gradient, cells, self.end_to_end_length)
        )
        return energy + self.current_modulus * (chains + repulsion)

    @property
    def repulsion_modulus(self) -> UflOrArray:
        """Modulus of the repulsion, m c g(r0); W_rep = -m c g(r0) M / 2."""
        assert self.chain is not None
        return self.current_modulus * self.chain.stiffness(
            self.end_to_end_length, self.contour_length
        )

    def stresses(self, deformation_gradient: UflOrArray, cells: Sequence[UnitCell]) -> Stresses:
        """Return P = dW/dF, S = F^-1 P and sigma = P F^T / J (eqs. 6 and 7 with erratum 5); UFL.

        Parameters
        ----------
        deformation_gradient
            F, UFL of shape (3, 3).
        cells
            One whole cell, or cells whose weights add up to one.
        """
        F = ufl.variable(deformation_gradient)
        return self._stresses(F, ufl.diff(self.strain_energy(F, cells), F), cells)

    def stresses_of_parts(
        self, deformation_gradient: UflOrArray, cells: Sequence[UnitCell], jacobian: UflOrArray
    ) -> Stresses:
        """Return stresses with U at the given J: P = d(W - U)/dF + J U'(J) F^-T; UFL."""
        F, J = ufl.variable(deformation_gradient), ufl.variable(jacobian)
        pressure = J * ufl.diff(self.volumetric_energy(J), J)
        distortional = ufl.diff(self.distortional_energy(F, cells), F)
        return self._stresses(F, distortional + pressure * ufl.inv(F).T, cells)

    def _stresses(self, F: UflOrArray, first: UflOrArray, cells: Sequence[UnitCell]) -> Stresses:
        """Return all stresses from P, with those of the network; UFL."""
        of_network = ufl.diff(self._with_network(0.0 * ufl.tr(F), F, cells), F)
        whole, collagen = (
            Stresses(P, ufl.dot(ufl.inv(F), P), ufl.dot(P, F.T) / ufl.det(F))
            for P in (first, of_network)
        )
        return whole._replace(collagen=collagen)

    def energy_increment(
        self, deformation_gradient: UflOrArray, old: UnitCell, new: UnitCell
    ) -> UflOrArray:
        """Return the first-order change of W for new cells at frozen F (Remark 6).

        W per reference volume depends on the cells only through r^2 = A : C and M = sum_I l_I^2 ln
        I_I: dW = c g(r)/2 d(r^2) - c/2 g(r0) dM, evaluated with the old cells, which have r < L.
        The new cells may have r > L until the next solve, so that their energy is not always
        defined. Arrays.

        Parameters
        ----------
        deformation_gradient
            F, (..., 3, 3).
        old, new
            Cells with dimensions (..., 3) and axes (..., 3, 3).
        """
        F, r0 = deformation_gradient, self.end_to_end_length
        if self.chain is None:
            return 0.0 * det(F)
        squared, squared_after = [squared_end_to_end_length(F, [cell]) for cell in (old, new)]
        stiffness = self.chain.stiffness(self.normalised_length(sqrt(squared)), self.contour_length)
        if self.natural_length is not None:
            stiffness = stiffness / self.natural_length**2
        chains = self.current_modulus / 2 * stiffness * (squared_after - squared)
        repulsion = self.repulsion.sum(F, [new], r0) - self.repulsion.sum(F, [old], r0)
        return chains - self.repulsion_modulus / 2 * repulsion

    def turnover_increment(
        self,
        deformation_gradient: UflOrArray,
        cell: UnitCell,
        content: UflOrArray,
        natural_length: UflOrArray,
    ) -> UflOrArray:
        """Return the first-order change of W at frozen F and cells for changes of ln m and ln rho.

        dW = W_net d ln m - m c g(r/rho) (r/rho)^2 d ln rho, per reference volume. Arrays.

        Parameters
        ----------
        deformation_gradient, cell
            F, (..., 3, 3), and the unit cell.
        content, natural_length
            Changes of ln m and ln rho, (...).
        """
        assert self.chain is not None
        F, cells = deformation_gradient, [cell]
        length = self.normalised_length(sqrt(squared_end_to_end_length(F, cells)))
        tension = (
            self.current_modulus * self.chain.stiffness(length, self.contour_length) * length**2
        )
        return self._with_network(0.0, F, cells) * content - tension * natural_length
