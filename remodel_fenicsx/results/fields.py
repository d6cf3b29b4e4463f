"""Time series for ParaView and PyVista: element means on the mesh, and chains as lines."""

from __future__ import annotations

import math
import logging
from collections.abc import Callable, Collection, Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np

from remodel_fenicsx.body.shape import Shape
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.energy import TURNED_OVER
from remodel_fenicsx.model.axes import GROWTH, NATURAL_GRADIENT, LocalAxes
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.results.columns import Measurement, Observer
from remodel_fenicsx.results.whole_body import AXIS_FIELDS, OF_CHAINS, append_chains
from remodel_fenicsx.results.recording import CHAIN_LINES, FIELDS
from remodel_fenicsx.results.vtkhdf import TransientGrid, vtk_cells
from remodel_fenicsx.schema.settings import (
    CONSTANT_FIELDS,
    FIELDS_BY_NAME,
    NO_PRESTRETCH,
    REGION,
    UNLOADED,
    WALL_STRESSES,
)
from remodel_fenicsx.system.files import ClosedAtEnd

log = logging.getLogger(__name__)

OF_ELEMENTS = tuple(name for name in FIELDS_BY_NAME if name not in ("displacement", "chains"))


def field_names(
    asked: bool | Sequence[str],
    lacking: Collection[str] = (REGION, *NO_PRESTRETCH, *TURNED_OVER, GROWTH, *WALL_STRESSES),
    constant: Sequence[str] = (),
) -> tuple[str, ...]:
    """Return the fields that a scene's `output.fields` names; True is all that the scene has."""
    if isinstance(asked, bool):
        return (
            (*(name for name in FIELDS_BY_NAME if name not in lacking), *constant) if asked else ()
        )
    return tuple(asked)


def local_fields(local_axes: LocalAxes, quadrature: Quadrature) -> dict[str, Array]:
    """Compute CONSTANT_FIELDS of the local elements, by name.

    These are unit vectors (elements, 3), and depth and station (elements,).
    """
    axes = quadrature.element_mean(local_axes.axes)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    numbers = (quadrature.element_mean(values) for values in (local_axes.depth, local_axes.station))
    return dict(zip(CONSTANT_FIELDS, (*np.moveaxis(axes, 1, 0), *numbers), strict=True))


class ElementFields:
    """Element means for pictures."""

    def __init__(self, shape: Shape, stepper: Stepper, names: Sequence[str] = OF_ELEMENTS):
        self.observer, self.turnover = Observer(shape, stepper, ()), stepper.process("turnover")
        self.names = tuple(names)
        self.tissue, self._parameters = stepper.tissue, stepper.coupling.equilibrium.parameters

    def __call__(self) -> dict[str, Array]:
        """Compute the fields by name, one row per local element."""
        state = self.observer.state
        measured = Measurement(self.observer, None)  # type: ignore[arg-type]
        quadrature, mean_cells = measured.quadrature, cache(self.mean_cells)
        mean, nanmean = quadrature.element_mean, quadrature.element_nanmean
        stress = cache(lambda: mean(measured.stress))
        principal = cache(lambda: np.asarray(np.linalg.eigvalsh(stress()), np.float64))
        makers: dict[str, Callable[[], Array]] = {
            "deformation_gradient": lambda: mean(measured.F).reshape(-1, 9),
            "cauchy_stress": lambda: stress().reshape(-1, 9),
            "hoop_stress": lambda: mean(measured.wall_stress[..., 0]),
            "axial_stress": lambda: mean(measured.wall_stress[..., 1]),
            "max_principal_stress": lambda: principal()[:, 2],
            "von_mises_stress": lambda: np.sqrt(4.5) * principal().std(axis=1),
            "cell_dimensions": lambda: mean_cells()[0],
            "fibre_angle": lambda: nanmean(measured.fibre_angle),
            UNLOADED: lambda: nanmean(measured.fibre_angle_unloaded),
            "fibre_angle_deformed": lambda: nanmean(measured.fibre_angle_deformed),
            "chain_extension": lambda: measured.chain_extension.max(axis=1),
            REGION: lambda: measured.domain.element_region.astype(np.float64),
        }
        makers |= {
            name: partial(lambda i: mean_cells()[1][:, i], i) for i, name in enumerate(AXIS_FIELDS)
        }
        G = state.natural_gradient
        if G is not None:
            makers[NATURAL_GRADIENT] = lambda: mean(G).reshape(-1, 9)
        if state.kinematics.grows:
            makers[GROWTH] = lambda: mean(self.turnover.growth.ratio)
        for name in TURNED_OVER:
            if (number := getattr(self.tissue, name)) is not None:
                makers[name] = partial(lambda one: mean(quadrature.values(one, ())), number)
        return {
            name: makers[name]() for name in OF_ELEMENTS if name in self.names and name in makers
        }

    def mean_cells(self) -> tuple[Array, Array]:
        """Compute lengths (elements, 3) and axes as rows (elements, 3, 3), longest first.

        They belong to the mean structure tensor of each element.
        """
        cells = self.observer.state.cells
        means = cells.quadrature.element_mean(cells.structure_tensor())
        squared, axes = cells.kernels.principal(means, cells.axis_values[:, 0])
        # of regions: all points of an element, or none
        chains = self._parameters.has_chains()[:, :1]
        return np.sqrt(np.maximum(squared, 0.0)) * chains, axes


class Fields(Watcher, ClosedAtEnd):
    """Time series of fields in fields.vtkhdf (the mesh) and fields_chains.vtkhdf.

    The second file has four chain lines per element. Both open in ParaView (5.12 or later) and
    PyVista as one time series. Nodes and elements have the mesh file's order, whatever the number
    of ranks.

    Parameters
    ----------
    folder
        Folder of the files.
    shape, stepper
        Body and simulation whose fields are written.
    every
        Number of steps between two that are written; the first and the last one always are.
    after
        Time of the last completed step if the run resumes. Fields of later steps are dropped.
    names
        Names from `settings.FIELDS_BY_NAME` and CONSTANT_FIELDS; "chains" writes the lines.
    times
        Further times that are written.

    Raises
    ------
    FileExistsError
        If such files exist and the run is new.
    OSError
        If they cannot be written.
    RecordingError
        On rank 0, if the files of a resumed run are corrupt.

    Examples
    --------
    >>> from remodel_fenicsx import Recording, Simulation, parts, preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 3.0})
    >>> simulation = Simulation(scene)
    >>> with parts.RunFolder("with-fields", scene.to_toml()) as record:
    ...     fields = parts.Fields(
    ...         record.folder, scene.geometry, simulation.stepper, names=("displacement",)
    ...     )
    ...     for step in simulation.steps([record, fields]):
    ...         pass
    ...     fields.close()
    >>> Recording("with-fields").times
    array([0., 1., 2., 3.])
    """

    def __init__(
        self,
        folder: Path,
        shape: Shape,
        stepper: Stepper,
        every: int = 1,
        after: float | None = None,
        names: Sequence[str] = field_names(True),
        times: Sequence[float] = (),
    ):
        self.times = tuple(times)
        self.state, self.every = stepper.state, every
        self.names = tuple(names)
        self.domain = domain = self.state.loading.domain
        needed = {*self.names, *(OF_CHAINS if "chains" in self.names else ())}
        self._element_fields = ElementFields(
            shape, stepper, [name for name in OF_ELEMENTS if name in needed]
        )
        quadrature, local_axes = self.state.cells.quadrature, self.state.cells.local_axes
        constant = (
            local_fields(local_axes, quadrature) if {*CONSTANT_FIELDS} & {*self.names} else {}
        )
        self._constant = {
            name: domain.gather_elements(values)
            for name, values in constant.items()
            if name in self.names
        }
        points, elements = domain.gather_mesh()
        self._grid: TransientGrid | None = None
        self._chains: TransientGrid | None = None
        self._solved: dict[str, Array] | None = None  # fields of a step that is not committed yet
        if points is not None and elements is not None:
            geometry = domain.mesh.geometry.cmap
            cell_type, cells = vtk_cells(
                domain.mesh.topology.cell_name(), geometry.degree, elements
            )
            self._grid = _continued(folder / FIELDS, after) or TransientGrid(
                folder / FIELDS, points, cells, cell_type
            )
            self._chains = (
                _continued(folder / CHAIN_LINES, after) if "chains" in self.names else None
            )
            self._mesh = points, elements
            # a chain is at most half of the smallest mean distance between elements, so that
            # pictures stay readable
            self._scale = 0.4 * quadrature.extent

    # ------------------------------------------------------------ as a watcher
    def started(self, step: Step) -> None:
        """Write the fields at the start."""
        self.append(step.time)
        self.close()

    def solved(self, step: Step) -> None:
        """Store the fields of the solved state, if this step is to be written."""
        asked = any(math.isclose(time, step.time) for time in self.times)
        is_due = step.number % self.every == 0 or step.is_last or asked
        self._solved = self._gathered() if is_due else None

    def committed(self, step: Step) -> None:
        """Write the stored fields."""
        if self._solved is not None:
            self._write(step.time, self._solved)

    # ------------------------------------------------------------ writing
    def append(self, time: float) -> None:
        """Write the present state as the state of `time`. Collective."""
        self._write(time, self._gathered())

    def _gathered(self) -> dict[str, Array]:
        """Gather the fields of the present state on rank 0; empty on other ranks. Collective."""
        local = {
            name: self.domain.gather_elements(values)
            for name, values in self._element_fields().items()
        }
        fields = local | {"displacement": self.state.gathered_displacement()}
        return {name: values for name, values in fields.items() if values is not None}

    def _write(self, time: float, fields: dict[str, Array]) -> None:
        if self._grid is None:
            return
        displacement = fields["displacement"]
        at_nodes = {"displacement": displacement} if "displacement" in self.names else {}
        changing = {
            name: fields[name] for name in fields if name in self.names and name != "displacement"
        }
        constant = {name: values for name, values in self._constant.items() if values is not None}
        self._grid.append(time, at_nodes, changing, constant=constant)
        if "chains" in self.names:
            grid = self._chains or self._grid.path.with_name(CHAIN_LINES)
            self._chains = append_chains(grid, time, *self._mesh, self._scale, displacement, fields)

    def close(self) -> None:
        """Publish all steps so far, for readers and for a resumed run after a kill."""
        for grid in (self._grid, self._chains):
            if grid is not None:
                grid.close()

    publish = close


def _continued(path: Path, after: float | None) -> TransientGrid | None:
    """Open the file of a resumed run without the steps after this time, if it exists."""
    if after is None:
        return None
    if not path.exists():
        log.warning("%s is missing: a new one begins with the next step", path.name)
        return None
    # `math.isclose` takes times within this tolerance as the same
    return TransientGrid.continued(path, after * (1 + 1e-9))
