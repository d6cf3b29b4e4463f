"""User-supplied bodies: the mesh of a file with named faces, of a vessel or of a solid."""

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
    unique_in_order,
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
from remodel_fenicsx.body.wall import (
    LUMEN_EXPANSION,
    AngleOf,
    Walled,
    angle_columns,
    columns_on_request,
)
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.axes import LocalAxes
from remodel_fenicsx.model.cells import angle_to_axis
from remodel_fenicsx.model.tensors import Array, Flags, Integers
from remodel_fenicsx.schema.settings import (
    CONSTANT_FIELDS,
    LARGEST_MESH,
    Mesh,
    OnFace,
    Support,
    faces_of,
)
from remodel_fenicsx.schema.tables import SceneError, validation_error, format_value
from remodel_fenicsx.schema.units import LENGTH, LENGTH_UNITS, METRES, STRESS

if TYPE_CHECKING:
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import Domain
    from remodel_fenicsx.body.loading import Loading
    from remodel_fenicsx.body.mesh_domain import MeshDomain
    from remodel_fenicsx.fem.quadrature import Quadrature

log = logging.getLogger(__name__)

HELD_ACROSS = ("guided", "sliding", "held")  # kinds of support that prevent motion along the normal
ABLE = " or ".join(map(repr, HELD_ACROSS))
ON_FACES: dict[str, Callable[[str], LoadKind]] = {
    "pressure": lambda face: LoadKind(
        _by_hold_faces, f"pressure on the deformed face {face}", STRESS
    ),
    "displacement": lambda face: LoadKind(
        _by_hold_faces, f"displacement of the face {face} along its outward normal", LENGTH
    ),
    "traction": lambda face: LoadKind(
        _by_hold_faces, f"dead traction on the face {face}, force per reference area", STRESS
    ),
}
Names = tuple[str | int, ...]
_ENTRY: JsonDict = {"type": ["string", "integer"]}
_GROUPS: JsonDict = {
    "allowed": "a table of names, numbers or lists of them",
    "additionalProperties": {"anyOf": [_ENTRY, {"type": "array", "items": _ENTRY, "minItems": 1}]},
}


def _by_hold_faces(shape: Any, loading: Any, name: str) -> None:
    """Do nothing: `hold_faces` adds the load with the supports."""


def _faces(value: Any) -> Any:
    """Validate names or numbers, one or a list, as tuples."""
    if not isinstance(value, Mapping):
        raise validation_error(
            "must be a table: names or numbers of the file's faces or volumes, as in inner = 3"
        )
    groups = {}
    for name, entry in value.items():
        entries = entry if isinstance(entry, (list, tuple)) else [entry]
        if not entries or not all(
            isinstance(one, (str, int)) and not isinstance(one, bool) for one in entries
        ):
            rule = "must be a name or a number in the file, or a list of them"
            rule += "; a face may be { file = 'surface.vtp' }"
            raise validation_error(rule, str(name), entry)
        groups[str(name)] = tuple(entries)
    return groups


Groups = Annotated[dict[str, Names], BeforeValidator(_faces), Field(json_schema_extra=_GROUPS)]


def _files(value: Any) -> list[str]:
    """Return the paths of a mesh and its surfaces, from one path or a list, or an empty list."""
    mesh, *surfaces = value if isinstance(value, (list, tuple)) and value else [value]
    are_files = _ends_with(mesh, READERS) and all(_ends_with(one, SURFACES) for one in surfaces)
    return [mesh, *surfaces] if are_files else []


def _ends_with(file: Any, endings: Collection[str]) -> bool:
    return isinstance(file, str) and "\x00" not in file and Path(file).suffix.lower() in endings


def _file(value: Any) -> Any:
    files = _files(value)
    if not files:
        mesh, surfaces = ", ".join(READERS), ", ".join(SURFACES)
        raise validation_error(
            f"must be the path of a mesh ({mesh}), relative to the scene's folder, or a list of it "
            f"and paths of its surfaces ({surfaces})"
        )
    return tuple(files) if files[1:] else files[0]


def _together(geometry: Mapping[str, Any]) -> dict[str, Any]:
    """Add surfaces that faces name as files, inner = { file = "lumen.vtp" }, to the key `file`."""
    faces, file = geometry.get("faces", {}), geometry.get("file")
    files, named = file if isinstance(file, (list, tuple)) else [file], {}
    for face, one in faces.items() if isinstance(faces, Mapping) else ():
        if isinstance(one, Mapping) and _ends_with(one.get("file"), SURFACES):
            files, named[face] = [*files, one["file"]], Path(one["file"]).stem
    return (
        {**geometry, "file": [*dict.fromkeys(files)], "faces": {**faces, **named}}
        if named
        else dict(geometry)
    )


def _numbers(key: str, entries: Names, names: Mapping[str, int], groups: Integers) -> list[int]:
    """Return the file's numbers of a face's or region's entries, names or numbers."""
    there = {*unique_in_order(groups)} - {0}
    numbers = [names.get(entry, 0) if isinstance(entry, str) else int(entry) for entry in entries]
    for entry, number in zip(entries, numbers, strict=True):
        if number not in there:
            listed = [*map(repr, names), *map(str, sorted(there - {*names.values()}))]
            word = "face" if key.startswith("faces") else "volume"
            rule = f"the file has no such {word}; it has {', '.join(listed) or 'none'}"
            raise SceneError(f"geometry.{key} = {format_value(entry)}: {rule}")
    return numbers


class FileBody(WithRegions, FromFile):
    """Body with the mesh, faces and regions of a file."""

    supported_faces = None
    thickness_in_words: ClassVar[str] = "cube root of the volume (elements with plane faces)"

    file: Annotated[str | tuple[str, ...], BeforeValidator(_file)] = Field(
        json_schema_extra={
            "allowed": "the path of a file .msh, .vtu, .vtk or .xdmf, "
            "or a list with surfaces after it"
        }
    )
    """The mesh, relative to the scene. In a list, surfaces of its triangles may follow (`.vtp`,
    `.stl`, `.ply`, `.obj`), which are faces under the names of their files
    (docs/my_own_vessel.md)."""
    tags: str | None = Field(
        default=None,
        min_length=1,
        description="For files not in Gmsh's format: the integer array that numbers faces and "
        "volumes. Default: the first of "
        + ", ".join(f"`{name}`" for name in TAGS)
        + " in the file.",
        json_schema_extra={"allowed": "the name of an array"},
    )
    file_unit: Literal["m", "cm", "mm", "um"] | None = Field(
        default=None, json_schema_extra={"allowed": "one of " + ", ".join(map(repr, LENGTH_UNITS))}
    )
    """Unit of the numbers in the file, if it differs from `length_unit`."""
    faces: Groups = {}
    """Names of faces, each with the name or number of a face in the file, or a list of them:
    `inner`, `outer`, `inlet` and `outlet` where the file has other names, and more for supports
    and loads. A surface of its own is a face too: `{ file = "lumen.vtp" }`."""
    regions: Groups = {}
    """Names of regions, each with the name or number of a volume in the file, or a list of
    them. Default: the names in the file."""
    open_boundary: bool = False
    """Whether parts of the boundary may belong to no face. Otherwise such a part is rejected as a
    hole."""
    sha256: str | None = Field(
        default=None,
        pattern="^[0-9a-f]{64}$",
        json_schema_extra={"allowed": "64 hexadecimal digits"},
    )
    """SHA-256 of the file, or of several files together. The scene that a run stores has it, and
    rejects other files."""

    @model_validator(mode="before")
    @classmethod
    def _surfaces_of_faces(cls, values: Any) -> Any:
        return _together(values) if isinstance(values, Mapping) else values

    @model_validator(mode="after")
    def _units_are_both_there(self) -> Any:
        if self.file_unit is not None and self.length_unit is None:
            raise validation_error(
                "needs geometry.length_unit, the unit of the scene", "file_unit", self.file_unit
            )
        return self

    @classmethod
    def with_files_from(cls, geometry: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """Return the keys as read, with the absolute paths of the files."""
        values = _together(geometry)
        places = [str(folder.absolute() / file) for file in _files(values.get("file"))]
        return values | ({"file": places} if places else {})

    @classmethod
    def defaults_of(cls, own: Mapping[str, Any]) -> dict[str, Any]:
        """Return defaults with the file's element and degree, unless the scene sets both."""
        mesh, files = own.get("mesh", {}), _files(_together(own["geometry"]).get("file"))
        if not files or (isinstance(mesh, Mapping) and "element" in mesh and "degree" in mesh):
            return cls.defaults
        tags, (file, *surfaces) = own["geometry"].get("tags"), map(Path, files)
        try:
            mesh_file = read_mesh(file, tags if isinstance(tags, str) else None, surfaces)
        except UnreadableFile as error:
            raise validation_error(str(error), "geometry.file", file.name) from None
        return cls.defaults | {"mesh": {"element": mesh_file.kind, "degree": mesh_file.degree}}

    def kept_files(self) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Return the file under its own name, to store with the scene, and its SHA-256."""
        file = self._read()
        kept = {self._name: file.data, **file.surfaces}
        names = [*kept] if file.surfaces else self._name
        return {"geometry.file": names, "geometry.sha256": file.sha256}, kept

    @property
    def _name(self) -> str:
        return Path(_files(self.file)[0]).name

    @property
    def number_of_elements(self) -> int:  # type: ignore[override]
        """Number of elements in the file."""
        return len(self._mesh().cells)

    def check_size(self, mesh: Mesh) -> None:
        """Check that the refinement is a power of 2, because edges are halved."""
        if mesh.refinement & (mesh.refinement - 1):
            raise validation_error(
                "must be a power of 2: the elements of a file are halved",
                "mesh.refinement",
                mesh.refinement,
            )

    # ------------------------------------------------------------ mesh
    def build(self, mesh: Mesh, comm: MPI.Intracomm | None = None) -> Domain:
        """Build the mesh of the file, refined as the scene requests. Collective."""
        from mpi4py import MPI

        from remodel_fenicsx.body.mesh_domain import shared

        return shared(partial(self.checked, mesh), comm or MPI.COMM_WORLD, self.name)

    def checked(
        self, mesh: Mesh | None = None
    ) -> tuple[MeshFile, mesh_faces.Boundary, dict[str, int]]:
        """Return the mesh, its boundary, and the numbers of its regions by name, on rank 0."""
        file = self._mesh()
        scale = (
            METRES[self.file_unit] / METRES[self.length_unit]
            if self.file_unit and self.length_unit
            else 1.0
        )
        file = replace(file, points=scale * file.points)
        extent = float(np.ptp(file.points, axis=0).max())
        if not SMALLEST_LENGTH <= extent <= LARGEST_LENGTH:
            limits = f"must be {SMALLEST_LENGTH:g} to {LARGEST_LENGTH:g}"
            raise self._fault(
                f"the body is {extent:g} long in the scene's unit; {limits} "
                "(geometry.file_unit, length_unit)"
            )
        try:
            boundary = self.boundary(file)
        except mesh_faces.FaceError as error:
            raise SceneError(
                f"geometry.faces.{error.face} = {format_value(self._asked(error.face))}: {error}"
            ) from None
        except UnreadableFile as error:
            raise self._fault(str(error)) from None
        self.check_boundary(boundary)
        counts = f"{len(file.cells)} {file.kind[:-3]}ra of degree {file.degree}, "
        counts += f"{len(file.points)} nodes"
        log.info("%s: %s, SHA-256 %s", ", ".join([self._name, *file.surfaces]), counts, file.sha256)
        if mesh is not None and (mesh.refinement, mesh.degree) != (1, file.degree):
            file, boundary = self._refined(file, mesh)
        return file, boundary, self._regions(file)

    def _refined(self, file: MeshFile, mesh: Mesh) -> tuple[MeshFile, mesh_faces.Boundary]:
        """Return the mesh with smaller elements, or with elements of degree 2, and its boundary."""
        if file.degree != 1:
            asked = (
                f"mesh.refinement = {mesh.refinement}, mesh.degree = {mesh.degree}: {self._name}"
            )
            raise SceneError(f"{asked} has elements of degree {file.degree}, which are not refined")
        if (number := len(file.cells) * mesh.refinement**3) > LARGEST_MESH:
            raise SceneError(
                f"mesh.refinement = {mesh.refinement}: {number} elements; "
                f"must be at most {LARGEST_MESH}"
            )
        file = refined(file, mesh.refinement, mesh.degree)
        text = "split into %d elements of degree %d; the faces stay plane as in the file"
        log.info(text, len(file.cells), file.degree)
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
        return SceneError(f"geometry.file = {format_value(self._name)}: {rule}")

    def _asked(self, face: str) -> Any:
        """Return the scene's entry of a face, or the default."""
        entry: Names = self.faces.get(face, (face,))
        return entry[0] if len(entry) == 1 else list(entry)

    def boundary(self, file: MeshFile) -> mesh_faces.Boundary:
        """Return the boundary with the body's faces, and the file's further named faces."""
        names, of_facets = file.names[2], file.facet_groups
        asked = {face: (face,) for face in self.face_names} | self.faces
        groups = {
            face: _numbers(f"faces.{face}", entries, names, of_facets)
            for face, entries in asked.items()
        }
        others = {*unique_in_order(of_facets)}.difference(*groups.values())
        further = {name: [n] for name, n in names.items() if n in others and name not in groups}
        return mesh_faces.boundary_of(file, groups, self.open_boundary, further)

    def _regions(self, file: MeshFile) -> dict[str, int]:
        numbers = unique_in_order(file.cell_groups)
        if 0 in numbers and len(numbers) > 1:
            lost = file.cell_numbers[file.cell_groups == 0]
            raise self._fault(
                f"{len(lost)} elements are in no named volume, the first is {lost[0]}; "
                "name all volumes, or none"
            )
        names = {number: name for name, number in file.names[3].items()}
        return {names.get(number, str(number) if number else "body"): number for number in numbers}

    def _mesh(self) -> MeshFile:
        """Return the file's mesh with one number a region, without duplicate elements."""
        file = self._read()
        if not self.regions:
            return file
        groups, numbers = file.cell_groups.copy(), dict[str, int]()
        for name, entries in self.regions.items():
            numbers[name], *others = _numbers(
                f"regions.{name}", entries, file.names[3], file.cell_groups
            )
            groups[np.isin(groups, others)] = numbers[name]
        own = ~mesh_faces.shared_entities(file.corners, groups, numbers.values())
        further = {
            name: number for name, number in file.names[3].items() if number not in numbers.values()
        }
        return replace(
            file,
            cells=file.cells[own],
            cell_numbers=file.cell_numbers[own],
            cell_groups=groups[own],
            names={**file.names, 3: further | numbers},
        )

    def check_boundary(self, boundary: mesh_faces.Boundary) -> None:
        """Check that the faces can be those of the body, on rank 0."""

    # ------------------------------------------------------------ supports
    def supports_of(self, supports: Supports) -> dict[str, Support]:
        """Return the supports of the scene, completed by the body's default supports."""
        return dict(supports)

    def hold(self, loading: Loading) -> None:
        """Do nothing: only `hold_faces` supports the body."""

    @classmethod
    def loads_on(cls, faces: Mapping[str, OnFace]) -> dict[str, LoadKind]:
        """Return the body's loads and those on faces, which `hold_faces` adds."""
        return cls.loads | {name: ON_FACES[on.kind](on.face) for name, on in faces.items()}

    def covers_body(self, regions: Collection[str]) -> bool:
        """Return whether the regions are all volumes of the file."""
        return bool(regions) and set(self._regions(self._mesh())) <= set(regions)

    def held_faces(self, supports: Supports) -> list[str]:
        """Return the names of all faces with a support other than 'free'."""
        return [
            face for face, support in self.supports_of(supports).items() if support.kind != "free"
        ]

    def check_faces(self, domain: Domain, supports: Supports, loads: Loads) -> None:
        """Check that the faces exist, no rigid motion is free, and loads fit the supports."""
        lacking = f"the body has no such face; it has {', '.join(domain.faces)}"
        for name in supports:
            if name not in domain.faces:
                raise SceneError(f"supports.{name}: {lacking}")
        from remodel_fenicsx.body.mesh_domain import check_supports

        chosen = self.supports_of(supports)
        check_supports(domain, chosen, "elongation" in loads)  # type: ignore[arg-type]
        moved = {"outlet": "elongation"} if "elongation" in loads else {}
        for name, (face, load) in faces_of(loads).items():
            key, kind = (
                f"loads.{name}.face = {format_value(face)}",
                chosen.get(face, Support(kind="free")).kind,
            )
            if face not in domain.faces:
                raise SceneError(f"{key}: {lacking}")
            if load == "displacement":
                if kind not in HELD_ACROSS:
                    rule = f"its support ({kind!r}) lets it move"
                    raise SceneError(f"{key}: {rule}; a face that is displaced must be {ABLE}")
                if domain.boundary.goes_around(face):  # type: ignore[attr-defined]
                    raise SceneError(
                        f"{key}: this face goes around the body, so that it has no mean normal, "
                        "the direction of the displacement; choose a part of it, or another face"
                    )
                if face in moved:
                    raise SceneError(
                        f"{key}: loads.{moved[face]} moves this face too; one of them is enough"
                    )
                moved[face] = name
            elif kind in (HELD_ACROSS if load == "pressure" else ("held",)):
                raise SceneError(
                    f"{key}: its support ({kind!r}) carries the {load}; must be a face that moves"
                )

    def hold_faces(
        self, loading: Loading, supports: Supports, modulus: float, loads: Loads
    ) -> None:
        """Add the scene's and default supports, and pressures on faces. Collective."""
        from remodel_fenicsx.body.mesh_domain import GUIDE, add_support

        domain: Any = loading.domain
        self.check_faces(domain, supports, loads)
        length = domain.length()
        unit = f" {self.length_unit}" if self.length_unit else ""
        words = f"; length from inlet to outlet {length:.6g}{unit}" if length else ""
        log.info("%s %.6g%s%s", self.thickness_in_words, domain.thickness, unit, words)
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
            elif on.kind == "traction":
                loading.add_dead_traction(name, on.face, loads[name].direction or ())


ENDS, LUMEN = ("inlet", "outlet"), "lumen_expansion"
ONE_PLANE = 1e-6  # singular value of unit normals in one plane; of meshes in single precision 1e-7
NODES_AT_A_DEPTH = 1e-3  # tolerance of depth; nodes of a layer in a regular mesh agree to 1e-4


def _at(face: str, m: Any) -> Flags:
    """Mark the elements that have a facet on a face."""
    from remodel_fenicsx.body.domain import cells_of

    is_at_face = np.zeros(m.quadrature.shape[0], dtype=np.bool_)
    is_at_face[cells_of(m.domain.mesh, m.domain.facets(face))[0]] = True
    return is_at_face


def _middle(m: Any) -> Flags:
    """Mark the elements at mid-wall; every mesh has some."""
    from remodel_fenicsx.fem.compat import geometry_dofmap

    cells = m.state.cells
    depths = cells.local_axes.nodal_depth[geometry_dofmap(m.domain.mesh)]
    return (depths.min(axis=1) <= 0.5 + NODES_AT_A_DEPTH) & (
        depths.max(axis=1) >= 0.5 - NODES_AT_A_DEPTH
    )


def _mean_over(elements: Callable[[Any], Flags]) -> AngleOf:
    """Return the mean over elements, which are selected once."""
    return lambda m, values: m.quadrature.nanmean(values, m.cached(elements, lambda: elements(m)))


MEANS_ON_A_MESH: dict[str, tuple[str, AngleOf]] = {
    "inner": ("with a facet on the inner face", _mean_over(partial(_at, "inner"))),
    "middle": ("at mid-wall", _mean_over(_middle)),
    "outer": ("with a facet on the outer face", _mean_over(partial(_at, "outer"))),
}


class WalledMesh(Walled):
    """Body with a wall whose local axes are computed on its mesh.

    The faces "inner" and "outer" are opposite across the wall; "inlet" and "outlet" bound its
    length.
    """

    columns: ClassVar[Columns] = angle_columns(MEANS_ON_A_MESH)
    columns_on_request: ClassVar[Columns] = columns_on_request(MEANS_ON_A_MESH)
    axis_kinds = ("local", "global")
    constant_fields = CONSTANT_FIELDS
    defaults = {"cells": {"axes": "local"}}

    def log_of_radii(self, wall: Any) -> float | None:
        """Return the logarithm of the faces' area ratio, or None for an open wall."""
        area = getattr(wall, "area", None)  # only a mesh from a file has it
        ratio = area("outer") / area("inner") if area is not None else 0.0
        return math.log(ratio) if ratio > 1.0 else None

    def local_axes(self, domain: Domain, quadrature: Quadrature) -> LocalAxes:
        """Compute the local axes on the mesh by a few linear solves. Collective."""
        from remodel_fenicsx.body.axes import compute_local_axes

        return compute_local_axes(domain, quadrature)

    def depth(self, coordinates: Array) -> Array:
        """Return zero: unrecorded depth is unknown, so that all is one layer."""
        return np.zeros(coordinates.shape[:-1])


class MeshBody(WalledMesh, Unloads, FileBody):
    """User-supplied mesh of a vessel with an inner and an outer face and ends.

    The file is read as data and never executed. Its elements are tetrahedra or hexahedra, all of
    one type. A run stores a copy of the file.
    """

    loads = {
        "pressure": LoadKind(
            lambda shape, loading, name: loading.add_follower_pressure(name, "inner"),
            "pressure on the deformed inner face",
            STRESS,
            value=lambda m: m.state.loading.lumen_pressure(),
            replaces="lumen_expansion",
        ),
        "elongation": LoadKind(
            _by_hold_faces,
            "prescribed engineering strain of the length: the outlet moves along its own normal",
            column="axial_elongation",
            above=-1.0,
        ),
        "lumen_expansion": LUMEN_EXPANSION,
    }
    columns = (
        Column(
            "lumen_volume",
            "length^3",
            "volume inside the deformed inner face, closed by flat caps; empty if it encloses none",
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
    thickness_in_words = "mean thickness of the wall (volume over area, elements with plane faces)"

    shape: Literal["mesh"] = "mesh"
    """Shape of the body."""

    def check_boundary(self, boundary: mesh_faces.Boundary) -> None:
        """Check that inner and outer are not swapped, and warn of a wall of one element."""
        inner, outer = boundary.area("inner"), boundary.area("outer")
        if inner > outer:
            words = (
                f"its area is {inner:.4g}, that of outer {outer:.4g}: are inner and outer swapped?"
            )
            raise SceneError(
                f"geometry.faces.inner = {format_value(self._asked('inner'))}: {words}"
            )
        if mesh_faces.through_the_wall(boundary):
            log.warning(
                "the wall is one element thick in places, which resolves neither bending nor the "
                "fibre angle over depth; set mesh.refinement = 2"
            )

    def supports_of(self, supports: Supports) -> dict[str, Support]:
        """Return the supports of the scene; by default inlet and outlet are guided."""
        return {"inlet": Support(), "outlet": Support()} | dict(supports)

    def check_faces(self, domain: Domain, supports: Supports, loads: Loads) -> None:
        """Check that a lumen of prescribed volume has an end on each rim, in its plane."""
        super().check_faces(domain, supports, loads)
        if LUMEN not in loads:
            return
        for face in ENDS:
            if (kind := self.supports_of(supports)[face].kind) not in HELD_ACROSS:
                rule = f"must be {ABLE} with loads.{LUMEN}: the lumen is closed by plane ends"
                raise SceneError(f"supports.{face}.kind = {kind!r}: {rule}")
        moved = [name for name, on in faces_of(loads).items() if on.kind == "displacement"]
        moved += {"elongation"} & {*loads}
        across, _ = self.lumen(domain)  # type: ignore[arg-type]
        if moved and not across.size:
            rule = f"not allowed with loads.{LUMEN}: the normals of all ends lie in no plane"
            raise SceneError(f"loads.{moved[0]}: {rule}")

    def lumen(self, domain: MeshDomain) -> tuple[Array, float]:
        """Return `across` and `caps` of `Loading.add_lumen_expansion`. Collective."""
        ends = [part for face in ENDS for part in domain.boundary.parts(face)]
        if len(domain.rims) != len(ends):
            rule = f"the inner face has {len(domain.rims)} rims for {len(ends)} ends"
            raise SceneError(f"loads.{LUMEN}: {rule}, so that it encloses no lumen")
        _, sizes, directions = np.linalg.svd([part.normal for part in ends])
        across = directions[int((sizes > ONE_PLANE).sum()) :].T
        nodes = domain.gather_nodes(domain.mesh.geometry.x)
        return across, 0.0 if across.size else domain.caps(nodes)


class Solid(FileBody):
    """User-supplied mesh without a lumen: a gel between posts, a patch, a tendon of any shape.

    Its faces have any names. Each supported face has a table `[supports.NAME]`. Directions are x, y
    and z.
    """

    loads = {}
    columns = (
        Column(
            "fibre_angle",
            "degrees",
            "angle between chains and `geometry.axis` in the reference configuration, volume mean",
            lambda m: m.quadrature.nanmean(m.fibre_angle),
        ),
        Column(
            "volume",
            "length^3",
            "deformed volume",
            lambda m: m.quadrature.integral(np.linalg.det(m.F)),
        ),
    )
    columns_on_request = cauchy_columns("x", "y", "z")
    angle_in_words = ("along the axis", "across")
    depth_labels = ("in the body", "", "")

    shape: Literal["solid"] = "solid"
    """Shape of the body."""
    axis: Literal["x", "y", "z"] = "x"
    """Axis from which fibre angles are measured."""

    def fibre_angle(self, dimensions: Any, axes: Any, local: Any) -> Any:
        """Return the angle of the chains to `axis`."""
        return angle_to_axis(dimensions, axes, np.eye(3)["xyz".index(self.axis)])

    def depth(self, coordinates: Any) -> Any:
        """Return zero: the body is one layer."""
        return np.zeros(coordinates.shape[:-1])

    station = depth


# ---------------------------------------------------------------- refined meshes by Gmsh
# Gmsh's numbers of the element and facet types of degree 1.
SPLIT = {"tetrahedron": {3: 4, 2: 2}, "hexahedron": {3: 5, 2: 3}}


def refined(file: MeshFile, refinement: int, degree: int) -> MeshFile:
    """Halve the edges of a mesh of plane elements `log2(refinement)` times, and set the degree."""
    with gmsh_model("file") as gmsh:
        model, mesh = gmsh.model, gmsh.model.mesh
        number = [*range(1, len(file.points) + 1)]
        for dimension, rows, groups in (
            (3, file.cells, file.cell_groups),
            (2, file.facets, file.facet_groups),
        ):
            for group in unique_in_order(groups):
                entity = model.addDiscreteEntity(dimension)
                mesh.addNodes(dimension, entity, number, file.points.reshape(-1))
                number = []
                mesh.addElementsByType(
                    entity, SPLIT[file.kind][dimension], [], 1 + rows[groups == group].reshape(-1)
                )
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
