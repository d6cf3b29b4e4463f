"""Files of measured fibres (VTU, XDMF, CSV), read as data: nothing in them is executed."""

from __future__ import annotations

import hashlib
import itertools
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from remodel_fenicsx.body.mesh_file import format_position, read_exchange_file
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.model.axes import MEASURED, FIBRE_INPUTS, fibres_problem
from remodel_fenicsx.model.tensors import Array, Flags, Integers
from remodel_fenicsx.schema.units import convention_doubt
from remodel_fenicsx.schema.text import read_columns
from remodel_fenicsx.system.files import read_regular
from remodel_fenicsx.system.children import LARGEST_FILE


log = logging.getLogger(__name__)

FIBRE_ENDINGS = (".vtu", ".xdmf", ".csv")
SOLID = ("tetra", "hexa", "wedge")  # prefixes of the names of element types
# Largest distance of the same position, over the element size. Files may have 7 digits; the
# neighbouring element is one element size away.
SAME_PLACE = 1e-4
SYMMETRIC_COMPONENTS = ("xx", "yy", "zz", "xy", "yz", "xz")
ALL_COMPONENTS = tuple(f"{i}{j}" for i in "xyz" for j in "xyz")
GROUPS = {
    "structure_tensor": ALL_COMPONENTS,
    "fibre": tuple("xyz"),
    "fibre_2": tuple("xyz"),
}  # columns of a table
OF_GROUPS = {name: tuple(f"{name}_{c}" for c in parts) for name, parts in GROUPS.items()}
OF_ONE_COLUMN = ("element", "angle", "weight")
OF_TABLES = (*"xyz", *OF_ONE_COLUMN, *itertools.chain(*OF_GROUPS.values()))
# ParaView writes the number of a component, and Points for positions.
SPELLINGS = {
    f"{name}:{n}": f"{name}_{c}" for name, parts in GROUPS.items() for n, c in enumerate(parts)
}
SPELLINGS |= {f"points{mark}{n}": c for n, c in enumerate("xyz") for mark in ":_"}
EXPORTED = [f"cell_dimension_{i}" for i in (1, 2, 3)] + [
    f"axis_{i}_{c}" for i in (1, 2, 3) for c in "xyz"
]


@dataclass(frozen=True)
class FibreFile:
    """Contents of a file of fibres."""

    measured: dict[str, Array]
    places: Array | None
    data: bytes

    @property
    def sha256(self) -> str:
        """SHA-256 of the file, in hexadecimal digits."""
        return hashlib.sha256(self.data).hexdigest()

    def rows_of(self, corners: Array, chosen: Flags) -> tuple[Integers, float | None]:
        """Return the row for each element of a mesh, and the largest distance between the two.

        The distance is None if the rows are the elements.
        """
        count, centres = len(next(iter(self.measured.values()))), corners.mean(axis=1)
        sizes = 2 * np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
        if count == len(centres):
            if (
                self.places is None
                or (np.abs(self.places - centres) < SAME_PLACE * sizes[:, None]).all()
            ):
                return np.arange(count), None
        if self.places is None:
            raise UnreadableFile(
                f"has {count} rows without positions x, y, z; the mesh has {len(centres)} elements"
            )
        rows = np.zeros(len(centres), dtype=np.int64)
        far, rows[chosen] = cKDTree(self.places).query(centres[chosen])
        if (far > sizes[chosen]).any():
            worst = (far / sizes[chosen]).argmax()
            place, size = format_position(centres[chosen][worst]), sizes[chosen][worst]
            rule = f"has no measurement within one element ({size:.3g}) of {place}; "
            raise UnreadableFile(rule + f"the nearest is {far[worst]:.3g} away")
        return rows, float(far.max())


def read_fibre_file(path: Path) -> FibreFile:
    """Read a file of measured fibres."""
    ending = path.suffix.lower()
    if ending not in FIBRE_ENDINGS:
        raise UnreadableFile(f"must be a file {', '.join(FIBRE_ENDINGS)}")
    try:
        if ending == ".csv":
            data = read_regular(path, LARGEST_FILE)
            measured, places = _of_csv(data, path.name)
        else:
            measured, places, data = _of_mesh(path)
    except OSError as error:
        raise UnreadableFile(f"cannot be read: {error.strerror or error}") from error
    if (problem := fibres_problem(measured)) is not None:
        raise UnreadableFile(problem)
    if places is not None and not np.isfinite(places).all():
        raise UnreadableFile("has positions that are not finite")
    if "angle" in measured and (words := convention_doubt("angle", measured["angle"])):
        log.warning("%s, angle: %s", path.name, words)
    return FibreFile(measured, places, data)


def _of_csv(data: bytes, file: str) -> tuple[dict[str, Array], Array | None]:
    """Read columns structure_tensor_xx, fibre_x, fibre_2_x ..., weight, angle, element, x, y, z."""
    columns = read_columns(data, file, OF_TABLES, SPELLINGS, EXPORTED)
    groups = [
        *OF_GROUPS.items(),
        ("places", "xyz"),
        *((name, [name]) for name in OF_ONE_COLUMN),
    ]
    groups.insert(0, ("structure_tensor", [f"structure_tensor_{c}" for c in SYMMETRIC_COMPONENTS]))
    measured, used = dict[str, Array](), set[str]()
    for name, keys in groups:
        if set(keys) <= set(columns):
            measured[name] = np.stack([columns[key] for key in keys], axis=1)
            used |= {*keys}
    if left := [name for name in columns if name not in used]:
        raise UnreadableFile(
            f"has {', '.join(left)} without the other columns of x, y, z or of the tensor"
        )
    places, elements = measured.pop("places", None), measured.pop("element", None)
    if not set(measured) & set(FIBRE_INPUTS):
        raise UnreadableFile(
            f"has columns {', '.join(columns)}; {_NEEDED} with _xx ... or _x, _y, _z"
        )
    if elements is None:
        return measured, places
    order = np.argsort(elements[:, 0])
    if not np.array_equal(elements[order, 0], np.arange(1, len(order) + 1)):
        raise UnreadableFile(
            f"the column element must have the numbers 1 to {len(order)}, each once"
        )
    return {name: values[order] for name, values in measured.items()}, (
        None if places is None else places[order]
    )


_NEEDED = f"must have one of {', '.join(FIBRE_INPUTS)}"


def _of_mesh(path: Path) -> tuple[dict[str, Array], Array, bytes]:
    """Read arrays of the solid elements, or else of the points, their positions and the file."""
    mesh = read_exchange_file(path)
    try:
        solid = [rows for kind, rows in mesh.cells if kind.startswith(SOLID)]
        chosen = np.repeat(
            [kind.startswith(SOLID) for kind, _ in mesh.cells],
            [len(rows) for _, rows in mesh.cells],
        )
        of_cells = {
            name: _columns(values)[chosen]
            for name, values in mesh.cell_data.items()
            if name in MEASURED and solid
        }
        of_points = {
            name: _columns(values) for name, values in mesh.point_data.items() if name in MEASURED
        }
        points = np.asarray(mesh.points, dtype=np.float64)
        points = np.pad(points, [(0, 0), (0, 3 - points.shape[1])])
        centres = [points[rows].mean(axis=1) for rows in solid]
    except (ValueError, TypeError, IndexError) as error:
        raise UnreadableFile(
            f"has arrays that do not fit its elements: {' '.join(str(error).split())}"
        ) from error
    if set(of_cells) & set(FIBRE_INPUTS):
        return of_cells, np.concatenate(centres), mesh.data
    if set(of_points) & set(FIBRE_INPUTS):
        return of_points, points, mesh.data
    known = ", ".join([*mesh.cell_data, *mesh.point_data]) or "none"
    raise UnreadableFile(f"has arrays {known}; {_NEEDED}")


def _columns(values: Array) -> Array:
    """Reshape an array to (rows, columns)."""
    rows = np.asarray(values, dtype=np.float64)
    return rows.reshape(len(rows), -1)
