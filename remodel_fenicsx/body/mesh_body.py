"""Bodies of one's own: the mesh of a file with named faces, of a vessel or of anything without a lumen."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator
from pydantic.config import JsonDict

from remodel_fenicsx.body.gmsh_model import LARGEST_LENGTH, SMALLEST_LENGTH, gmsh_model
from remodel_fenicsx.body import mesh_faces
from remodel_fenicsx.body.mesh_file import (
    READERS,
    SURFACES,
    TAGS,
    MeshFile,
    assembled,
    distinct,
    of_gmsh,
    read_mesh,
)
from remodel_fenicsx.body.shape import (
    Column,
    Columns,
    FromFile,
    LoadKind,
    Loads,
    Supports,
    Unloads,
    WithRegions,
    cauchy_columns,
)
from remodel_fenicsx.body.wall import AngleOf, Walled, angle_columns, columns_on_request
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.axes import LocalAxes
from remodel_fenicsx.model.cells import angle_to_axis
from remodel_fenicsx.model.tensors import Array, Flags, Integers
from remodel_fenicsx.schema.settings import CONSTANT_FIELDS, LARGEST_MESH, Mesh, OnFace, Support, faces_of
from remodel_fenicsx.schema.tables import SceneError, fault, shown
from remodel_fenicsx.schema.units import LENGTH, LENGTH_UNITS, METRES, STRESS

if TYPE_CHECKING:
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import Domain
    from remodel_fenicsx.body.loading import Loading
    from remodel_fenicsx.fem.quadrature import Quadrature

log = logging.getLogger(__name__)

HELD_ACROSS = ("guided", "sliding", "held")  # kinds of support that leave a face no motion along its normal
ON_FACES: dict[str, Callable[[str], LoadKind]] = {
    "pressure": lambda face: LoadKind(_by_hold_faces, f"pressure on the deformed face {face}", STRESS),
    "displacement": lambda face: LoadKind(_by_hold_faces, f"way of the face {face} along its normal, outwards", LENGTH),
}
Names = tuple[str | int, ...]
_ENTRY: JsonDict = {"type": ["string", "integer"]}
_GROUPS: JsonDict = {
    "allowed": "a table of names, numbers or lists of them",
    "additionalProperties": {"anyOf": [_ENTRY, {"type": "array", "items": _ENTRY, "minItems": 1}]},
}


def _by_hold_faces(shape: Any, loading: Any, name: str) -> None:
    """A part of the supports."""


def _faces(value: Any) -> Any:
    """Names or numbers, one or a list, as tuples."""
    if not isinstance(value, Mapping):
        raise fault("must be a table: names or numbers of the file's faces or volumes, as in inner = 3")
    found = {}
    for name, entry in value.items():
        entries = entry if isinstance(entry, (list, tuple)) else [entry]
        if not entries or not all(isinstance(one, (str, int)) and not isinstance(one, bool) for one in entries):
            rule = "must be a name or a number in the file, or a list of them; a face may be { file = 'surface.vtp' }"
            raise fault(rule, str(name), entry)
        found[str(name)] = tuple(entries)
    return found


Groups = Annotated[dict[str, Names], BeforeValidator(_faces), Field(json_schema_extra=_GROUPS)]


def _files(value: Any) -> list[str]:
    """Paths of a mesh and of its surfaces, of one or a list; nothing where they are none."""
    mesh, *surfaces = value if isinstance(value, (list, tuple)) and value else [value]
    are_files = _ends_with(mesh, READERS) and all(_ends_with(one, SURFACES) for one in surfaces)
    return [mesh, *surfaces] if are_files else []


def _ends_with(file: Any, endings: Collection[str]) -> bool:
    return isinstance(file, str) and "\x00" not in file and Path(file).suffix.lower() in endings


def _file(value: Any) -> Any:
    files = _files(value)
    if not files:
        mesh, surfaces = ", ".join(READERS), ", ".join(SURFACES)
        raise fault(
            f"must be the path of a mesh ({mesh}), relative to the scene's folder; in a list, what follows the mesh "
            f"must be paths of its surfaces ({surfaces})"
        )
    return tuple(files) if files[1:] else files[0]


def _together(geometry: Mapping[str, Any]) -> dict[str, Any]:
    """The keys with surfaces that faces give as files, inner = { file = "lumen.vtp" }, after the mesh."""
    faces, file = geometry.get("faces", {}), geometry.get("file")
    files, found = file if isinstance(file, (list, tuple)) else [file], {}
    for face, one in faces.items() if isinstance(faces, Mapping) else ():
        if isinstance(one, Mapping) and _ends_with(one.get("file"), SURFACES):
            files, found[face] = [*files, one["file"]], Path(one["file"]).stem
    return {**geometry, "file": [*dict.fromkeys(files)], "faces": {**faces, **found}} if found else dict(geometry)


def _numbers(key: str, entries: Names, names: Mapping[str, int], groups: Integers) -> list[int]:
    """Numbers in the file of what a scene gives as a face or a region, by name or number."""
    there = {*distinct(groups)} - {0}
    found = [names.get(entry, 0) if isinstance(entry, str) else int(entry) for entry in entries]
    for entry, number in zip(entries, found, strict=True):
        if number not in there:
            listed = [*map(repr, names), *map(str, sorted(there - {*names.values()}))]
            word = "face" if key.startswith("faces") else "volume"
            rule = f"the file has no such {word}; it has {', '.join(listed) or 'none'}"
            raise SceneError(f"geometry.{key} = {shown(entry)}: {rule}")
    return found


class FileBody(WithRegions, FromFile):
    """A body whose mesh, faces and regions are those of a file."""

    supported_faces = None
    thickness_in_words: ClassVar[str] = "cube root of the volume"

    file: Annotated[str | tuple[str, ...], BeforeValidator(_file)] = Field(
        json_schema_extra={"allowed": "the path of a file .msh, .vtu, .vtk or .xdmf, or a list with surfaces after it"}
    )
    """The mesh, relative to the scene. In a list, surfaces of its triangles may follow (`.vtp`,
    `.stl`, `.obj`), faces by the names of their files (docs/my_own_vessel.md, Meshes of your own)."""
    tags: str | None = Field(
        default=None,
        min_length=1,
        description="Of a file that is not by Gmsh: the array of whole numbers that tells the faces and volumes apart. "
        "Default: the first of " + ", ".join(f"`{name}`" for name in TAGS) + " that is there.",
        json_schema_extra={"allowed": "the name of an array"},
    )
    file_unit: Literal["m", "cm", "mm", "um"] | None = Field(
        default=None, json_schema_extra={"allowed": "one of " + ", ".join(map(repr, LENGTH_UNITS))}
    )
    """Unit of the numbers in the file, where it differs from `length_unit`."""
    faces: Groups = {}
    """Names of faces, each with the name or number of a face in the file, or a list of them:
    `inner`, `outer`, `inlet` and `outlet` where the file has other names, and more for supports
    and loads. A surface of its own is a face too: `{ file = "lumen.vtp" }`."""
    regions: Groups = {}
    """Names of regions, each with the name or number of a volume in the file, or a list of
    them. Default: the names in the file."""
    open_boundary: bool = False
    """Whether parts of the boundary may belong to no face. Without it such a part is taken for
    a hole and refused."""
    sha256: str | None = Field(
        default=None, pattern="^[0-9a-f]{64}$", json_schema_extra={"allowed": "64 hexadecimal digits"}
    )
    """SHA-256 of the file, of several files together. A scene as run has it, and refuses
    others."""

    @model_validator(mode="before")
    @classmethod
    def _surfaces_of_faces(cls, values: Any) -> Any:
        return _together(values) if isinstance(values, Mapping) else values

    @model_validator(mode="after")
    def _units_are_both_there(self) -> Any:
        if self.file_unit is not None and self.length_unit is None:
            raise fault("needs geometry.length_unit, the unit of the scene", "file_unit", self.file_unit)
        return self

    @classmethod
    def with_files_from(cls, geometry: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """The keys as they were read, with the place of the file."""
        found = _together(geometry)
        places = [str(folder.absolute() / file) for file in _files(found.get("file"))]
        return found | ({"file": places} if places else {})

    @classmethod
    def defaults_of(cls, own: Mapping[str, Any]) -> dict[str, Any]:
        """Element and degree of the file, where the scene does not say them."""
        mesh, files = own.get("mesh", {}), _files(_together(own["geometry"]).get("file"))
        if not files or (isinstance(mesh, Mapping) and "element" in mesh and "degree" in mesh):
            return cls.defaults
        tags, (file, *surfaces) = own["geometry"].get("tags"), map(Path, files)
        try:
            found = read_mesh(file, tags if isinstance(tags, str) else None, surfaces)
        except UnreadableFile as error:
            raise fault(str(error), "geometry.file", file.name) from None
        return cls.defaults | {"mesh": {"element": found.kind, "degree": found.degree}}

    def kept_files(self) -> tuple[dict[str, Any], dict[str, bytes]]:
        """The file under its own name beside the scene as run, which has its SHA-256."""
        file = self._read()
        kept = {self._name: file.data, **file.surfaces}
        names = [*kept] if file.surfaces else self._name
        return {"geometry.file": names, "geometry.sha256": file.sha256}, kept

    @property
    def _name(self) -> str:
        return Path(_files(self.file)[0]).name

    @property
    def number_of_elements(self) -> int:  # type: ignore[override]
        """Of the file."""
        return len(self._mesh().cells)

    def check_size(self, mesh: Mesh) -> None:
        """Edges are halved, as often as asked for."""
        if mesh.refinement & (mesh.refinement - 1):
            raise fault("must be a power of 2: the elements of a file are halved", "mesh.refinement", mesh.refinement)

    # ------------------------------------------------------------ mesh
    def build(self, mesh: Mesh, comm: MPI.Intracomm | None = None) -> Domain:
        """The file's own mesh, split where the scene says so."""
        from mpi4py import MPI

        from remodel_fenicsx.body.mesh_domain import shared

        return shared(partial(self.checked, mesh), comm or MPI.COMM_WORLD, self.name)

    def checked(self, mesh: Mesh | None = None) -> tuple[MeshFile, mesh_faces.Boundary, dict[str, int]]:
        """The mesh, its boundary, and its regions' numbers by name; on rank 0."""
        file = self._mesh()
        scale = METRES[self.file_unit] / METRES[self.length_unit] if self.file_unit and self.length_unit else 1.0
        file = replace(file, points=scale * file.points)
        extent = float(np.ptp(file.points, axis=0).max())
        if not SMALLEST_LENGTH <= extent <= LARGEST_LENGTH:
            limits = f"allowed are {SMALLEST_LENGTH:g} to {LARGEST_LENGTH:g} (geometry.file_unit, geometry.length_unit)"
            raise self._fault(f"the body is {extent:g} long in the scene's unit; {limits}")
        try:
            boundary = self.boundary(file)
        except mesh_faces.FaceError as error:
            raise SceneError(f"geometry.faces.{error.face} = {shown(self._asked(error.face))}: {error}") from None
        except UnreadableFile as error:
            raise self._fault(str(error)) from None
        self.check_boundary(file, boundary)
        counts = f"{len(file.cells)} {file.kind[:-3]}ra of degree {file.degree}, {len(file.points)} nodes"
        log.info("%s: %s, SHA-256 %s", ", ".join([self._name, *file.surfaces]), counts, file.sha256)
        if mesh is not None and (mesh.refinement, mesh.degree) != (1, file.degree):
            file, boundary = self._refined(file, mesh)
        return file, boundary, self._regions(file)

    def _refined(self, file: MeshFile, mesh: Mesh) -> tuple[MeshFile, mesh_faces.Boundary]:
        """With smaller elements, or those of degree 2."""
        if file.degree != 1:
            asked = f"mesh.refinement = {mesh.refinement}, mesh.degree = {mesh.degree}: {self._name}"
            raise SceneError(f"{asked} has elements of degree {file.degree}: they are taken as they are")
        if (number := len(file.cells) * mesh.refinement**3) > LARGEST_MESH:
            raise SceneError(f"mesh.refinement = {mesh.refinement}: {number} elements; at most {LARGEST_MESH} are made")
        file = refined(file, mesh.refinement, mesh.degree)
        words = "the faces of the body stay plane as in the file"
        log.info("split into %d elements of degree %d; %s", len(file.cells), file.degree, words)
        return file, self.boundary(file)

    def _read(self) -> MeshFile:
        try:
            mesh, *surfaces = map(Path, _files(self.file))
            file = read_mesh(mesh, self.tags, surfaces)
        except UnreadableFile as error:
            raise self._fault(str(error)) from None
        if self.sha256 not in (None, file.sha256):
            raise self._fault(f"has changed: its SHA-256 was {str(self.sha256)[:12]}...")
        return file

    def _fault(self, rule: str) -> SceneError:
        return SceneError(f"geometry.file = {shown(self._name)}: {rule}")

    def _asked(self, face: str) -> Any:
        """As the scene says it, or by default."""
        entry: Names = self.faces.get(face, (face,))
        return entry[0] if len(entry) == 1 else list(entry)

    def boundary(self, file: MeshFile) -> mesh_faces.Boundary:
        """With the faces of the body, and further named ones of the file under their own names."""
        names, found = file.names[2], file.facet_groups
        asked = {face: (face,) for face in self.face_names} | self.faces
        groups = {face: _numbers(f"faces.{face}", entries, names, found) for face, entries in asked.items()}
        others = {*distinct(found)}.difference(*groups.values())
        further = {name: [n] for name, n in names.items() if n in others and name not in groups}
        return mesh_faces.boundary_of(file, groups, self.open_boundary, further)

    def _regions(self, file: MeshFile) -> dict[str, int]:
        numbers = distinct(file.cell_groups)
        if 0 in numbers and len(numbers) > 1:
            lost = file.cell_numbers[file.cell_groups == 0]
            raise self._fault(
                f"{len(lost)} elements are in no named volume, the first is {lost[0]}; name all volumes, or none"
            )
        names = {number: name for name, number in file.names[3].items()}
        return {names.get(number, str(number) if number else "body"): number for number in numbers}

    def _mesh(self) -> MeshFile:
        """That of the file: volumes of one region under one number, without others that have the same elements."""
        file = self._read()
        if not self.regions:
            return file
        groups, numbers = file.cell_groups.copy(), dict[str, int]()
        for name, entries in self.regions.items():
            numbers[name], *others = _numbers(f"regions.{name}", entries, file.names[3], file.cell_groups)
            groups[np.isin(groups, others)] = numbers[name]
        own = ~mesh_faces.again(file.corners, groups, numbers.values())
        further = {name: number for name, number in file.names[3].items() if number not in numbers.values()}
        return replace(
            file,
            cells=file.cells[own],
            cell_numbers=file.cell_numbers[own],
            cell_groups=groups[own],
            names={**file.names, 3: further | numbers},
        )

    def check_boundary(self, file: MeshFile, boundary: mesh_faces.Boundary) -> None:
        """Refuse faces that cannot be those of the body. On rank 0."""

    # ------------------------------------------------------------ supports
    def supports_of(self, supports: Supports) -> dict[str, Support]:
        """Those of a scene, and others that the body has where it says nothing."""
        return dict(supports)

    def hold(self, loading: Loading) -> None:
        """By its faces alone (`hold_faces`)."""

    @classmethod
    def loads_on(cls, faces: Mapping[str, OnFace]) -> dict[str, LoadKind]:
        """Loads on faces beside its own; `hold_faces` adds them."""
        return cls.loads | {name: ON_FACES[on.kind](on.face) for name, on in faces.items()}

    def fills(self, regions: Collection[str]) -> bool:
        """Whether they are all volumes of the file."""
        return bool(regions) and set(self._regions(self._mesh())) <= set(regions)

    def held_faces(self, supports: Supports) -> list[str]:
        """All but those that are free."""
        return [face for face, support in self.supports_of(supports).items() if support.kind != "free"]

    def check_faces(self, domain: Domain, supports: Supports, loads: Loads) -> None:
        """Whether they are there, the body cannot move as a whole, and no support takes all of a pressure."""
        for name in supports:
            if name not in domain.faces:
                raise SceneError(f"supports.{name}: the body has no such face; it has {', '.join(domain.faces)}")
        from remodel_fenicsx.body.mesh_domain import check_supports

        chosen = self.supports_of(supports)
        check_supports(domain, chosen, "elongation" in loads)  # type: ignore[arg-type]
        moved = {"outlet": "elongation"} if "elongation" in loads else {}
        for name, (face, load) in faces_of(loads).items():
            key, kind = f"loads.{name}.face = {shown(face)}", chosen.get(face, Support(kind="free")).kind
            if face not in domain.faces:
                raise SceneError(f"{key}: the body has no such face; it has {', '.join(domain.faces)}")
            if load == "displacement":
                if kind not in HELD_ACROSS:
                    able = " or ".join(map(repr, HELD_ACROSS))
                    rule = f"its support ({kind!r}) lets it move; a face that is displaced must be {able}"
                    raise SceneError(f"{key}: {rule}")
                if domain.boundary.goes_around(face):  # type: ignore[attr-defined]
                    raise SceneError(f"{key}: this face goes around the body, so that there is no direction")
                if face in moved:
                    raise SceneError(f"{key}: loads.{moved[face]} moves this face too; one of them is enough")
                moved[face] = name
            elif kind in HELD_ACROSS:
                raise SceneError(
                    f"{key}: its support ({kind!r}) takes all of the pressure; allowed are faces that move"
                )

    def hold_faces(self, loading: Loading, supports: Supports, modulus: float, loads: Loads) -> None:
        """Hold them as a scene says, inlet and outlet guided where it does not; add pressures on them. Collective."""
        from remodel_fenicsx.body.mesh_domain import GUIDE, add_support

        domain: Any = loading.domain
        self.check_faces(domain, supports, loads)
        length = domain.length()
        unit = f" {self.length_unit}" if self.length_unit else ""
        if domain.comm.rank == 0:
            words = f"{self.thickness_in_words} {domain.thickness:.6g}{unit}, with plane faces"
            log.info("%s%s", words, f"; length from inlet to outlet {length:.6g}{unit}" if length else "")
        on_faces = faces_of(loads)
        ways = {on.face: (name, 1.0) for name, on in on_faces.items() if on.kind == "displacement"}
        if "elongation" in loads:
            ways["outlet"] = "elongation", length
        for name, support in self.supports_of(supports).items():
            stiffness = GUIDE * modulus / domain.thickness
            add_support(loading, name, support, stiffness, ways.get(name))
        for name, on in on_faces.items():
            if on.kind == "pressure":
                loading.add_follower_pressure(name, on.face)


NODES_AT_A_DEPTH = 1e-3  # layers of nodes of a regular mesh have their depth to 1e-4


def _at(face: str, m: Any) -> Flags:
    """Elements that have a facet on a face."""
    from remodel_fenicsx.body.domain import cells_of

    found = np.zeros(m.quadrature.shape[0], dtype=np.bool_)
    found[cells_of(m.domain.mesh, m.domain.facets(face))[0]] = True
    return found


def _middle(m: Any) -> Flags:
    """Elements that are half-way through the wall; there are some in every mesh."""
    from remodel_fenicsx.fem.compat import geometry_dofmap

    depths = m.state.cells.local_axes.nodal_depth[geometry_dofmap(m.domain.mesh)]
    return (depths.min(axis=1) <= 0.5 + NODES_AT_A_DEPTH) & (depths.max(axis=1) >= 0.5 - NODES_AT_A_DEPTH)


def _mean_over(elements: Callable[[Any], Flags]) -> AngleOf:
    """The mean over elements that are looked for once."""
    return lambda m, values: m.quadrature.mean_of_known(values, m.tool(elements, lambda: elements(m)))


MEANS_ON_A_MESH: dict[str, tuple[str, AngleOf]] = {
    "inner": ("with a facet on the inner face", _mean_over(partial(_at, "inner"))),
    "middle": ("half-way through the wall", _mean_over(_middle)),
    "outer": ("with a facet on the outer face", _mean_over(partial(_at, "outer"))),
}


class WalledMesh(Walled):
    """A body with a wall whose local axes are found on its mesh.

    Faces "inner" and "outer" lie across the wall from each other, "inlet" and "outlet" across the body.
    """

    columns: ClassVar[Columns] = angle_columns(MEANS_ON_A_MESH)
    columns_on_request: ClassVar[Columns] = columns_on_request(MEANS_ON_A_MESH)
    axis_kinds = ("local", "global")
    constant_fields = CONSTANT_FIELDS
    defaults = {"cells": {"axes": "local"}}

    def log_of_radii(self, wall: Any) -> float | None:
        """Faces are as their radii; None if the wall does not go around."""
        area = getattr(wall, "area", None)  # of a mesh from a file; a drawn one knows no areas
        ratio = area("outer") / area("inner") if area is not None else 0.0
        return math.log(ratio) if ratio > 1.0 else None

    def local_axes(self, domain: Domain, quadrature: Quadrature) -> LocalAxes:
        """Found on the mesh by a few linear solves. Collective."""
        from remodel_fenicsx.body.axes import found_axes

        return found_axes(domain, quadrature)

    def depth(self, coordinates: Array) -> Array:
        """No function of the place: where it was not recorded all is one layer."""
        return np.zeros(coordinates.shape[:-1])


class MeshBody(WalledMesh, Unloads, FileBody):
    """A body of your own from a mesh file: a vessel with an inner and an outer face and ends.

    The file is data: it is read, and never run. Its elements are tetrahedra or hexahedra,
    all of one kind. A run keeps a copy of the file.
    """

    loads = {
        "pressure": LoadKind(
            lambda shape, loading, name: loading.add_follower_pressure(name, "inner"),
            "pressure on the deformed inner face",
            STRESS,
        ),
        "elongation": LoadKind(
            _by_hold_faces,
            "prescribed engineering strain of the length: the outlet moves along its own normal",
            column="axial_elongation",
            above=-1.0,
        ),
    }
    columns = (
        Column(
            "lumen_volume",
            "length^3",
            "volume inside the deformed inner face, closed by flat caps; empty where it encloses none",
            lambda m: m.lumen_volume(),
        ),
        *WalledMesh.columns,
    )
    columns_on_request = (
        Column(
            "outer_area",
            "length^2",
            "area of the deformed outer face",
            lambda m: m.face_area("outer", deformed=True),
        ),
        *WalledMesh.columns_on_request,
    )
    face_names = mesh_faces.ROLES
    thickness_in_words = "mean thickness of the wall"

    shape: Literal["mesh"] = "mesh"
    """Which body it is."""

    def check_boundary(self, file: MeshFile, boundary: mesh_faces.Boundary) -> None:
        """Whether inner and outer have each other's names."""
        inner, outer = boundary.area("inner"), boundary.area("outer")
        if inner > outer:
            words = f"its area is {inner:.4g}, that of outer {outer:.4g}: are inner and outer swapped?"
            raise SceneError(f"geometry.faces.inner = {shown(self._asked('inner'))}: {words}")
        if mesh_faces.through_the_wall(boundary):
            log.warning(
                "the wall is one element thick in places: bending, and how the fibre angle changes through it, are "
                "lost there; try mesh.refinement = 2"
            )

    def supports_of(self, supports: Supports) -> dict[str, Support]:
        """Inlet and outlet are guided."""
        return {"inlet": Support(), "outlet": Support()} | dict(supports)


class Solid(FileBody):
    """A body of your own from a mesh file, without a lumen: a gel between posts, a patch, a tendon of any shape.

    Its faces have any names; each that is held has a table `[supports.NAME]`. Directions are those of x, y and z.
    """

    loads = {}
    columns = (
        Column(
            "fibre_angle",
            "degrees",
            "angle between chains and the axis `geometry.axis` in the reference body, mean over the volume",
            lambda m: m.quadrature.mean_of_known(m.fibre_angle),
        ),
        Column("volume", "length^3", "deformed volume", lambda m: m.quadrature.integral(np.linalg.det(m.F))),
    )
    columns_on_request = cauchy_columns("x", "y", "z")
    angle_in_words = ("along the axis", "across")
    depth_in_words = ("in the body", "", "")

    shape: Literal["solid"] = "solid"
    """Which body it is."""
    axis: Literal["x", "y", "z"] = "x"
    """The axis to which fibre angles are measured."""

    def fibre_angle(self, dimensions: Any, axes: Any, local: Any) -> Any:
        """To `axis`."""
        return angle_to_axis(dimensions, axes, np.eye(3)["xyz".index(self.axis)])

    def depth(self, coordinates: Any) -> Any:
        """The body is one layer."""
        return np.zeros(coordinates.shape[:-1])

    station = depth


# ---------------------------------------------------------------- split meshes, and elements of degree 2, by Gmsh
# Gmsh's numbers of elements and facets of degree 1
SPLIT = {"tetrahedron": {3: 4, 2: 2}, "hexahedron": {3: 5, 2: 3}}


def refined(file: MeshFile, refinement: int, degree: int) -> MeshFile:
    """A mesh of plane elements, split into halves along each edge, as often as asked for."""
    with gmsh_model("file") as gmsh:
        model, mesh, number = gmsh.model, gmsh.model.mesh, [*range(1, len(file.points) + 1)]
        for dimension, rows, groups in ((3, file.cells, file.cell_groups), (2, file.facets, file.facet_groups)):
            for group in distinct(groups):
                entity = model.addDiscreteEntity(dimension)
                mesh.addNodes(dimension, entity, number, file.points.reshape(-1))
                number = []
                mesh.addElementsByType(entity, SPLIT[file.kind][dimension], [], 1 + rows[groups == group].reshape(-1))
                if group:
                    model.addPhysicalGroup(dimension, [entity], group)
        for _ in range(refinement.bit_length() - 1):
            mesh.refine()
        if degree == 2:
            before = gmsh.option.getNumber("Mesh.SecondOrderLinear")
            gmsh.option.setNumber("Mesh.SecondOrderLinear", 1)
            mesh.setOrder(2)
            gmsh.option.setNumber("Mesh.SecondOrderLinear", before)
        points, blocks = of_gmsh()
    return assembled(points, blocks, file.names, file.data)
