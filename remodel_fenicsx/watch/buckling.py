"""Whether a body that a reduction keeps in its symmetry would buckle: thrust, and suction on a ring."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.reductions import Strut
from remodel_fenicsx.evolution.stepper import Step, Stepper
from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.state.state import at_points
from remodel_fenicsx.watch.warnings import WarnsOnce

Array = NDArray[np.float64]
STRAINS = {1: 1e-5, 2: 1e-3}  # of the differences of W that make stresses and moduli: these are right to about 1e-6
# The estimate is 0.8 to 1.1 where whole slender tubes lose their stability (docs/theory.md, Buckling)
WARNED_LOAD = 0.9
ACROSS, AROUND, ALONG = range(3)
_SIGNS = {1: np.array([[1.0], [-1.0]]), 2: np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])}


class BucklingWarning(WarnsOnce):
    """Says once that the whole body would buckle, where a reduced kinematics cannot."""

    name = "buckling"

    def __init__(self, stepper: Stepper, strut: Strut):
        super().__init__(stepper)
        self.strut = strut

    def look(self, step: Step | None = None) -> str:
        """What is too much in the present state; nothing where it is stable."""
        shares = {"thrust along z": self.thrust_share(), "suction": self.suction_share()}
        said = [
            f"{name} is about {share:.2g} times what it can bear"
            for name, share in shares.items()
            if share > WARNED_LOAD
        ]
        if not said:
            return ""
        return (
            f"the whole body would buckle: its {' and its '.join(said)}. Kinematics {self.state.kinematics.name!r} "
            "cannot show that; set model.kinematics = 'full' (docs/theory.md, Buckling)"
        )

    def thrust_share(self) -> float:
        """Thrust over Euler's load; 0 under tension."""
        thrust = self.thrust()
        return thrust / self.euler_load() if thrust > 0 else 0.0

    def thrust(self) -> float:
        """Of the wall and of what fills the cavity, along z."""
        stress = self._derivatives([(ALONG,)])[0]
        force = self._integral(stress) / self._length()
        if self.strut.radii is None:
            return -force
        return self.state.loading.values.get("pressure", 0.0) * np.pi * self._radii()[0] ** 2 - force

    def euler_load(self) -> float:
        """Of the present body."""
        H = self._moduli()
        across = H[:2, :2]
        coupling = H[:2, ALONG].T[..., None]
        modulus = H[ALONG, ALONG] - (coupling * np.linalg.solve(np.moveaxis(across, -1, 0), coupling)).sum(axis=(1, 2))
        stretch = np.einsum("nij,nj->ni", self._gradients(), self._directions[:, :, AROUND])
        squares = self.strut.squared_distances(self._places) * np.square(stretch).sum(axis=1)
        length = self._length()
        return self.strut.euler_load(self._integral(modulus * squares) / length, length)

    def suction_share(self) -> float:
        """Pressure below zero over that at which the wall turns oval, a ring in plane strain."""
        if self.strut.radii is None or self.state.loading.values.get("pressure", 0.0) >= 0:
            return 0.0
        (inner, outer), H = self._radii(), self._moduli()
        modulus = H[AROUND, AROUND] - H[AROUND, ACROSS] ** 2 / H[ACROSS, ACROSS]
        area = np.pi * (outer**2 - inner**2)
        stiffness = self._integral(modulus) / (self._length() * area) * (outer - inner) ** 3 / 12
        return float(
            -self.state.loading.values.get("pressure", 0.0) * inner / (3 * stiffness / ((inner + outer) / 2) ** 2)
        )

    # ------------------------------------------------------------ the present state
    def _gradients(self) -> Array:
        """F at this rank's points, (n, 3, 3)."""
        return self.stepper.coupling.equilibrium.look().states[:, 2:].reshape(-1, 3, 3)

    def _length(self) -> float:
        stretch = self._integral(self._gradients()[:, 2, 2]) / self._integral(np.ones(len(self._places)))
        return self.strut.length * stretch

    def _radii(self) -> tuple[float, float]:
        """Of the cavity's wall, inside and outside: means over the nodes there."""
        assert self.strut.radii is not None
        kinematics, unknown = self.state.kinematics, self.state.unknown
        nodes = kinematics.nodal_space(unknown).tabulate_dof_coordinates()
        deformed = np.linalg.norm((nodes + kinematics.nodal_displacement(unknown))[:, :2], axis=1)
        reference = np.linalg.norm(nodes[:, :2], axis=1)
        at = [np.isclose(reference, radius, rtol=1e-6) for radius in self.strut.radii]
        local = np.array([[deformed[here].sum(), here.sum()] for here in at])
        inner, outer = self.state.comm.allreduce(local, MPI.SUM)
        return float(inner[0] / inner[1]), float(outer[0] / outer[1])

    def _integral(self, values: Array) -> float:
        """Over the reference body, of values (n,)."""
        return self.quadrature.integral(values.reshape(-1, self.quadrature.shape[1]))

    def _moduli(self) -> Array:
        """Second derivatives of W by logarithmic strains, (3, 3, n)."""
        pairs = [(i, j) for i in range(3) for j in range(i + 1)]
        H = np.empty((3, 3, len(self._places)))
        for (i, j), values in zip(pairs, self._derivatives(pairs), strict=True):
            H[i, j] = H[j, i] = values
        return H

    def _derivatives(self, wanted: Sequence[tuple[int, ...]]) -> list[Array]:
        """Of W at the points, by one or two logarithmic strains of the present body each: central differences."""
        room = 1 - max(0.0, self.stepper.coupling.equilibrium.extension().max_chain_extension)  # no chain reaches L
        steps = [STRAINS[len(key)] * room for key in wanted]
        strains = []
        for key, h in zip(wanted, steps, strict=True):
            for signs in _SIGNS[len(key)]:
                strain = np.zeros(3)
                np.add.at(strain, list(key), h * signs)
                strains.append(strain)
        energies, found = self._energies(np.array(strains)), []
        for key, h in zip(wanted, steps, strict=True):
            weights = _SIGNS[len(key)].prod(axis=1) / (2 * h) ** len(key)
            found.append(weights @ energies[: len(weights)])
            energies = energies[len(weights) :]
        return found

    def _energies(self, strains: Array) -> Array:
        """W at the points (k, n) after further stretches exp(strains), (k, 3), along the directions."""
        Q = self._directions
        stretch = (Q * np.exp(strains)[:, None, None]) @ Q.swapaxes(1, 2)
        F = self._as_elements_take_it()
        cells = self.state.cells.point_cells
        number = len(F)
        cell = UnitCell(cells.dimensions[:number], cells.axes[:number])
        energies: Array = self._tissue.strain_energy(stretch @ F, [cell])
        return energies

    def _as_elements_take_it(self) -> Array:
        """F, with one J in an element where differences of it cost nothing."""
        F = self._gradients()
        if self.state.dilatation.jacobians().size == 0:
            return F
        states = np.log(self.stepper.coupling.equilibrium.look().states[:, 1]).reshape(-1, self.quadrature.shape[1], 1)
        return F * np.exp(-self.quadrature.beyond(0, states).reshape(-1) / 3)[:, None, None]

    @cached_property
    def _places(self) -> Array:
        return self.quadrature.owned(self.quadrature.coordinates).reshape(-1, 3)

    @cached_property
    def _directions(self) -> Array:
        return self.strut.directions(self._places)

    @cached_property
    def _tissue(self) -> Tissue:
        number = len(self._places)
        return at_points(self.stepper.tissue, self.quadrature).map(lambda name, value: value[:number])
