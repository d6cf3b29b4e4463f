"""State of a simulation: unknowns, unit cells, loads, time, and the parameters of the tissue."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

import dolfinx.fem
import numpy as np

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx.body.domain import Domain, dof_of_node
from remodel_fenicsx.body.loading import Loading
from remodel_fenicsx.fem import assembly, jit
from remodel_fenicsx.fem.assembly import CachedValue
from remodel_fenicsx.fem.formulations import FORMULATIONS, Formulation
from remodel_fenicsx.fem.kinematics import Kinematics
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.kernels import PointKernels, point_kernels, with_kernels
from remodel_fenicsx.model.axes import AXES, LocalAxes, cells_from_tensors, structure_tensors
from remodel_fenicsx.model.cells import UnitCell, turned_about_z
from remodel_fenicsx.model.energy import (
    AXES_ON_THE_RADIUS,
    ELASTIN,
    MATRICES,
    TURNED_OVER,
    Tissue,
    mixture_matrix,
)
from remodel_fenicsx.model.tensors import Array, Flags, Integers
from remodel_fenicsx.schema.settings import Cells, MEASURED_CELLS, Properties

if TYPE_CHECKING:
    from mpi4py import MPI


# ---------------------------------------------------------------- unit cells at quadrature points


@with_old_names
class CellField:
    """Cell dimensions and axes as quadrature functions.

    Attributes
    ----------
    dimensions, axes
        dolfinx quadrature functions of shape (3,) and (3, 3); row I of `axes` is n_I.
    dimension_values, axis_values
        l_I (elements, points, 3), and n_I as rows (elements, points, 3, 3); views of the functions'
        arrays.
    point_cells
        Cells flattened over the quadrature points, (elements * points, ...); views of the
        functions' arrays.
    """

    def __init__(self, quadrature: Quadrature, name: str):
        self.quadrature = quadrature
        self.dimensions = quadrature.function(f"{name}_dimensions", (3,))
        self.axes = quadrature.function(f"{name}_axes", (3, 3))
        self.dimension_values = quadrature.values(self.dimensions, (3,))
        self.axis_values = quadrature.values(self.axes, (3, 3))
        self.point_cells = UnitCell(
            self.dimension_values.reshape(-1, 3), self.axis_values.reshape(-1, 3, 3)
        )

    @property
    def symbolic_cell(self) -> UnitCell:
        """Unit cell of the functions, for UFL forms."""
        return UnitCell(self.dimensions, self.axes)

    def set(self, dimensions: Array, axes: Array) -> None:
        """Replace all dimensions and axes, by element and point or flattened.

        Parameters
        ----------
        dimensions, axes
            l_I (elements, points, 3) or (n, 3), and n_I as rows (elements, points, 3, 3) or
            (n, 3, 3).
        """
        self.point_cells.dimensions[:] = dimensions.reshape(-1, 3)
        self.point_cells.axes[:] = axes.reshape(-1, 3, 3)

    def equals(self, other: CellField) -> bool:
        """Return whether all values of this rank are equal."""
        pairs = (self.dimensions, other.dimensions), (self.axes, other.axes)
        return all(np.array_equal(a.x.array, b.x.array) for a, b in pairs)

    @cached_property
    def kernels(self) -> PointKernels:
        """Kernels of the pass at points. Collective on first access."""
        return point_kernels(self.quadrature.mesh.comm)

    def structure_tensor(self) -> Array:
        """Return A = sum_I l_I^2 n_I (x) n_I in squared link lengths. Collective on first call.

        Returns
        -------
        array (elements, points, 3, 3)
            The structure tensors.
        """
        return self.kernels.structure_tensor(self.dimension_values, self.axis_values)


class UnitCells(CellField):
    """Orthotropic unit cells at the quadrature points (paper, Fig. 2).

    Parameters
    ----------
    quadrature
        Quadrature points.
    domain
        Mesh with the numbers of its elements in the file's order. These index the random numbers,
        so that random cells do not depend on the number of ranks.
    settings
        Initial dimensions, axes, seed, r0.
    local_axes
        Local axes of the body at the points (`Shape.local_axes`).
    regions
        Settings by name of regions whose initial dimensions or r0 differ.
    fibres
        Measured fibres of all elements, (number_of_elements, columns) by name of
        `model.axes.MEASURED`, by region; "" is the whole body.

    Attributes
    ----------
    local_axes
        Local axes of the body at the points.
    initial_dimensions
        l0_I by rank (not by direction), shape (elements, points, 3), in link lengths.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> cells = simulation.cells
    >>> cells.dimension_values.shape, cells.axis_values.shape
    ((1, 8, 3), (1, 8, 3, 3))
    >>> cells.structure_tensor()[0, 0].round(4)
    array([[0.3333, 0.    , 0.    ],
           [0.    , 0.3333, 0.    ],
           [0.    , 0.    , 0.3333]])
    """

    def __init__(
        self,
        quadrature: Quadrature,
        domain: Domain,
        settings: Cells,
        local_axes: LocalAxes,
        regions: Mapping[str, Cells] = MappingProxyType({}),
        fibres: Mapping[str, Mapping[str, Array]] = MappingProxyType({}),
    ):
        super().__init__(quadrature, "cell")
        self.settings, self.local_axes = settings, local_axes
        self.prepared: list[Parameters] = []  # tissues on this mesh (`State.parameters`)
        self.axis_values[:] = axes = self.initial_axes()
        everywhere = np.ones(len(domain.element_number), dtype=np.bool_)
        for name, cells in {"": settings, **regions}.items():
            chosen = domain.element_region == domain.regions[name] if name else everywhere
            if name in fibres:
                measured = {
                    key: values[domain.element_number[chosen]]
                    for key, values in fibres[name].items()
                }
                self._take(measured, chosen, axes[chosen], cells.end_to_end_length)
            elif cells.initial != MEASURED_CELLS:
                drawn = cells.dimensions(domain.number_of_elements)
                self.dimension_values[chosen] = drawn[domain.element_number[chosen]][:, None, :]
                self.axis_values[chosen] = axes[chosen]
        self.initial_dimensions = self.dimension_values.copy()

    def _take(
        self, measured: Mapping[str, Array], chosen: Flags, axes: Array, length: float
    ) -> None:
        """Set cells of chosen elements from measured fibres; `axes` replace undetermined axes."""
        at_points = {name: values[:, None, :] for name, values in measured.items()}
        tensors = np.broadcast_to(
            structure_tensors(at_points, self.local_axes.axes[chosen]), axes.shape
        )
        self.dimension_values[chosen], self.axis_values[chosen] = cells_from_tensors(
            tensors, length, axes
        )

    def initial_axes(self) -> Array:
        """Return the initial axes n_I as rows, (elements, points, 3, 3)."""
        axes = AXES[self.settings.axes](self.local_axes)
        return turned_about_z(axes, self.settings.mean_angle)


# ---------------------------------------------------------------- the state


@dataclass(frozen=True)
class Snapshot:
    """Values of a state: arrays by function name, loads, time, number of steps, other numbers."""

    arrays: dict[str, Array]
    loads: dict[str, float]
    time: float
    number: int
    numbers: dict[str, float]
    others: Sequence[Snapshot] = ()


@with_old_names
class State:
    """State of a simulation: unknowns, unit cells, loads and time.

    Parameters
    ----------
    unknown
        dolfinx function of the unknowns (for full kinematics the displacement).
    kinematics
        Kinematics that map the unknowns to the deformation gradient.
    cells
        The unit cells.
    loading
        Supports and loads; the magnitudes belong to the state.
    formulation
        Formulation of the volumetric energy in the elements; default: "displacement".

    Attributes
    ----------
    comm
        Communicator of the mesh.
    number_of_owned_unknowns
        Number of unknowns that this rank owns; in arrays ghosts follow them.
    dilatation
        The formulation for these unknowns.
    equilibrium_cells
        Cells with which the unknowns are in equilibrium. After a staggered step `cells` are one
        pass ahead.
    time, number
        Time and number of the last committed step.
    numbers
        Other numbers that carry over from step to step, by name. A coupling stores its numbers
        here, and its functions by `remember`.
    counts
        Names of functions that a checkpoint may lack, each with the name of a number that counts
        the known functions and is then 0.
    others, weights
        States of further load cases with the same cells, which snapshots and checkpoints contain
        too; and weights of all load cases, this state's first.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> simulation = Simulation(preset_scene("kuhl-holzapfel-2007", "cube"))
    >>> state = simulation.state
    >>> start = state.snapshot()
    >>> for _, step in zip(range(3), simulation.steps()):
    ...     pass
    >>> state.time, state.number, state.deformation_gradient().shape  # F, flattened over the points
    (3.0, 3, (8, 3, 3))
    >>> state.restore(start)
    >>> state.time, float(abs(simulation.unknown.x.array).max())
    (0.0, 0.0)
    """

    def __init__(
        self,
        unknown: dolfinx.fem.Function,
        kinematics: Kinematics,
        cells: UnitCells,
        loading: Loading,
        formulation: Formulation = FORMULATIONS["displacement"],
    ):
        self.unknown, self.kinematics = unknown, kinematics
        self.cells, self.loading = cells, loading
        dofmap, mesh = unknown.function_space.dofmap, cells.quadrature.mesh
        self.comm: MPI.Intracomm = mesh.comm
        self.number_of_owned_unknowns = int(dofmap.index_map.size_local * dofmap.index_map_bs)
        self.dilatation = formulation.discretise(kinematics, unknown, cells.quadrature)
        F = kinematics.deformation_gradient(unknown)
        # G, if the mesh is not stress-free, and its initial value, if the body grows.
        self._natural = getattr(kinematics, "gradient", None)
        self._initial = getattr(kinematics, "initial", None)
        self._deformation_gradient = jit.expression(F, cells.quadrature.points)
        self._cached_gradient: CachedValue[Array] = CachedValue(None, F)
        F_e = kinematics.elastic_gradient(unknown)
        self._cached_elastic_gradient: CachedValue[Array] = CachedValue(None, F_e)
        self.equilibrium_cells = CellField(cells.quadrature, "equilibrium_cell")
        self.other_cases: Sequence[State] = ()
        self.weights: Sequence[float] = (1.0,)
        self.label = ""  # prefix of log lines with several load cases
        # Called on each rank in every solve: returns the signal (SIGINT, SIGTERM) that should end
        # it, or 0.
        self.stop_signal: Callable[[], int] = lambda: 0
        self.tell: Callable[[str], object] = lambda words: None  # shows the progress of substeps
        self.mark_cells_in_equilibrium()
        solved = self.equilibrium_cells
        own = unknown, cells.dimensions, cells.axes, solved.dimensions, solved.axes
        self._functions = {function.name: function for function in own}
        self.time, self.number = 0.0, 0
        self.numbers: dict[str, float] = {}
        self.counts: dict[str, str] = {}
        # The body starts unloaded. A load with a value at t = 0 acts from the first step on.
        loading.set(dict.fromkeys(loading.values, 0.0))

    @cached_property
    def _dof_of_node(self) -> Integers:
        return dof_of_node(self.loading.domain.mesh, self.kinematics.nodal_space(self.unknown))

    def gathered_displacement(self) -> Array | None:
        """Return the displacement of mesh nodes in the mesh file's order on rank 0. Collective.

        Returns
        -------
        array (n, 3) or None
            None on other ranks.
        """
        return self.loading.domain.gather_nodes(
            self.kinematics.nodal_displacement(self.unknown)[self._dof_of_node]
        )

    def deformation_gradient(self) -> Array:
        """Return F of the present unknowns, flattened over the quadrature points of this rank.

        Returns
        -------
        array (elements * points, 3, 3)
            F with ghost elements; read-only.
        """
        quadrature = self.cells.quadrature
        expression = self._deformation_gradient
        return self._cached_gradient(
            lambda: quadrature.evaluate(expression, (3, 3)).reshape(-1, 3, 3)
        )

    @property
    def natural_gradient(self) -> Array | None:
        """G at all points, (elements, points, 3, 3); None if the mesh is stress-free."""
        return (
            None if self._natural is None else self.cells.quadrature.values(self._natural, (3, 3))
        )

    def elastic(self, deformation_gradient: Array) -> Array:
        """Return F_e = F G, or F if the mesh is stress-free.

        Parameters
        ----------
        deformation_gradient
            F, (elements, points, 3, 3).
        """
        G = self.natural_gradient
        return deformation_gradient if G is None else deformation_gradient @ G

    def elastic_axes(self, axes: Array, deformation_gradient: Array | None = None) -> Array:
        """Return axes convected by F_e, or without an F by G to the unloaded configuration.

        Parameters
        ----------
        axes
            Rows, (elements, points, 3, 3).
        deformation_gradient
            F, (elements, points, 3, 3), or None.
        """
        gradient = (
            self.natural_gradient
            if deformation_gradient is None
            else self.elastic(deformation_gradient)
        )
        return axes if gradient is None else axes @ np.swapaxes(gradient, -1, -2)

    def elastic_gradient(self) -> Array:
        """Return F_e of the present unknowns, flattened, (elements * points, 3, 3); read-only."""
        if self._natural is None:
            return self.deformation_gradient()
        shape = (*self.cells.quadrature.shape, 3, 3)
        return self._cached_elastic_gradient(
            lambda: self.elastic(self.deformation_gradient().reshape(shape)).reshape(-1, 3, 3)
        )

    def parameters(self, tissue: Tissue) -> Parameters:
        """Return the parameters of a tissue on this mesh, cached. Collective on first call.

        Parameters
        ----------
        tissue
            Tissue with numbers, or as in `Parameters.tissue`.
        """
        for prepared in self.cells.prepared:
            if tissue is prepared.given or tissue is prepared.tissue:
                return prepared
        prepared = Parameters(tissue, self.cells)
        self.cells.prepared.append(prepared)
        return prepared

    def per_mesh_volume(self, values: Array) -> Array:
        """Convert values per initial stress-free volume to values per mesh volume.

        Parameters
        ----------
        values
            Values at points, (elements, points) or flattened.

        Returns
        -------
        array (elements, points)
            The converted values.
        """
        quadrature = self.cells.quadrature
        values = values.reshape(quadrature.shape)
        return (
            values
            if self._initial is None
            else values / np.linalg.det(quadrature.values(self._initial, (3, 3)))
        )

    def functions(self) -> dict[str, dolfinx.fem.Function]:
        """Return all dolfinx functions of the state by name; further load cases add "@2", ..."""
        shared = {self.cells.dimensions.name, self.cells.axes.name}
        functions = dict(self._functions)
        for mark, case in list(self.each_case().items())[1:]:
            functions |= {
                f"{name}{mark}": function
                for name, function in case._functions.items()
                if name not in shared
            }
        return functions

    def join(self, others: Sequence[State], weights: Sequence[float]) -> None:
        """Add states of further load cases with the same cells.

        Parameters
        ----------
        others
            The states.
        weights
            Weights of all load cases, this state's first.
        """
        self.other_cases, self.weights = list(others), tuple(weights)

    def each_case(self) -> dict[str, State]:
        """Return the states of all load cases by suffix: "" for this state, then "@2", ..."""
        return {"": self} | {
            f"@{number}": case for number, case in enumerate(self.other_cases, start=2)
        }

    def complete_step(self, time: float, number: int) -> None:
        """Set time and number of a completed step in all load cases.

        Parameters
        ----------
        time
            Time of the step.
        number
            Number of steps so far.
        """
        for case in (self, *self.other_cases):
            case.time, case.number = time, number

    def remember(self, function: dolfinx.fem.Function, count: str | None = None) -> None:
        """Add a dolfinx function with a unique name to the state.

        Transactions restore the function, and checkpoints contain it. A coupling stores in it what
        carries over from step to step.

        Parameters
        ----------
        function
            The function.
        count
            Name of a number that counts the known functions of this kind; with it a checkpoint may
            lack the function.

        Raises
        ------
        ValueError
            If the state already has a function of this name.
        """
        if function.name in self._functions:
            raise ValueError(f"the state has a function {function.name!r} already")
        self._functions[function.name] = function
        if count is not None:
            self.counts[function.name] = count

    def mark_cells_in_equilibrium(self) -> None:
        """Mark the present cells as those with which the unknowns are in equilibrium."""
        self.equilibrium_cells.set(self.cells.dimension_values, self.cells.axis_values)

    def snapshot(self) -> Snapshot:
        """Return a copy of all values."""
        arrays = {name: function.x.array.copy() for name, function in self._functions.items()}
        others = [case.snapshot() for case in self.other_cases]
        return Snapshot(
            arrays, dict(self.loading.values), self.time, self.number, dict(self.numbers), others
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Restore all values from a snapshot.

        Parameters
        ----------
        snapshot
            Values of this state.
        """
        for name, function in self._functions.items():
            function.x.array[:] = snapshot.arrays[name]
        self.loading.set(snapshot.loads)
        self.time, self.number = snapshot.time, snapshot.number
        self.numbers = dict(snapshot.numbers)
        for case, values in zip(self.other_cases, snapshot.others, strict=True):
            case.restore(values)

    @contextmanager
    def tentative(self) -> Iterator[None]:
        """Restore the state after the block."""
        before = self.snapshot()
        try:
            yield
        finally:
            self.restore(before)

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Restore the state if the block raises."""
        before = self.snapshot()
        try:
            yield
        except BaseException:
            self.restore(before)
            raise


# ---------------------------------------------------------------- values of earlier steps
# They are functions and numbers of the state, so that resumed runs have them too.


class StateNumbers:
    """Numbers of the state with a prefix; transactions restore them, checkpoints contain them."""

    def __init__(self, state: State, name: str, initial: Mapping[str, float]):
        self.state, self.name = state, name
        self.initial = dict(initial)
        # Computed once, because steps read numbers often.
        self._keys = {key: f"{name}_{key}" for key in self.initial}

    def __getitem__(self, key: str) -> float:
        return self.state.numbers.get(self._keys[key], self.initial[key])

    def __setitem__(self, key: str, value: float) -> None:
        """Set a number, which must be equal on all ranks."""
        self.state.numbers[self._keys[key]] = float(value)

    def forget(self) -> None:
        """Reset all numbers to their initial values."""
        for key, value in self.initial.items():
            self[key] = value


class FieldHistory:
    """Last values of a field, stored as functions of the state."""

    def __init__(
        self,
        state: State,
        name: str,
        make: Callable[[], dolfinx.fem.Function],
        count: int,
    ):
        self._functions = []
        for age in range(count):
            function = make()
            function.name = f"{name}_{age}"
            state.remember(function, f"{name}_known")
            self._functions.append(function)
        self._arrays: list[Array] = [function.x.array for function in self._functions]
        self._numbers = StateNumbers(state, name, {"known": 0})

    @property
    def known(self) -> int:
        """Number of stored values."""
        return int(self._numbers["known"])

    @property
    def values(self) -> list[Array]:
        """Stored values, newest first, with ghosts; the functions' arrays."""
        return self._arrays[: self.known]

    def push(self, values: Array) -> None:
        """Add a value with ghosts, and drop the oldest."""
        for age in range(len(self._arrays) - 1, 0, -1):
            self._arrays[age][:] = self._arrays[age - 1]
        self._arrays[0][:] = values
        self._numbers["known"] = min(self.known + 1, len(self._arrays))

    def push_owned(self, values: Array) -> None:
        """Add a value without ghosts. Collective."""
        padded = np.zeros_like(self._arrays[0])
        padded[: len(values)] = values
        self.push(padded)
        self._functions[0].x.scatter_forward()

    def forget(self) -> None:
        """Reset the number of values to 0."""
        self._numbers.forget()


# ---------------------------------------------------------------- tissue parameters on a mesh
# Numbers and arrays are recomputed only if a parameter has changed.


def tissue_at_points(tissue: Tissue, quadrature: Quadrature) -> Tissue:
    """Return a tissue with parameters as arrays over the points, (elements * points,)."""
    if tissue.elastin_axial is not None:
        axes = quadrature.values(tissue.elastin_axes, (3, 3)).reshape(-1, 3, 3)
        tissue = replace(tissue, elastin_axes=axes)
    return tissue.map(lambda name, value: assembly.point_values(value, quadrature).reshape(-1))


def stress_rounding(numbers: Tissue, max_chain_extension: float) -> float:
    """Return the rounding error of a stress, from the tissue's stiffness at the largest r/L."""
    length = numbers.end_to_end_length
    if numbers.locking_length is not None:
        length = max(length, max_chain_extension * numbers.locking_length)
    return float(np.finfo(np.float64).eps * numbers.stiffness(length))


def region_function(domain: Domain, values: Mapping[str, float]) -> dolfinx.fem.Function:
    """Return a DG0 Function with values by region name; "" is the value of all other regions."""
    function = dolfinx.fem.Function(dolfinx.fem.functionspace(domain.mesh, ("DG", 0)))
    dofmap = function.function_space.dofmap
    dofs = dofmap.list.reshape(-1)
    for name, number in domain.regions.items():
        function.x.array[dofs[domain.element_region == number]] = values[
            name if name in values else ""
        ]
    return function


class Parameters:
    """Tissue on a mesh, and present values of its parameters.

    Attributes
    ----------
    given, tissue
        The tissue, and the tissue with Constants in place of numbers, so that a new number needs no
        compilation.
    compiled
        The tissue with its repulsion in C.
    """

    def __init__(self, tissue: Tissue, cells: UnitCells):
        self.given = tissue
        self.quadrature = quadrature = cells.quadrature
        mesh = quadrature.mesh
        if tissue.elastin_axial is not None:
            axes = quadrature.function("elastin_axes", (3, 3))
            quadrature.values(axes, (3, 3))[:] = cells.local_axes.axes
            tissue = replace(tissue, elastin_axes=axes)
        self.tissue = tissue.map(
            lambda name, value: (
                value if name in TURNED_OVER else assembly.coefficient(mesh, name, value)
            )
        )
        self.compiled = with_kernels(self.tissue, mesh.comm)
        values = list(self.tissue.parameters.values())
        self._largest: CachedValue[Tissue] = CachedValue(mesh.comm, *values)
        self._at_points: CachedValue[Tissue] = CachedValue(None, *values)

    def largest(self) -> Tissue:
        """Return the tissue with the largest value of each parameter in the body. Collective."""

        def largest_values() -> Tissue:
            maxima = replace(self.compiled, elastin_axes=AXES_ON_THE_RADIUS).map(
                lambda name, value: self.quadrature.maximum(
                    assembly.point_values(value, self.quadrature)
                )
            )
            if not isinstance(self.tissue.contour_length, dolfinx.fem.Function):
                return maxima
            lengths = self.at_points().contour_length.reshape(self.quadrature.shape)
            of_chains = self.quadrature.maximum(np.where(self.has_chains(), lengths, 0.0))
            return replace(maxima, contour_length=of_chains or maxima.contour_length)

        return self._largest(largest_values)

    def at_points(self) -> Tissue:
        """Return the tissue with parameters at points, (elements * points,), cached; read-only."""
        return self._at_points(lambda: tissue_at_points(self.compiled, self.quadrature))

    def locking_length(self) -> Array:
        """Return the length at which chains lock, (elements, points); infinite without locking."""
        length = self.at_points().locking_length
        if length is None:
            return np.full(self.quadrature.shape, np.inf)
        return np.where(self.has_chains(), length.reshape(self.quadrature.shape), np.inf)

    def has_chains(self) -> Flags:
        """Return whether points have chains, (elements, points)."""
        return (self.at_points().network_modulus > 0.0).reshape(self.quadrature.shape)

    def nan_without_chains(self, values: Array) -> Array:
        """Return values (elements, points) with NaN at points without chains."""
        return np.where(self.has_chains(), values, np.nan)


# ---------------------------------------------------------------- the tissue of regions
# Contour length at points without chains, in link lengths; infinity would give NaN as a factor of
# zero.
CONTOUR_LENGTH_WITHOUT_CHAINS = 1e12


def parameters_of(
    properties: Mapping[str, Properties],
    domain: Domain,
) -> tuple[Tissue, float | dolfinx.fem.Function]:
    """Return tissue and kappa of a scene's regions: numbers if equal, else DG0 Functions."""
    tissues, kappas = _tissues(properties), {
        name: region.kappa for name, region in properties.items()
    }
    tissue, kappa = next(iter(tissues.values())), next(iter(kappas.values()))
    if any(region_tissue != tissue for region_tissue in tissues.values()):
        tissue = tissue.map(
            lambda key, _: region_function(
                domain, {name: t.parameters[key] for name, t in tissues.items()}
            )
        )
    return tissue, kappa if len(set(kappas.values())) == 1 else region_function(domain, kappas)


def _tissues(properties: Mapping[str, Properties]) -> dict[str, Tissue]:
    """Return tissues of all regions with one chain law and one matrix energy."""
    # Regions without chains get a contour length that never locks.
    tissues = {name: region.tissue for name, region in properties.items()}
    chain = next((tissue.chain for tissue in tissues.values() if tissue.chain is not None), None)
    matrices = list(dict.fromkeys(region.material.matrix for region in properties.values()))
    if any(tissue.elastin_axial is not None for tissue in tissues.values()):
        for name, tissue in tissues.items():
            ones = {key: 1.0 for key in ELASTIN if getattr(tissue, key) is None}
            tissues[name] = replace(tissue, **ones)  # type: ignore[arg-type]
    for name, tissue in tissues.items():
        if chain is not None and tissue.chain is None:
            length = CONTOUR_LENGTH_WITHOUT_CHAINS if chain.locks else tissue.contour_length
            tissues[name] = replace(tissue, chain=chain, contour_length=length)
    return tissues if len(matrices) == 1 else _with_one_matrix(tissues, properties, matrices)


def _with_one_matrix(
    tissues: Mapping[str, Tissue], properties: Mapping[str, Properties], matrices: Sequence[str]
) -> dict[str, Tissue]:
    # rules.tissue_of_regions has checked the matrices
    mixture = mixture_matrix([MATRICES[name] for name in matrices])  # type: ignore[misc]
    defaults = {name: number.default for name, number in mixture.parameters.items()}
    mixtures = {}
    for name, tissue in tissues.items():
        weight = {f"share_{matrices.index(properties[name].material.matrix)}": 1.0}
        own = getattr(tissue.matrix, "values", {})
        mixtures[name] = replace(
            tissue, matrix=mixture.with_parameters({**defaults, **own, **weight})
        )
    return mixtures
