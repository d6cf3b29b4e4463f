"""Bodies: meshed domains with supports and loads. Each file is one whole shape; `SHAPES` names them for scenes."""

from __future__ import annotations

from remodel_fenicsx.body.cube import Cube
from remodel_fenicsx.body.gmsh_model import GeometryError
from remodel_fenicsx.body.mesh_body import MeshBody
from remodel_fenicsx.body.shape import LoadKind, Shape
from remodel_fenicsx.body.sheet import Sheet
from remodel_fenicsx.body.solid import Solid
from remodel_fenicsx.body.tendon import Tendon
from remodel_fenicsx.body.tube import Tube

__all__ = [
    "SHAPES",
    "Cube",
    "GeometryError",
    "LoadKind",
    "MeshBody",
    "Shape",
    "Sheet",
    "Solid",
    "Tendon",
    "Tube",
]

SHAPES: dict[str, type[Shape]] = {
    "cube": Cube,
    "tendon": Tendon,
    "tube": Tube,
    "sheet": Sheet,
    "mesh": MeshBody,
    "solid": Solid,
}
"""The shapes that a scene may name; a script adds its own."""
