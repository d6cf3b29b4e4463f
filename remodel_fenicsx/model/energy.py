"""The strain energy of tissue with remodeling collagen, in UFL or on arrays: the only place where it is written.

Stresses, drivers, residual and tangent follow by differentiation. Per reference volume (docs/theory.md, Energy):

    W      = W_iso + W_chn + W_rep
    W_iso  = lambda/2 ln^2 J + mu/2 (tr C - 3) - mu ln J
    W_chn  = c psi(r),  r^2 = sum_I l_I^2 I_I,  I_I = n_I . C n_I = f_I . f_I,  f_I = F n_I
    W_rep  = -c/2 g(r0) sum_I l_I^2 ln I_I
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from remodel_fenicsx.model.tensors import det, is_array, ln, sqrt, squared_norm

ufl = Late("ufl")
Array = NDArray[np.float64]
Term = Formula[UflOrArray]  # of F or J, lambda and mu
TURNED_OVER = ("content", "natural_length")  # what turnover changes at every point
PARAMETERS = ("lame_lambda", "lame_mu", "network_modulus", "contour_length", "end_to_end_length")  # of every tissue


class Matrix:
    """An energy of the matrix whose volumetric part is told apart, as `fem.formulations` need it.

    Called with F, lambda and mu it is the whole energy. Its terms are added one after the other: grouped otherwise, the
    last digits would be others.

    Parameters
    ----------
    volumetric
        What resists a change of volume, a function of J, lambda and mu: zero and without slope at J = 1.
    others
        All other terms, functions of F, lambda and mu; together zero and stress-free at F = I.
    parameters
        Numbers of its own, keys of `[material]`. All of its functions take them by their names.

    Where a tube closes from a sector or is cut, the terms take arrays of complex numbers: np.maximum(x, 0), not |x|.
    Directions along x, y and z are the radius, the circumference and the length of a tube on its radius.

    Examples
    --------
    A matrix that resists changes of volume by (J - 1)^2:

    >>> import numpy as np
    >>> from remodel_fenicsx.extend import MATRICES, Matrix, neo_hookean
    >>> MATRICES["quadratic"] = Matrix(lambda J, lame_lambda, mu: lame_lambda / 2 * (J - 1) ** 2, *neo_hookean.others)
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

    def of(self, values: Mapping[str, UflOrArray]) -> Matrix:
        """The matrix with these values of its parameters.

        Parameters
        ----------
        values
            By the names of `parameters`: numbers, arrays or UFL.
        """
        found = copy.copy(self)
        found.values, found.volumetric = values, partial(self.volumetric, **values)
        found.others = tuple(partial(term, **values) for term in self.others)
        return found

    def __call__(self, deformation_gradient: UflOrArray, lame_lambda: UflOrArray, lame_mu: UflOrArray) -> UflOrArray:
        """The whole energy."""
        volumetric = self.volumetric(det(deformation_gradient), lame_lambda, lame_mu)
        return sum((term(deformation_gradient, lame_lambda, lame_mu) for term in self.others), volumetric)

    def distortional(
        self, deformation_gradient: UflOrArray, lame_lambda: UflOrArray, lame_mu: UflOrArray
    ) -> UflOrArray:
        """All but the volumetric part.

        Parameters
        ----------
        deformation_gradient
            F, UFL of shape (3, 3) or array (..., 3, 3).
        lame_lambda, lame_mu
            In the unit of stress.
        """
        first, *rest = (term(deformation_gradient, lame_lambda, lame_mu) for term in self.others)
        return sum(rest, first)


def logarithmic_dilatation(
    jacobian: UflOrArray, lame_lambda: UflOrArray, lame_mu: UflOrArray, **own: UflOrArray
) -> UflOrArray:
    """U = lambda/2 ln^2 J, the volumetric part of eq. (4a): its Kirchhoff pressure is lambda ln J."""
    return lame_lambda / 2 * ln(jacobian) ** 2


# its terms pass over parameters of a matrix that adds others to them
neo_hookean = Matrix(
    logarithmic_dilatation,
    lambda F, lame_lambda, lame_mu, **own: lame_mu / 2 * (squared_norm(F) - 3),
    lambda F, lame_lambda, lame_mu, **own: -(lame_mu * ln(det(F))),
)
"""W_iso = lambda/2 ln^2 J + mu/2 (tr C - 3) - mu ln J (eq. 4a)."""


def mixed(matrices: Sequence[Matrix]) -> Matrix:
    """Matrices of parts of a body as one: each times its share there, `share_0` and so on, numbers of its own."""
    shares = [f"share_{number}" for number in range(len(matrices))]
    numbers = {name: number for matrix in matrices for name, number in matrix.parameters.items()}
    numbers |= {share: Parameter(0.0, "Where it is this one: 1, else 0.") for share in shares}

    def parts(values: Mapping[str, UflOrArray]) -> Iterator[tuple[UflOrArray, UflOrArray]]:
        for share, matrix in zip(shares, matrices, strict=True):
            yield values[share], matrix.of({name: values[name] for name in matrix.parameters})

    return Matrix(
        lambda J, lam, mu, **values: sum(share * matrix.volumetric(J, lam, mu) for share, matrix in parts(values)),
        lambda F, lam, mu, **values: sum(share * matrix.distortional(F, lam, mu) for share, matrix in parts(values)),
        parameters=numbers,
    )


MATRICES: dict[str, Term] = {"neo-hookean": neo_hookean}
"""Energies of the matrix by name: functions of F, lambda and mu (UFL or arrays), zero and stress-free at F = I; those
that formulations other than "displacement" can take are a `Matrix`."""


# ---------------------------------------------------------------- the repulsion: W_rep = -c/2 g(r0) M
# It makes the unloaded tissue stress-free. M has several forms. `axes` is the paper's (eq. 4c): it sees the axes of a
# cell. `log` sees the structure tensor A = sum_I l_I^2 n_I (x) n_I alone: it equals `axes` where C and the cell are
# coaxial, is isotropic for isotropic cells in every frame, and leaves C = I stress-free for every A (docs/theory.md,
# "The consistent variant"). `length` is the simplest function of A; it has no shear stiffness from isotropic cells.


def squared_end_to_end_length(deformation_gradient: UflOrArray, cells: Sequence[UnitCell]) -> UflOrArray:
    """r^2 = sum_I l_I^2 n_I . C n_I, the squared end-to-end length of the chains (paper, eq. 5).

    Parameters
    ----------
    deformation_gradient
        F, UFL of shape (3, 3) or array (..., 3, 3).
    cells
        One whole cell, or shares of it.

    Returns
    -------
    UFL or array (...,)
        In squared link lengths.

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


def axes_sum(deformation_gradient: UflOrArray, cells: Sequence[UnitCell], end_to_end_length: UflOrArray) -> UflOrArray:
    """M = sum_I l_I^2 ln(n_I . C n_I), of which the paper's repulsive energy is made (eq. 4c).

    Parameters
    ----------
    deformation_gradient
        F, UFL of shape (3, 3) or array (..., 3, 3).
    cells
        One whole cell, or shares of it.
    end_to_end_length
        r0, in link lengths; this form does not need it.

    Returns
    -------
    UFL or array (...,)
        In squared link lengths; zero at F = I.

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
    """M = r0^2 ln(r^2 / r0^2), r^2 = A : C; UFL or arrays."""
    squared = squared_end_to_end_length(deformation_gradient, cells)
    return end_to_end_length**2 * ln(squared / end_to_end_length**2)


def log_sum(deformation_gradient: Array, cells: Sequence[UnitCell], end_to_end_length: UflOrArray) -> UflOrArray:
    """M = A : ln C; arrays. Of complex numbers, to first order in the imaginary part."""
    C, A = np.swapaxes(deformation_gradient, -1, -2) @ deformation_gradient, whole_structure_tensor(cells)
    found = (A * tensors.logarithm(C.real)).sum(axis=(-1, -2))
    return (
        found + 1j * (log_derivatives(C.real, A, False)[0] * C.imag).sum(axis=(-1, -2)) if np.iscomplexobj(C) else found
    )


def whole_structure_tensor(cells: Sequence[UnitCell]) -> Array:
    """A of a cell, or of its shares with numbers for weights, (n, 3, 3)."""
    return sum(cell.weight * structure_tensor(cell.dimensions, cell.axes) for cell in cells)  # type: ignore


def log_derivatives(C: Array, A: Array, second: bool = True) -> tuple[Array, Array | None]:
    """dM/dC (n, 3, 3) and d^2M/dC^2 as Mandel matrices (n, 6, 6) of M = A : ln C, the second on request."""
    values, vectors = tensors.eigen(C)
    components = tensors.rotated(A, vectors)
    back = np.swapaxes(vectors, -1, -2)
    first = tensors.rotated(tensors.first_divided_differences(values) * components, back)
    if not second:
        return first, None
    rotation = tensors.congruence(vectors)
    return first, rotation @ tensors.second_derivative(values, components) @ np.swapaxes(rotation, 1, 2)


@dataclass(frozen=True)
class Repulsion(WithParameters):
    """A form of the repulsive energy.

    Attributes
    ----------
    sum
        M from (F, cells, r0): arrays, and UFL too where there are no `derivatives`.
    derivatives
        Where M is no closed expression for UFL: dM/dC (n, 3, 3) and, on request, d^2M/dC^2 as Mandel matrices (n, 6, 6)
        from (C, A, second), arrays.
    parameters
        Numbers of its own, keys of `[material]`. All of its functions take them by their names.
    values
        Of its parameters (`of`).

    Examples
    --------
    M = r^2 is another one that leaves unloaded tissue free of stress:

    >>> from remodel_fenicsx.extend import REPULSIONS, Repulsion, squared_end_to_end_length
    >>> REPULSIONS["squared"] = Repulsion(lambda F, cells, r0: squared_end_to_end_length(F, cells))
    >>> from remodel_fenicsx import preset_scene
    >>> preset_scene("kuhl-holzapfel-2007", "cube").with_values({"material.repulsion": "squared"}).material.repulsion
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

    Examples
    --------
    They are what a driver is made of:

    >>> from remodel_fenicsx.extend import DRIVERS, Stresses
    >>> stresses = Stresses(first_piola_kirchhoff="P", second_piola_kirchhoff="S", cauchy="sigma")
    >>> DRIVERS["cauchy"].tensor("F", stresses), DRIVERS["pk2"].tensor("F", stresses)
    ('sigma', 'S')
    """

    first_piola_kirchhoff: UflOrArray
    second_piola_kirchhoff: UflOrArray
    cauchy: UflOrArray

    def plus(self, deformation_gradient: UflOrArray, second_piola_kirchhoff: UflOrArray) -> Stresses:
        """With what `Tissue.strain_energy` leaves out of UFL, a second Piola-Kirchhoff stress.

        Parameters
        ----------
        deformation_gradient
            F, UFL, (3, 3).
        second_piola_kirchhoff
            What is added to S, UFL, (3, 3).
        """
        F, S = deformation_gradient, second_piola_kirchhoff
        P = ufl.dot(F, S)
        first, second, cauchy = self
        return Stresses(first + P, second + S, cauchy + ufl.dot(P, F.T) / ufl.det(F))


@dataclass(frozen=True)
class Tissue:
    """Matrix and collagen network: the constitutive parameters and what follows from them.

    Every parameter is a number, a dolfinx Constant, a DG0 function (regions) or an array over points: the same
    functions serve forms and arrays. `fem.assembly` makes one kind of the other.

    Attributes
    ----------
    lame_lambda, lame_mu
        Lame constants of the matrix, in a unit of stress.
    network_modulus
        c = omega k theta n_chn / (4 A_p), in the same unit.
    contour_length
        L, in link lengths. A chain law that does not lock may mean something else by it, or nothing.
    end_to_end_length
        r0, the initial length of a chain (erratum 3), in link lengths.
    chain
        Law of a single chain; None for a matrix without chains, which does not lock.
    matrix
        Energy of the matrix (`MATRICES`).
    repulsion
        Form of the repulsive energy (`REPULSIONS`).
    content, natural_length
        m, density of the chains, and rho, their natural length, each over those at the start (`model.laws`):
        W_net = m c (w(r/rho) - g(r0) M / 2). None where they stay 1.

    Examples
    --------
    The same functions take arrays and UFL:

    >>> import numpy as np
    >>> from remodel_fenicsx import parts
    >>> from remodel_fenicsx.extend import UnitCell
    >>> tissue = parts.Tissue(lame_lambda=27.293, lame_mu=3.103, network_modulus=2.0, contour_length=2.125,
    ...                       end_to_end_length=1.0)
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

    @property
    def locking_length(self) -> UflOrArray:
        """Length at which a chain locks, rho L, in link lengths; None where nothing locks."""
        if self.chain is None or not self.chain.locks:
            return None
        return self.contour_length if self.natural_length is None else self.natural_length * self.contour_length

    @property
    def present_modulus(self) -> UflOrArray:
        """m c: the network's modulus with the chains that there are."""
        return self.network_modulus if self.content is None else self.content * self.network_modulus

    def relative(self, length: UflOrArray) -> UflOrArray:
        """r/rho."""
        return length if self.natural_length is None else length / self.natural_length

    def stiffness(self, end_to_end_length: UflOrArray) -> UflOrArray:
        """A stress per strain of matrix and network, where chains have a length r; times eps the rounding of a stress.

        lambda + 2 mu + c (r^2 d(g r)/dr + g(r0) r0^2): near the contour length the chains' force changes by much more
        than itself when r changes by a little.

        Parameters
        ----------
        end_to_end_length
            r, in link lengths; numbers, arrays or UFL.
        """
        matrix = self.lame_lambda + 2 * self.lame_mu
        if self.chain is None:
            return matrix
        r, r0 = self.relative(end_to_end_length), self.end_to_end_length
        L, g = self.contour_length, self.chain.stiffness
        h = 1e-6 * r * (1 - r / L if self.chain.locks else 1)
        slope = ((r + h) * g(r + h, L) - (r - h) * g(r - h, L)) / (2 * h)
        return matrix + self.present_modulus * (r**2 * slope + g(r0, L) * r0**2)

    @property
    def parameters(self) -> dict[str, UflOrArray]:
        """Every parameter by its name: of all tissues, of turnover where there is any, and those that parts have."""
        turned_over = [name for name in TURNED_OVER if getattr(self, name) is not None]
        found = {name: getattr(self, name) for name in (*PARAMETERS, *turned_over)}
        for part in self._own_parameters.values():
            found |= part
        return found

    @property
    def _own_parameters(self) -> dict[str, Mapping[str, UflOrArray]]:
        """Of chain, matrix and repulsion, where they have any."""
        values = {name: getattr(getattr(self, name), "values", None) for name in ("chain", "matrix", "repulsion")}
        return {name: own for name, own in values.items() if own}

    def map(self, function: Callable[[str, UflOrArray], UflOrArray]) -> Tissue:
        """The same tissue with function(name, value) for every parameter."""
        found = {name: function(name, value) for name, value in self.parameters.items()}
        own = {
            part: getattr(self, part).of({name: found[name] for name in names})
            for part, names in self._own_parameters.items()
        }
        return replace(self, **{name: found[name] for name in found if name in PARAMETERS + TURNED_OVER}, **own)

    def is_round(self) -> bool:
        """Whether a turn about z before the deformation leaves the energy of the matrix."""
        pulled, (c, s) = np.diag([1.1, 1.3, 1.2]), (0.8, 0.6)
        turned = pulled @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        found, again = (self.matrix(F, self.lame_lambda, self.lame_mu) for F in (pulled, turned))
        return bool(np.isclose(found, again, rtol=1e-9))

    def strain_energy(self, deformation_gradient: UflOrArray, cells: Sequence[UnitCell]) -> UflOrArray:
        """W per reference volume (eqs. 3 and 4 with errata 1 and 2), in the unit of the Lame constants.

        Parameters
        ----------
        deformation_gradient
            F, UFL of shape (3, 3) or array (..., 3, 3).
        cells
            The unit cell: one whole cell, or shares whose weights add up to one.

        In UFL a repulsion that has derivatives of its own (`Repulsion.derivatives`) is left out: these enter forms as
        values at the quadrature points (`solver.equilibrium.PointwiseRepulsion`).
        """
        energy = self.matrix(deformation_gradient, self.lame_lambda, self.lame_mu)
        return self._with_network(energy, deformation_gradient, cells)

    def distortional_energy(self, deformation_gradient: UflOrArray, cells: Sequence[UnitCell]) -> UflOrArray:
        """W without the volumetric part of the matrix; as `strain_energy`, which it makes together with that part."""
        energy = self._parts().distortional(deformation_gradient, self.lame_lambda, self.lame_mu)
        return self._with_network(energy, deformation_gradient, cells)

    def volumetric_energy(self, jacobian: UflOrArray) -> UflOrArray:
        """The volumetric part of the matrix, U(J).

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
            "the volumetric part of this matrix energy is not told apart: it must be a remodel_fenicsx.extend.Matrix"
        )

    def _with_network(
        self, energy: UflOrArray, deformation_gradient: UflOrArray, cells: Sequence[UnitCell]
    ) -> UflOrArray:
        """An energy plus that of the chains, where there are any."""
        if self.chain is None:
            return energy
        length = sqrt(squared_end_to_end_length(deformation_gradient, cells))
        chains = self.chain.energy(self.relative(length), self.contour_length)
        if not is_array(deformation_gradient) and self.repulsion.derivatives is not None:
            return energy + self.present_modulus * chains
        stiffness = self.chain.stiffness(self.end_to_end_length, self.contour_length)
        repulsion = -stiffness / 2 * self.repulsion.sum(deformation_gradient, cells, self.end_to_end_length)
        return energy + self.present_modulus * (chains + repulsion)

    @property
    def repulsion_modulus(self) -> UflOrArray:
        """m c g(r0): W_rep = -m c g(r0) M / 2."""
        assert self.chain is not None
        return self.present_modulus * self.chain.stiffness(self.end_to_end_length, self.contour_length)

    def stresses(self, deformation_gradient: UflOrArray, cells: Sequence[UnitCell]) -> Stresses:
        """P = dW/dF, S = F^-1 P and sigma = P F^T / J (eqs. 6 and 7 with erratum 5), by differentiation of W; UFL.

        Parameters
        ----------
        deformation_gradient
            F, UFL of shape (3, 3).
        cells
            The unit cell: one whole cell, or shares whose weights add up to one.
        """
        F = ufl.variable(deformation_gradient)
        return _stresses(F, ufl.diff(self.strain_energy(F, cells), F))

    def stresses_of_parts(
        self, deformation_gradient: UflOrArray, cells: Sequence[UnitCell], jacobian: UflOrArray
    ) -> Stresses:
        """The same with U at another J than det F: P = d(W - U)/dF + J U'(J) F^-T, J U' the Kirchhoff pressure; UFL."""
        F, J = ufl.variable(deformation_gradient), ufl.variable(jacobian)
        pressure = J * ufl.diff(self.volumetric_energy(J), J)
        return _stresses(F, ufl.diff(self.distortional_energy(F, cells), F) + pressure * ufl.inv(F).T)

    def energy_increment(self, deformation_gradient: UflOrArray, old: UnitCell, new: UnitCell) -> UflOrArray:
        """First-order change of W at frozen F when the cells become others, per reference volume; arrays.

        W depends on the cells through r^2 = A : C and M = sum_I l_I^2 ln I_I only:
        dW = c g(r)/2 d(r^2) - c/2 g(r0) dM, taken at the old cells, where r < L. (Remark 6; the new cells themselves
        may have r > L until the next solve, so their energy is not always defined.)

        Parameters
        ----------
        deformation_gradient
            F, (..., 3, 3).
        old, new
            The cells, (..., 3) and (..., 3, 3).
        """
        F, r0 = deformation_gradient, self.end_to_end_length
        if self.chain is None:
            return 0.0 * det(F)
        squared, squared_after = (squared_end_to_end_length(F, [cell]) for cell in (old, new))
        stiffness = self.chain.stiffness(self.relative(sqrt(squared)), self.contour_length)
        if self.natural_length is not None:
            stiffness = stiffness / self.natural_length**2
        chains = self.present_modulus / 2 * stiffness * (squared_after - squared)
        repulsion = self.repulsion.sum(F, [new], r0) - self.repulsion.sum(F, [old], r0)
        return chains - self.repulsion_modulus / 2 * repulsion

    def turnover_increment(
        self, deformation_gradient: UflOrArray, cell: UnitCell, content: UflOrArray, natural_length: UflOrArray
    ) -> UflOrArray:
        """First-order change of W at frozen F and cells when ln m and ln rho change, per reference volume; arrays.

        dW = W_net d ln m - m c g(r/rho) (r/rho)^2 d ln rho.

        Parameters
        ----------
        deformation_gradient, cell
            F (..., 3, 3) and the unit cell.
        content, natural_length
            Changes of ln m and ln rho, (...).
        """
        assert self.chain is not None
        F, cells = deformation_gradient, [cell]
        length = self.relative(sqrt(squared_end_to_end_length(F, cells)))
        tension = self.present_modulus * self.chain.stiffness(length, self.contour_length) * length**2
        return self._with_network(0.0, F, cells) * content - tension * natural_length


def _stresses(F: UflOrArray, first: UflOrArray) -> Stresses:
    """All of them from P; UFL."""
    return Stresses(first, ufl.dot(ufl.inv(F), first), ufl.dot(first, F.T) / ufl.det(F))
