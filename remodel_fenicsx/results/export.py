"""Runs and fibres for other programs: VTU, FEBio, Abaqus, csv."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.axes import GROWTH, NATURAL_GRADIENT
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.model.energy import TURNED_OVER
from remodel_fenicsx.results.recording import RecordedRun, RecordingError
from remodel_fenicsx.results.whole_body import AXIS_FIELDS
from remodel_fenicsx.system.files import write_new


log = logging.getLogger(__name__)
LEAST_SAID = 0.01  # change between elements: a fit of angles does not resolve less


def write_vtu(
    path: Path,
    points: ArrayLike,
    cells: NDArray[np.int64],
    cell_type: int,
    cell_data: Mapping[str, ArrayLike],
    point_data: Mapping[str, ArrayLike] = MappingProxyType({}),
) -> None:
    """Write a new file of one unstructured grid."""
    import meshio
    from meshio._vtk_common import vtk_to_meshio_type

    of_elements = {name: [np.asarray(values)] for name, values in cell_data.items()}
    mesh = meshio.Mesh(
        points, [(vtk_to_meshio_type[cell_type], cells)], dict(point_data), of_elements
    )
    with TemporaryDirectory(prefix="remodel-fenicsx-") as folder:
        file = Path(folder) / "grid.vtu"
        meshio.write(file, mesh)
        write_new(path, file.read_bytes())


# ---------------------------------------------------------------- cells as fibres of other programs
# The cells of a recorded run as fibres of other programs: one structure tensor for each element.
# This needs no dolfinx. Elements and nodes have the numbers of the run's mesh file, counted from 1
# in text. The formats:
# - febio: https://help.febio.org, User Manual 4, sections Mesh and MeshData; read by
#   FEBioMeshDataSection4.cpp. Axis 1 is a, axis 2 lies in the plane of a and d. The cell dimensions
#   are three data maps of the elements.
# - abaqus: Keywords Reference Guide, *DISTRIBUTION TABLE, *DISTRIBUTION and *ORIENTATION, which
#   CalculiX reads too (https://www.openaircraft.com/ccx-doc/ccx/node256.html). Neither has an item
#   for the dimensions, which are comments: `** cell_dimensions, element, l1, l2, l3`.

Array = NDArray[np.float64]

TENSOR_COMPONENTS = tuple(f"{i}{j}" for i in "xyz" for j in "xyz")  # of a tensor, row by row


class ElementNames(NamedTuple):
    """Element type in other programs, and the number of its nodes in FEBio and Abaqus."""

    vtk: int
    febio: str
    abaqus: str
    nodes: int


# by number of nodes. Other programs count the nodes within faces and volume of quadratic hexahedra
# in other orders, and CalculiX has no such element: these programs get the element of 20 nodes
ELEMENTS = {
    4: ElementNames(10, "tet4", "C3D4", 4),
    8: ElementNames(12, "hex8", "C3D8", 8),
    10: ElementNames(24, "tet10", "C3D10", 10),
    27: ElementNames(29, "hex20", "C3D20", 20),
}


@dataclass(frozen=True)
class Fibres:
    """The mean cells of the elements of a body."""

    points: Array
    elements: NDArray[np.int64]
    dimensions: Array
    axes: Array
    displacement: Array | None
    # prestretch, content and natural length, if the run has any
    others: Mapping[str, Array] = MappingProxyType({})

    @property
    def tensors(self) -> Array:
        """A, (elements, 3, 3), in squared link lengths."""
        return structure_tensor(self.dimensions, self.axes)

    @property
    def names(self) -> ElementNames:
        """Names of the element type in other programs."""
        return ELEMENTS[self.elements.shape[1]]

    @property
    def reduced(self) -> NDArray[np.int64]:
        """Elements with the nodes that other programs use."""
        return self.elements[:, : self.names.nodes]


def export(
    folder: Path | str, kind: str, path: Path | None = None, time: float | None = None
) -> Path:
    """Write the mean structure tensor of each element, its axes and dimensions to a new file."""
    ending, write = FIBRE_FORMATS[kind]
    fibres = recorded_fibres(RecordedRun(folder), time)
    if fibres.others and kind not in WITH_OTHERS:
        kinds = " and ".join(WITH_OTHERS)
        log.warning(
            "%s has no place for %s; %s files have them", kind, ", ".join(fibres.others), kinds
        )
    share = unevenness(fibres.elements, fibres.tensors)
    if fibres.elements.shape[1] > 4 and share > LEAST_SAID:
        log.warning(
            "the file stores one mean of A per element, up to %.1f %% of tr A away from the mean "
            "at a node; a run that starts from the file has errors of this size",
            100 * share,
        )
    path = Path(folder) / f"fibres{ending}" if path is None else path
    write(path, fibres)
    return path


def unevenness(elements: NDArray[np.int64], tensors: Array) -> float:
    """Compute the largest change of A (elements, 3, 3), relative to tr A, at the nodes.

    It is the change from an element to the mean of all elements at one of its nodes.
    """
    shares = (tensors / np.trace(tensors, axis1=1, axis2=2)[:, None, None]).reshape(-1, 9)
    sums = np.zeros((elements.max() + 1, 10))
    np.add.at(sums, elements, np.insert(shares, 9, 1.0, axis=1)[:, None])
    at_nodes = sums[elements, :9] / sums[elements, 9:]
    return float(np.linalg.norm(at_nodes - shares[:, None], axis=2).max())


def recorded_fibres(recording: RecordedRun, time: float | None = None) -> Fibres:
    """Read the cells of a run at a recorded time; None is the last one."""
    kinematics = recording.scene.model.kinematics
    if KINEMATICS[kinematics].reduced:
        remedy = "revolve writes the fields of the whole body, model.kinematics = 'full' runs it"
        raise RecordingError(
            f"{recording.path}: its kinematics are {kinematics!r}, a part of the body; {remedy}"
        )
    if not len(recording.times):
        raise RecordingError(f"{recording.path}: the run recorded no fields")
    time = float(recording.times[-1]) if time is None else time
    needed = ("cell_dimensions", *AXIS_FIELDS)
    kept = (NATURAL_GRADIENT, *TURNED_OVER, GROWTH)
    fields = recording.fields(time, (*needed, "displacement", *kept))
    missing = [name for name in needed if name not in fields]
    if missing:
        raise RecordingError(f"{recording.path}: output.fields was without {', '.join(missing)}")
    axes = np.stack([fields[name] for name in AXIS_FIELDS], axis=1)
    if NATURAL_GRADIENT not in {*fields, *recording.scene.lacking_fields}:
        log.warning(
            "%s: output.fields was without %s: the prestretch is not written",
            recording.path,
            NATURAL_GRADIENT,
        )
    others = {name: fields[name] for name in kept if name in fields}
    mesh = recording.points, recording.elements
    return Fibres(*mesh, fields["cell_dimensions"], axes, fields.get("displacement"), others)


# ---------------------------------------------------------------- formats
def _vtu(path: Path, fibres: Fibres) -> None:
    of_elements = {
        "structure_tensor": fibres.tensors.reshape(-1, 9),
        "cell_dimensions": fibres.dimensions,
    }
    of_elements |= {name: fibres.axes[:, i] for i, name in enumerate(AXIS_FIELDS)} | dict(
        fibres.others
    )
    of_nodes = {} if fibres.displacement is None else {"displacement": fibres.displacement}
    write_vtu(path, fibres.points, fibres.elements, fibres.names.vtk, of_elements, of_nodes)


def _csv(path: Path, fibres: Fibres) -> None:
    names = ["element", *"xyz", *(f"structure_tensor_{c}" for c in TENSOR_COMPONENTS)]
    names += [f"cell_dimension_{i}" for i in (1, 2, 3)]
    names += [f"{name}_{c}" for name in AXIS_FIELDS for c in "xyz"]
    centres = fibres.points[fibres.elements].mean(axis=1)
    rows = _rows("{0},{1},{2},{3},{4}", centres, fibres.tensors, fibres.dimensions, fibres.axes)
    _write(path, f"{','.join(names)}\n{rows}\n")


FEBIO = """<?xml version="1.0" encoding="UTF-8"?>
<febio_spec version="4.0">
<Mesh>
<Nodes name="nodes">
{nodes}
</Nodes>
<Elements type="{kind}" name="body">
{elements}
</Elements>
</Mesh>
<MeshData>
<ElementData type="mat_axis" elem_set="body">
{axes}
</ElementData>
{maps}
</MeshData>
</febio_spec>
"""
FEBIO_MAP = """<ElementData name="{name}" data_type="{kind}" elem_set="body">
{values}
</ElementData>"""


def _febio(path: Path, fibres: Fibres) -> None:
    nodes, axes = np.unique(fibres.reduced), fibres.axes
    maps = {f"cell_dimension_{i + 1}": fibres.dimensions[:, i] for i in range(3)} | dict(
        fibres.others
    )
    kinds = {NATURAL_GRADIENT: "mat3"}
    shown = [
        FEBIO_MAP.format(
            name=name,
            kind=kinds.get(name, "scalar"),
            values=_rows('<elem lid="{0}">{1}</elem>', values),
        )
        for name, values in maps.items()
    ]
    text = FEBIO.format(
        kind=fibres.names.febio,
        nodes=_rows('<node id="{1}">{2}</node>', nodes + 1, fibres.points[nodes]),
        elements=_rows('<elem id="{0}">{1}</elem>', fibres.reduced + 1),
        axes=_rows('<elem lid="{0}"><a>{1}</a><d>{2}</d></elem>', axes[:, 0], axes[:, 1]),
        maps="\n".join(shown),
    )
    _write(path, text)


ABAQUS = """** mean cells of a run of remodel_fenicsx: \
local directions 1, 2 and 3 are the axes, longest first
*NODE
{nodes}
*ELEMENT, TYPE={kind}, ELSET=BODY
{elements}
*DISTRIBUTION TABLE, NAME=CELL_AXES_TABLE
COORD3D, COORD3D
*DISTRIBUTION, NAME=CELL_AXES, LOCATION=ELEMENT, TABLE=CELL_AXES_TABLE
,1.,0.,0.,0.,1.,0.
{axes}
*ORIENTATION, NAME=CELLS, DEFINITION=COORDINATES
CELL_AXES
** cell_dimensions, element, l1, l2, l3
{dimensions}
"""


def _abaqus(path: Path, fibres: Fibres) -> None:
    nodes, numbers = np.unique(fibres.reduced), fibres.reduced + 1
    text = ABAQUS.format(
        kind=fibres.names.abaqus,
        nodes=_rows("{1},{2}", nodes + 1, fibres.points[nodes]),
        # sixteen numbers in a line at most
        elements=_rows("{0},{1},\n{2}", numbers[:, :15], numbers[:, 15:]),
        axes=_rows("{0},{1}", fibres.axes[:, :2]),
        dimensions=_rows("** cell_dimensions,{0},{1}", fibres.dimensions),
    )
    _write(path, text.replace(",\n\n", "\n"))


WITH_OTHERS = ("vtu", "febio")
# format: suffix of its files, and the function that writes one
FIBRE_FORMATS: dict[str, tuple[str, Callable[[Path, Fibres], None]]] = {
    "vtu": (".vtu", _vtu),
    "febio": (".feb", _febio),
    "abaqus": (".inp", _abaqus),
    "csv": (".csv", _csv),
}


def _rows(pattern: str, *parts: NDArray[np.generic]) -> str:
    """Format one line for each row of the arrays (n, ...); numbers read back to the last bit."""
    texts = [[",".join(map(repr, row.ravel().tolist())) for row in part] for part in parts]
    return "\n".join(
        pattern.format(n, *row) for n, row in enumerate(zip(*texts, strict=True), start=1)
    )


def _write(path: Path, text: str) -> None:
    write_new(path, text.encode("ascii"))
