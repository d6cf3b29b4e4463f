"""Unit cube, the paper's first specimen (Fig. 5)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from remodel_fenicsx.body import gmsh_model as model
from remodel_fenicsx.body.shape import (
    Shape,
    axial_dead_force,
    cauchy_columns,
    check_lengths,
    homogeneous_bar,
    uniaxial_columns,
)
from remodel_fenicsx.body.reductions import box
from remodel_fenicsx.schema.settings import Mesh
from remodel_fenicsx.schema.units import LENGTH

if TYPE_CHECKING:
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import Domain
    from remodel_fenicsx.body.loading import Loading


class Box(Shape):
    """A block from the origin along x, y and z, which slides on the planes x = y = z = 0."""

    face_names = ("x0", "x1", "y0", "y1", "z0", "z1")
    _counts: ClassVar[tuple[int, int, int]]
    reductions = {
        "point": homogeneous_bar("z0", "z1", lambda shape: shape.sides, lambda shape: box(*shape._lengths)),
    }

    @property
    @abstractmethod
    def sides(self) -> dict[str, float]:
        """By their keys: along x, y and z, or one for all."""

    @property
    def _lengths(self) -> list[float]:
        """Along x, y and z."""
        return (3 * [*self.sides.values()])[:3]

    @property
    def axial_length(self) -> float:
        """Along z."""
        return self._lengths[2]

    @property
    def section_area(self) -> float:
        """Across z."""
        return self._lengths[0] * self._lengths[1]

    @model_validator(mode="after")
    def _can_be_meshed(self) -> Box:
        check_lengths(self, self.sides)
        return self

    def build(self, mesh: Mesh, comm: MPI.Intracomm | None = None) -> Domain:
        """So many elements along x, y and z, times the refinement; of the paper's cube one."""
        return box_domain(self.name, self.sides, self._lengths, self._counts, mesh, comm)

    def hold(self, loading: Loading) -> None:
        """Symmetry planes x = y = z = 0."""
        for component, face in enumerate(("x0", "y0", "z0")):
            loading.hold_face(face, component)


class Cube(Box):
    """A cube, pulled along z: the homogeneous body of the paper's Fig. 5. It slides on the planes x = y = z = 0.

    Its keyword arguments are the keys of `[geometry]`: `side` in the unit `length_unit`, or in any one unit.

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> body = parts.Cube(side=2.0)
    >>> domain = body.build(parts.Mesh(element="hexahedron", degree=1))
    >>> domain.number_of_elements, sorted(domain.faces)
    (1, ['x0', 'x1', 'y0', 'y1', 'z0', 'z1'])
    >>> body.section_area, list(body.loads)
    (4.0, ['force'])
    """

    loads = {"force": axial_dead_force("z1")}
    columns = uniaxial_columns("z1", "side")
    columns_on_request = cauchy_columns("x", "y", "z")
    number_of_elements = 1
    _counts: ClassVar[tuple[int, int, int]] = (1, 1, 1)

    shape: Literal["cube"] = "cube"
    """Which body it is."""
    side: Annotated[float, LENGTH] = Field(default=1.0, gt=0)
    """Length of an edge, in the scene's unit of length."""

    @property
    def sides(self) -> dict[str, float]:
        """The one."""
        return {"side": self.side}


def box_domain(
    shape: str,
    dimensions: dict[str, float],
    lengths: Sequence[float],
    counts: Sequence[int],
    mesh: Mesh,
    comm: MPI.Intracomm | None = None,
) -> Domain:
    """A block from the origin along x, y and z, with the faces x0, x1, y0, y1, z0 and z1, meshed by Gmsh. Collective.

    Parameters
    ----------
    shape
        Name of the shape that it is a mesh of.
    dimensions
        The shape's dimensions by name, for `Domain`.
    lengths
        Along x, y and z, (3,), in the unit of length.
    counts
        Elements along x, y and z with refinement 1.
    mesh
        Settings of the elements.
    comm
        MPI communicator; default: all ranks.

    Returns
    -------
    Domain
        The mesh with its faces.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> from remodel_fenicsx.extend import box_domain
    >>> sheet = box_domain("sheet", {"width": 2.0}, (2.0, 2.0, 0.5), (4, 4, 1), parts.Mesh(refinement=2))
    >>> sheet.number_of_elements, sheet.dimensions
    (128, {'width': 2.0})
    """
    from remodel_fenicsx.body.domain import build_domain

    x, y, z = (mesh.refinement * count for count in counts)

    def draw() -> None:
        corners = model.points(np.array(lengths[:2]) * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
        y0, x1, y1, x0 = (model.line(corners[i], corners[(i + 1) % 4], n) for i, n in enumerate((x, y, x, y)))
        section = model.block([y0, x1, y1, x0], corners, mesh.element)
        sides = {"x0": x0, "x1": x1, "y0": y0, "y1": y1}
        model.extrude([section], lengths[2], z, mesh.element, sides, ends=("z0", "z1"))
        model.raise_degree(mesh.degree, np.zeros_like)

    return build_domain(draw, shape, dimensions, comm)
