"""Runs and fibres for other programs: VTU, FEBio, Abaqus, csv."""

from __future__ import annotations

import logging
import re
import tomllib
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.axes import GROWTH, NATURAL_GRADIENT
from remodel_fenicsx.model.cells import structure_tensor
from remodel_fenicsx.model.energy import TURNED_OVER
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.results.recording import RecordedRun, RecordingError, unit_of
from remodel_fenicsx.results.whole_body import AXIS_FIELDS, WholeBody
from remodel_fenicsx.schema.settings import OnFace, Support, faces_of
from remodel_fenicsx.system.files import write_new

if TYPE_CHECKING:
    from remodel_fenicsx.scene import Scene

log = logging.getLogger(__name__)
SECTORS_HEAD = "sector,hoop_stress_inner,hoop_stress_middle,hoop_stress_outer"
IN_PLANE = 1e-6  # over the size of a body; meshes in single precision are exact to 1e-7
LEAST_SAID = 0.01  # change between elements: a fit of angles does not resolve less


def write_vtu(
    path: Path,
    points: ArrayLike,
    cells: Integers,
    cell_type: int,
    cell_data: Mapping[str, ArrayLike],
    point_data: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write a new file of one unstructured grid."""
    import meshio
    from meshio._vtk_common import vtk_to_meshio_type

    of_elements = {name: [np.asarray(values)] for name, values in cell_data.items()}
    mesh = meshio.Mesh(points, [(vtk_to_meshio_type[cell_type], cells)], point_data, of_elements)
    with TemporaryDirectory(prefix="remodel-fenicsx-") as folder:
        file = Path(folder) / "grid.vtu"
        meshio.write(file, mesh)
        write_new(path, file.read_bytes())


# ---------------------------------------------------------------- cells as fibres of other programs
# The cells of a recorded run as fibres of other programs: one structure tensor for each element.
# Elements and nodes have the numbers of the run's mesh file, counted from 1 in text. Models of
# other programs (programs.toml) have regions, faces, supports and pressures too, for which the
# body is meshed again; other formats need no dolfinx.


TENSOR_COMPONENTS = tuple(f"{i}{j}" for i in "xyz" for j in "xyz")  # of a tensor, row by row


PROGRAMS = tomllib.loads(Path(__file__).with_name("programs.toml").read_text("utf-8"))
VTK_TYPES = {4: 10, 8: 12, 10: 24, 27: 29}  # by number of nodes


@dataclass(frozen=True)
class Fibres:
    """The mean cells of the elements of a body."""

    points: Array
    elements: Integers
    dimensions: Array
    axes: Array
    displacement: Array | None
    others: dict[str, Array]
    """Prestretch, content and natural length, if the run has any."""

    @property
    def tensors(self) -> Array:
        """A, (elements, 3, 3), in squared link lengths."""
        return structure_tensor(self.dimensions, self.axes)

    @property
    def reduced(self) -> Integers:
        """Elements with the nodes that other programs use."""
        # They count nodes within faces in other orders, and CalculiX has no such element.
        return self.elements[:, :20]

    @property
    def values(self) -> dict[str, Array]:
        """Values of the elements by name, besides their axes."""
        return {f"cell_dimension_{i + 1}": self.dimensions[:, i] for i in range(3)} | self.others


def export(
    folder: Path | str, kind: str, path: Path | None = None, time: float | None = None
) -> Path:
    """Write the mean structure tensor of each element, its axes and dimensions to a new file."""
    ending, write = FIBRE_FORMATS[kind]
    recording = RecordedRun(folder)
    fibres = recorded_fibres(recording, time)
    if fibres.others and kind not in WITH_OTHERS:
        kinds = " and ".join(WITH_OTHERS)
        log.warning(
            "%s has no place for %s; %s files have them", kind, ", ".join(fibres.others), kinds
        )
    share = unevenness(fibres.elements, fibres.tensors)
    if fibres.elements.shape[1] > 4 and share > LEAST_SAID:
        log.warning(
            "each element has one mean tensor A. It differs from the mean at a node by up to "
            "%.1f %% of tr A; a run that starts from the file has errors of this size",
            100 * share,
        )
    path = Path(folder) / f"fibres{ending}" if path is None else path
    write(path, fibres, recording, float(recording.times[-1]) if time is None else time)
    return path


def unevenness(elements: Integers, tensors: Array) -> float:
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
        remedy = "revolve writes the fields of the whole body, as does model.kinematics = 'full'"
        raise RecordingError(
            f"{recording.path}: its kinematics {kinematics!r} model a part of the body; {remedy}"
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
def _vtu(path: Path, fibres: Fibres, *_: object) -> None:
    of_elements = {
        "structure_tensor": fibres.tensors.reshape(-1, 9),
        "cell_dimensions": fibres.dimensions,
    }
    of_elements |= {name: fibres.axes[:, i] for i, name in enumerate(AXIS_FIELDS)} | fibres.others
    of_nodes = {} if fibres.displacement is None else {"displacement": fibres.displacement}
    kind = VTK_TYPES[fibres.elements.shape[1]]
    write_vtu(path, fibres.points, fibres.elements, kind, of_elements, of_nodes)


def _csv(path: Path, fibres: Fibres, recording: RecordedRun, time: float) -> None:
    names = ["element", *"xyz", *(f"structure_tensor_{c}" for c in TENSOR_COMPONENTS)]
    names += [f"cell_dimension_{i}" for i in (1, 2, 3)]
    names += [f"{name}_{c}" for name in AXIS_FIELDS for c in "xyz"]
    centres = fibres.points[fibres.elements].mean(axis=1)
    rows = _rows("{0},{1},{2},{3},{4}", centres, fibres.tensors, fibres.dimensions, fibres.axes)
    _write(path, f"{','.join(names)}\n{rows}\n")
    whole, shape = WholeBody(recording), recording.scene.geometry
    _, fields = whole.fields(time, ("hoop_stress", "station"))
    if "hoop_stress" in fields:
        station = fields["station"] if "station" in fields else shape.station(whole.centres)
        stress = whole.by_sector(fields["hoop_stress"], station)
        middle = [np.interp(0.5, whole.depth, sector) for sector in stress.T]
        rows = _rows("{0},{1}", np.stack([stress[0], middle, stress[-1]], axis=1))
        _write(path.with_name("sectors.csv"), f"{SECTORS_HEAD}\n{rows}\n".replace("nan", ""))


def elastic_constants(lame_lambda: float, lame_mu: float) -> dict[str, float]:
    """Return E and v of FEBio's neo-Hookean, and C10 = mu / 2 and D1 = 2 / K of Abaqus's."""
    v = lame_lambda / (lame_lambda + lame_mu) / 2
    bulk = lame_lambda + 2 * lame_mu / 3
    return {"E": 2 * lame_mu * (1 + v), "v": v, "C10": lame_mu / 2, "D1": 2 / bulk}


def _add_conditions(
    add: Callable[..., None], scene: Scene, domain: Any, nodes: Integers, time: float
) -> None:
    """Add fixed nodes and pressures; warn of supports and loads that these do not express."""
    from dolfinx.mesh import entities_to_geometry

    from remodel_fenicsx.body.domain import dof_of_node
    from remodel_fenicsx.body.loading import Loading, values_of_loads

    shape, supports = scene.geometry, scene.supports
    loads = scene.each_case()[0].loads
    loading = Loading(domain, KINEMATICS["full"].unknown(domain.mesh, scene.mesh.degree))
    shape.support(loading, supports.ends, loads)
    shape.hold_faces(loading, supports.faces, 1.0, loads)
    free = loading.unknown.x.array + 1  # 1, and 0 at fixed degrees of freedom: all loads are zero
    for condition in loading.boundary_conditions:
        condition.set(free)
    free = free.reshape(-1, 3)[dof_of_node(domain.mesh, loading.space)]
    changed = [f"supports.ends = {supports.ends!r} (left out)"] * loading.has_caps
    for face in filter(loading.supports.get, loading.supports):  # on springs
        support, how = supports.faces.get(face, Support()), "left out"
        for part, facets in domain.facets_of_parts(face) if support.stiffness is None else ():
            along = part.normal.round(6) ** 2 == 1
            on_face = entities_to_geometry(domain.mesh, 2, facets)
            arms = domain.mesh.geometry.x[on_face] - part.centre
            # At nodes level with the centre the circumferential direction is that of an axis.
            centred = (np.abs(arms) < IN_PLANE * domain.size) & (support.kind == "guided")
            if along.any():
                how = "simplified"
                free[on_face] *= ~(along | centred)
        changed.append(f"supports.{face} ({how})")
    for axis, column in zip("xyz", domain.gather_nodes(free)[nodes].T, strict=True):
        if not column.all():
            fixed = ",".join(map(str, nodes[column == 0] + 1))
            add("node_set", f"fixed_{axis}", nodes=fixed)
            add("fixed", f"fixed_{axis}", axis=axis, number="xyz".find(axis) + 1)
    on_faces = {"pressure": OnFace("inner")} | faces_of(loads)
    for name, value in values_of_loads(loads, time).items():
        if name in on_faces and on_faces[name].kind == "pressure":
            add("pressure", on_faces[name].face, value=value)
        else:
            changed.append(f"loads.{name} (left out)")
    if changed:
        log.warning("supports and loads that the file changes: %s", ", ".join(changed))


def _model(program: str, path: Path, fibres: Fibres, recording: RecordedRun, time: float) -> None:
    """Write the body with its regions, faces, matrix, supports and pressures for a program."""
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import cells_of

    scene, properties = recording.scene, recording.scene.properties()
    domain = scene.geometry.build_with(scene.regions, scene.mesh, MPI.COMM_SELF)
    if domain.number_of_elements != len(fibres.elements):
        raise RecordingError(f"{recording.path}: the scene's mesh has other elements than the run")
    region = np.asarray(domain.gather_elements(domain.element_region))
    texts, elements = PROGRAMS[program], fibres.reduced
    nodes, count = np.unique(elements), str(elements.shape[1])
    kind, sides = PROGRAMS["elements"][count][program], np.array(PROGRAMS["sides"][count])
    pattern = texts["facets"][str(sides.shape[1] - 1)]
    axes = np.moveaxis(fibres.axes, 1, 0)
    parts = defaultdict[str, list[str]](list)

    def add(part: str, name: str, **values: object) -> None:
        label = re.sub(r"\W|^(?=\d)", "_", name, flags=re.ASCII)
        parts[part].append(texts[part].format(name=label, **values))

    for name, number in domain.regions.items():
        material = (properties.get(name) or properties[""]).material
        constants = elastic_constants(material.lame_lambda, material.lame_mu)
        add("material", name, index=len(parts["material"]) + 1, **constants)
        add("section", name)
        rows = np.flatnonzero(region == number)
        add("part", name, kind=kind, rows=_rows(texts["element"], rows + 1, elements[rows] + 1))
        add("local_axes", name, rows=_rows(texts["axes"], rows + 1, *axes[:2, rows]))
        for key, values in fibres.values.items():
            text = _rows(texts["value"], rows + 1, values[rows])
            add("values", name, key=key, kind="mat3" if values.ndim > 1 else "scalar", rows=text)
    for name in domain.faces:
        cells, facet = cells_of(domain.mesh, domain.facets(name))
        behind = domain.element_number[cells]
        side, *corners = sides[facet].T
        nodes_of_facets = elements[behind, corners].T + 1
        add("surface", name, rows=_rows(pattern, behind + 1, side, nodes_of_facets))
        add("node_set", name, nodes=",".join(map(str, np.unique(nodes_of_facets))))
    _add_conditions(add, scene, domain, nodes, time)
    parts["node"] = [_rows(texts["node"], nodes + 1, fibres.points[nodes])]
    filled = {key: "\n".join(parts[key]) for key in texts}
    filled["units"] = f"lengths: {unit_of(scene, 'length')}, stresses: {unit_of(scene, 'stress')}"
    text = texts["document"].format(**filled)
    # CalculiX reads 20 characters of a number.
    text = re.sub(r"[-+.\de]{21,}", lambda number: f"{float(number[0]):.13g}", text)
    text = re.sub(rf"((?:\d+,){{{texts['per_line']}}})(?=\d)", r"\1\n", text)
    _write(path, re.sub(r"\n\n+", "\n", text))


WITH_OTHERS = ("vtu", "febio")
# format: suffix of its files, and the function that writes one
FIBRE_FORMATS: dict[str, tuple[str, Callable[..., None]]] = {
    "vtu": (".vtu", _vtu),
    "febio": (".feb", partial(_model, "febio")),
    "abaqus": (".inp", partial(_model, "abaqus")),
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
