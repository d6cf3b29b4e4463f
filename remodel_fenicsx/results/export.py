"""Runs and fibres for other programs: VTU, FEBio, Abaqus, csv."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx.body.mesh_faces import FACETS
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.axes import GROWTH, NATURAL_GRADIENT
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.model.energy import TURNED_OVER
from remodel_fenicsx.results.recording import RecordedRun, RecordingError
from remodel_fenicsx.results.whole_body import AXIS_FIELDS
from remodel_fenicsx.system.files import write_new


log = logging.getLogger(__name__)
LEAST_SAID = 0.01  # of a change between elements: less is below what a fit of angles resolves


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
    mesh = meshio.Mesh(points, [(vtk_to_meshio_type[cell_type], cells)], dict(point_data), of_elements)
    with TemporaryDirectory(prefix="remodel-fenicsx-") as folder:
        file = Path(folder) / "grid.vtu"
        meshio.write(file, mesh)
        write_new(path, file.read_bytes())


# ---------------------------------------------------------------- cells as fibres of other programs
# The cells of a recorded run as fibres of other programs: one structure tensor for each element. It needs no dolfinx.
#  Elements and nodes have the numbers of the run's mesh file, counted from 1 in text. What is written where:
# - febio: https://help.febio.org, User Manual 4, sections Mesh and MeshData; read by FEBioMeshDataSection4.cpp. Axis
# 1 is   a, axis 2 lies in the plane of a and d; the cell dimensions are three data maps of the elements. - abaqus:
# Keywords Reference Guide, *DISTRIBUTION TABLE, *DISTRIBUTION and *ORIENTATION, which CalculiX reads too
# (https://www.openaircraft.com/ccx-doc/ccx/node256.html). Neither has a place for the dimensions, which stand in
# comments: `** cell_dimensions, element, l1, l2, l3`.

Array = NDArray[np.float64]

TENSOR_COMPONENTS = tuple(f"{i}{j}" for i in "xyz" for j in "xyz")  # of a tensor, row by row


@dataclass(frozen=True)
class ElementNames:
    """What other programs call an element, and how many of its nodes, in VTK's order, FEBio and Abaqus take."""

    vtk: int
    febio: str
    abaqus: str
    nodes: int


# by number of nodes. Other programs count the nodes within faces and volume of quadratic hexahedra in other orders, and
# CalculiX has no such element: theirs is that of 20 nodes
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
    others: Mapping[str, Array] = MappingProxyType({})  # prestretch, content, natural length, where there are any

    @property
    def tensors(self) -> Array:
        """A, (elements, 3, 3), in squared link lengths."""
        return structure_tensor(self.dimensions, self.axes)

    @property
    def names(self) -> ElementNames:
        """Of the elements."""
        return ELEMENTS[self.elements.shape[1]]

    @property
    def reduced(self) -> NDArray[np.int64]:
        """The elements with those of their nodes that other programs take."""
        return self.elements[:, : self.names.nodes]


def export(folder: Path | str, kind: str, path: Path | None = None, time: float | None = None) -> Path:
    """Write the mean structure tensor of each element with its axes and dimensions into a new file."""
    ending, write = FIBRE_FORMATS[kind]
    fibres = recorded_fibres(RecordedRun(folder), time)
    if fibres.others and kind not in WITH_OTHERS:
        kinds = " and ".join(WITH_OTHERS)
        log.warning("%s has no place for %s; %s files have them", kind, ", ".join(fibres.others), kinds)
    if (share := uneven(fibres)) > LEAST_SAID:
        log.warning(
            "each element has the mean of its points: neighbours differ by up to %.1f %% of tr A, and "
            "a run that begins with them is off by up to about half of that at their faces",
            100 * share,
        )
    path = Path(folder) / f"fibres{ending}" if path is None else path
    write(path, fibres)
    return path


def uneven(fibres: Fibres) -> float:
    """Largest change of A between elements that share a facet, over tr A; 0 of elements with one point."""
    nodes = fibres.elements.shape[1]
    if nodes == 4:
        return 0.0
    local = np.array(FACETS["tetrahedron" if nodes == 10 else "hexahedron"])
    facets = np.sort(fibres.elements[:, local].reshape(-1, local.shape[1]), axis=1)
    _, number = np.unique(facets, axis=0, return_inverse=True)
    order = np.argsort(number.reshape(-1))
    one, other = order[:-1], order[1:]
    beside = number.reshape(-1)[one] == number.reshape(-1)[other]
    tensors = fibres.tensors / np.trace(fibres.tensors, axis1=1, axis2=2)[:, None, None]
    steps = tensors[one[beside] // len(local)] - tensors[other[beside] // len(local)]
    return float(np.linalg.norm(steps, axis=(1, 2)).max(initial=0.0))


def recorded_fibres(recording: RecordedRun, time: float | None = None) -> Fibres:
    """The cells of a run at a recorded time, the last one where None is given."""
    kinematics = recording.scene.model.kinematics
    if KINEMATICS[kinematics].reduced:
        remedy = "revolve writes the fields of the whole body, model.kinematics = 'full' runs it"
        raise RecordingError(f"{recording.path}: its kinematics are {kinematics!r}, a part of the body; {remedy}")
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
        log.warning("%s: output.fields was without %s: the prestretch is not written", recording.path, NATURAL_GRADIENT)
    others = {name: fields[name] for name in kept if name in fields}
    mesh = recording.points, recording.elements
    return Fibres(*mesh, fields["cell_dimensions"], axes, fields.get("displacement"), others)


# ---------------------------------------------------------------- formats
def _vtu(path: Path, fibres: Fibres) -> None:
    of_elements = {"structure_tensor": fibres.tensors.reshape(-1, 9), "cell_dimensions": fibres.dimensions}
    of_elements |= {name: fibres.axes[:, i] for i, name in enumerate(AXIS_FIELDS)} | dict(fibres.others)
    of_nodes = {} if fibres.displacement is None else {"displacement": fibres.displacement}
    write_vtu(path, fibres.points, fibres.elements, fibres.names.vtk, of_elements, of_nodes)


def _csv(path: Path, fibres: Fibres) -> None:
    names = [
        "element",
        *"xyz",
        *(f"structure_tensor_{c}" for c in TENSOR_COMPONENTS),
        *(f"cell_dimension_{i}" for i in (1, 2, 3)),
    ]
    names += [f"{name}_{c}" for name in AXIS_FIELDS for c in "xyz"]
    centres = fibres.points[fibres.elements].mean(axis=1)
    count = len(centres)
    columns = [centres, fibres.tensors.reshape(count, 9), fibres.dimensions, fibres.axes.reshape(count, 9)]
    _write(path, [",".join(names), *_rows("{number},{values}", np.hstack(columns))])


def _febio(path: Path, fibres: Fibres) -> None:
    nodes, elements = np.unique(fibres.reduced), fibres.reduced
    axes = fibres.axes[:, :2].reshape(-1, 6)
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<febio_spec version="4.0">', "<Mesh>", '<Nodes name="nodes">']
    lines += _rows('<node id="{number}">{values}</node>', fibres.points[nodes], nodes + 1)
    lines += ["</Nodes>", f'<Elements type="{fibres.names.febio}" name="body">']
    lines += _rows('<elem id="{number}">{values}</elem>', elements + 1)
    lines += ["</Elements>", "</Mesh>", "<MeshData>", '<ElementData type="mat_axis" elem_set="body">']
    for number, (a, d) in enumerate(zip(_joined(axes[:, :3]), _joined(axes[:, 3:]), strict=True), start=1):
        lines.append(f'<elem lid="{number}"><a>{a}</a><d>{d}</d></elem>')
    lines.append("</ElementData>")
    maps = {f"cell_dimension_{i + 1}": fibres.dimensions[:, i] for i in range(3)} | dict(fibres.others)
    for name, values in maps.items():
        kind = "mat3" if name == NATURAL_GRADIENT else "scalar"
        lines.append(f'<ElementData name="{name}" data_type="{kind}" elem_set="body">')
        lines += _rows('<elem lid="{number}">{values}</elem>', values.reshape(len(values), -1))
        lines.append("</ElementData>")
    _write(path, [*lines, "</MeshData>", "</febio_spec>"])


def _abaqus(path: Path, fibres: Fibres) -> None:
    nodes, elements = np.unique(fibres.reduced), fibres.reduced
    lines = [
        "** mean cells of a run of remodel_fenicsx: local directions 1, 2 and 3 are the axes, longest first",
        "*NODE",
    ]
    lines += _rows("{number},{values}", fibres.points[nodes], nodes + 1)
    lines.append(f"*ELEMENT, TYPE={fibres.names.abaqus}, ELSET=BODY")
    for row in _rows("{number},{values}", elements + 1):
        words = row.split(",")  # sixteen in a line at most
        lines += [",".join(words)] if len(words) <= 16 else [",".join(words[:16]) + ",", ",".join(words[16:])]
    lines += ["*DISTRIBUTION TABLE, NAME=CELL_AXES_TABLE", "COORD3D, COORD3D"]
    lines += ["*DISTRIBUTION, NAME=CELL_AXES, LOCATION=ELEMENT, TABLE=CELL_AXES_TABLE", ",1.,0.,0.,0.,1.,0."]
    lines += _rows("{number},{values}", fibres.axes[:, :2].reshape(-1, 6))
    lines += [
        "*ORIENTATION, NAME=CELLS, DEFINITION=COORDINATES",
        "CELL_AXES",
        "** cell_dimensions, element, l1, l2, l3",
    ]
    _write(path, [*lines, *_rows("** cell_dimensions,{number},{values}", fibres.dimensions)])


WITH_OTHERS = ("vtu", "febio")
# format: ending of its files, and what writes one
FIBRE_FORMATS: dict[str, tuple[str, Callable[[Path, Fibres], None]]] = {
    "vtu": (".vtu", _vtu),
    "febio": (".feb", _febio),
    "abaqus": (".inp", _abaqus),
    "csv": (".csv", _csv),
}


def _rows(pattern: str, values: NDArray[Any], numbers: Iterable[int] | None = None) -> list[str]:
    """A line for each row of values (n, columns)."""
    numbers = range(1, len(values) + 1) if numbers is None else numbers
    return [pattern.format(number=n, values=row) for n, row in zip(numbers, _joined(values), strict=True)]


def _joined(values: NDArray[Any]) -> list[str]:
    """Each row as numbers with commas between; they are read back to the last bit."""
    return [",".join(map(repr, row.tolist())) for row in values]


def _write(path: Path, lines: Sequence[str]) -> None:
    write_new(path, ("\n".join(lines) + "\n").encode("ascii"))
