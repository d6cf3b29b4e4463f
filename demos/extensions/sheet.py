"""A planar sheet as a shape: its edges x = length_x and y = length_y are pulled by forces (sheet.toml)."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from remodel_fenicsx.extend import FORCE, LENGTH, SHAPES, Column, LoadKind, Shape, angle_to_axis, box_domain


def force(face, component, width):
    """A dead force on an edge, which is as wide as the side of this name."""
    return LoadKind(
        lambda shape, loading, name: loading.add_dead_force(name, face, component),
        f"force on the edge {face}; its direction stays",
        FORCE,
        area=lambda shape: getattr(shape, width) * shape.thickness,
    )


def elongation(axis, component):
    """The mean strain along a side."""

    def value(m):
        return m.face_mean(f"{axis}1", m.displacement[:, component]) / m.domain.dimensions[f"length_{axis}"]

    return Column(f"elongation_{axis}", "", f"mean engineering strain along {axis}", value)


class Sheet(Shape):
    """A quarter of a sheet: the planes x = 0 and y = 0 are planes of symmetry, and z = 0 one of its faces."""

    loads: ClassVar[Any] = {"force_x": force("x1", 0, "length_y"), "force_y": force("y1", 1, "length_x")}
    columns: ClassVar[Any] = (
        elongation("x", 0),
        elongation("y", 1),
        Column("cauchy_stress_x", "stress", "mean Cauchy stress", lambda m: m.quadrature.mean(m.stress[..., 0, 0])),
        Column("cauchy_stress_y", "stress", "mean Cauchy stress", lambda m: m.quadrature.mean(m.stress[..., 1, 1])),
        Column("fibre_angle", "degrees", "mean angle to x", lambda m: m.quadrature.mean_of_known(m.fibre_angle)),
    )
    number_of_elements: ClassVar[int] = 16

    shape: Literal["sheet"] = Field(default="sheet", description="Which body it is.")
    length_x: Annotated[float, LENGTH] = Field(default=10.0, gt=0, description="Side along x.")
    length_y: Annotated[float, LENGTH] = Field(default=10.0, gt=0, description="Side along y.")
    thickness: Annotated[float, LENGTH] = Field(default=1.0, gt=0, description="Side along z.")

    def build(self, mesh, comm=None):
        sides = {"length_x": self.length_x, "length_y": self.length_y, "thickness": self.thickness}
        return box_domain("sheet", sides, [*sides.values()], (4, 4, 1), mesh, comm)

    def hold(self, loading):
        for component, face in enumerate(("x0", "y0", "z0")):
            loading.hold_face(face, component)

    def fibre_angle(self, dimensions, axes, local):
        return angle_to_axis(dimensions, axes, [1.0, 0.0, 0.0])


SHAPES["sheet"] = Sheet
