"""Blocks: the cube, the paper's first specimen (Fig. 5), and the sheet of a biaxial test."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from remodel_fenicsx.body import gmsh_model as model
from remodel_fenicsx.body.shape import (
    Column,
    Columns,
    LoadKind,
    WithAxes,
    axial_dead_force,
    cauchy_columns,
    check_lengths,
    mean_component,
    homogeneous_bar,
    tensor_columns,
    uniaxial_columns,
)
from remodel_fenicsx.body.reductions import box
from remodel_fenicsx.model.cells import angle_to_axis
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema.settings import Mesh
from remodel_fenicsx.schema.units import FORCE, LENGTH

if TYPE_CHECKING:
    from mpi4py import MPI

    from remodel_fenicsx.body.domain import Domain
    from remodel_fenicsx.body.loading import Loading


def _nominal_stress(m: Any) -> Array:
    """Return P = J sigma F^-T."""
    inverse = np.linalg.inv(m.F)
    return np.einsum("...,...ij,...kj->...ik", np.linalg.det(m.F), m.stress, inverse)


def material_columns(*names: str) -> Columns:
    """Return columns of Green strain and second Piola-Kirchhoff stress, of one or two axes each."""

    def strain(m: Any) -> Array:
        return (np.swapaxes(m.F, -1, -2) @ m.F - np.eye(3)) / 2

    def stress(m: Any) -> Array:
        return np.linalg.solve(m.F, _nominal_stress(m))

    words = "second Piola-Kirchhoff stress S = F^-1 P"
    return (
        *tensor_columns("green_strain", "", "Green strain E = (F^T F - 1) / 2", strain, names),
        *tensor_columns("second_piola_kirchhoff_stress", "stress", words, stress, names),
    )


class Box(WithAxes):
    """Block from the origin along x, y and z, with symmetry planes x = y = z = 0."""

    face_names = ("x0", "x1", "y0", "y1", "z0", "z1")
    _counts: ClassVar[tuple[int, int, int]]
    reductions = {
        "point": homogeneous_bar(
            "z0", "z1", lambda shape: shape.sides, lambda shape: box(*shape._lengths)
        ),
    }

    @property
    @abstractmethod
    def sides(self) -> dict[str, float]:
        """Side lengths by their keys: along x, y and z, or one for all."""

    @property
    def _lengths(self) -> list[float]:
        """Side lengths along x, y and z."""
        return (3 * [*self.sides.values()])[:3]

    @property
    def axial_length(self) -> float:
        """Length of the block along z."""
        return self._lengths[2]

    @property
    def section_area(self) -> float:
        """Area of the section across z."""
        return self._lengths[0] * self._lengths[1]

    @model_validator(mode="after")
    def _can_be_meshed(self) -> Box:
        check_lengths(self, self.sides)
        return self

    def build(self, mesh: Mesh, comm: MPI.Intracomm | None = None) -> Domain:
        """Mesh the block; `_counts` are the elements along x, y and z with refinement 1."""
        return box_domain(self.name, self.sides, self._lengths, self._counts, mesh, comm)

    def hold(self, loading: Loading) -> None:
        """Constrain the symmetry planes x = y = z = 0."""
        for component, face in enumerate(("x0", "y0", "z0")):
            loading.hold_face(face, component)


class Cube(Box):
    """Cube under tension along z, the homogeneous body of the paper's Fig. 5.

    Its faces x = 0, y = 0 and z = 0 slide in their planes.

    Its keyword arguments are the keys of `[geometry]`: `side` in the unit `length_unit`,
    or in any one unit.

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
    columns_on_request = cauchy_columns("x", "y", "z") + material_columns("x", "y", "z")
    number_of_elements = 1
    _counts: ClassVar[tuple[int, int, int]] = (1, 1, 1)

    shape: Literal["cube"] = "cube"
    """Shape of the body."""
    side: Annotated[float, LENGTH] = Field(default=1.0, gt=0)
    """Length of an edge, in the scene's unit of length."""

    @property
    def sides(self) -> dict[str, float]:
        """Length of an edge by its key."""
        return {"side": self.side}


SIDES = "xy"


def _force(side: int) -> LoadKind:
    axis, other = SIDES[side], SIDES[1 - side]
    nominal = mean_component(_nominal_stress, axis)

    def area(shape: Any) -> float:
        return float(getattr(shape, f"length_{other}") * shape.thickness)

    return LoadKind(
        lambda shape, loading, name: loading.add_dead_force(
            name, f"{axis}1", side, getattr(shape, f"length_{axis}")
        ),
        f"force along {axis} on the edge {axis} = length_{axis}: dead load, or the reaction",
        FORCE,
        value=lambda m: nominal(m) * area(m.observer.shape),
        reductions=("point",),
        area=area,
        replaces=f"elongation_{axis}",
    )


def _elongation(side: int) -> LoadKind:
    axis, stretch = SIDES[side], mean_component(attrgetter("F"), SIDES[side])
    return LoadKind(
        lambda shape, loading, name: loading.add_prescribed_elongation(
            name, f"{axis}1", side, getattr(shape, f"length_{axis}")
        ),
        f"engineering strain along {axis}: prescribed, or the result",
        value=lambda m: stretch(m) - 1.0,
        above=-1.0,
        reductions=("point",),
        replaces=f"force_{axis}",
    )


class Sheet(Box):
    """Sheet in the plane of x and y, as in biaxial tests.

    Its faces x = 0, y = 0 and z = 0 slide in their planes. Along x and y a force or an elongation
    may be prescribed; without either the edge is free. Lengths: 1e-6 to 1e6, one up to 10,000 times
    the other.

    Its keyword arguments are the keys of `[geometry]`: lengths in the unit `length_unit`,
    or in any one unit.

    Raises
    ------
    SceneError
        If a value is not allowed: one line.

    Examples
    --------
    >>> from remodel_fenicsx import parts
    >>> body = parts.Sheet(length_x=20.0, length_y=10.0, thickness=0.5)
    >>> list(body.loads)
    ['force_x', 'force_y', 'elongation_x', 'elongation_y', 'shear']
    >>> body.loads["force_x"].area(body), body.build(parts.Mesh()).number_of_elements
    (5.0, 16)
    """

    loads = {
        **{f"force_{axis}": _force(side) for side, axis in enumerate(SIDES)},
        **{f"elongation_{axis}": _elongation(side) for side, axis in enumerate(SIDES)},
        "shear": LoadKind(
            lambda shape, loading, name: loading.add_prescribed_shear(name),
            "shear F_xy of the sheet: displacement along x over y; F_yx is 0",
            reductions=("point",),
            of_one_strain=True,
        ),
    }
    columns = (
        Column(
            "fibre_angle",
            "degrees",
            "angle between chains and x in the reference configuration, volume mean",
            lambda m: m.quadrature.nanmean(m.fibre_angle),
            by_case=False,
        ),
        Column(
            "thickness_stretch",
            "",
            "stretch F_zz through the sheet, volume mean",
            mean_component(attrgetter("F"), "z"),
        ),
        *cauchy_columns("x", "y", "xy"),
        *tensor_columns(
            "nominal_stress",
            "stress",
            "first Piola-Kirchhoff stress, along the first axis on edges across the last,",
            _nominal_stress,
            ("x", "y", "xy", "yx"),
        ),
    )
    columns_on_request = material_columns("x", "y", "xy")
    number_of_elements = 16
    _counts: ClassVar[tuple[int, int, int]] = (4, 4, 1)
    depth_labels = ("through the sheet", "lower face", "upper face")
    angle_in_words = ("along x", "across x")
    directions = np.eye(3)
    buckles = False  # the face z = 0 stays in its plane

    shape: Literal["sheet"] = "sheet"
    """Shape of the body."""
    length_x: Annotated[float, LENGTH] = Field(default=10.0, gt=0)
    """Side along x."""
    length_y: Annotated[float, LENGTH] = Field(default=10.0, gt=0)
    """Side along y."""
    thickness: Annotated[float, LENGTH] = Field(default=1.0, gt=0)
    """Side along z."""

    @property
    def sides(self) -> dict[str, float]:
        """Side lengths along x, y and z, by their keys."""
        return {"length_x": self.length_x, "length_y": self.length_y, "thickness": self.thickness}

    def fibre_angle(self, dimensions: Any, axes: Any, local: Any) -> Any:
        """Return the angle of the chains to x."""
        return angle_to_axis(dimensions, axes, np.array([1.0, 0.0, 0.0]))


def box_domain(
    shape: str,
    dimensions: dict[str, float],
    lengths: Sequence[float],
    counts: Sequence[int],
    mesh: Mesh,
    comm: MPI.Intracomm | None = None,
) -> Domain:
    """Mesh a block from the origin along x, y and z by Gmsh. Collective.

    The block has the faces x0, x1, y0, y1, z0 and z1.

    Parameters
    ----------
    shape
        Name of the meshed shape.
    dimensions
        The shape's dimensions by name, for `Domain`.
    lengths
        Side lengths along x, y and z, (3,), in the unit of length.
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
    >>> mesh = parts.Mesh(refinement=2)
    >>> sheet = box_domain("sheet", {"width": 2.0}, (2.0, 2.0, 0.5), (4, 4, 1), mesh)
    >>> sheet.number_of_elements, sheet.dimensions
    (128, {'width': 2.0})
    """
    from remodel_fenicsx.body.domain import build_domain

    x, y, z = (mesh.refinement * count for count in counts)

    def draw() -> None:
        corners = model.points(
            np.array(lengths[:2]) * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        )
        y0, x1, y1, x0 = (
            model.line(corners[i], corners[(i + 1) % 4], n) for i, n in enumerate((x, y, x, y))
        )
        section = model.block([y0, x1, y1, x0], corners, mesh.element)
        sides = {"x0": x0, "x1": x1, "y0": y0, "y1": y1}
        model.extrude([section], lengths[2], z, mesh.element, sides, ends=("z0", "z1"))
        model.raise_degree(mesh.degree, np.zeros_like)

    return build_domain(draw, shape, dimensions, comm)
