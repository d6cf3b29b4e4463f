"""Bodies: meshed domains with supports and loads. Each file is one whole shape; `SHAPES` names them for scenes."""

from __future__ import annotations

from collections import UserDict
from typing import TYPE_CHECKING, Any

from remodel_fenicsx._lazy import on_demand, resolved

if TYPE_CHECKING:
    from remodel_fenicsx.body.box import Cube
    from remodel_fenicsx.body.shape import LoadKind, Shape
    from remodel_fenicsx.body.tendon import Tendon
    from remodel_fenicsx.body.tube import Tube

__all__ = ["SHAPES", "Cube", "LoadKind", "Shape", "Tendon", "Tube"]


class _Shapes(UserDict[str, Any]):
    """By name, classes or their dotted names: one that no scene asks for is not imported."""

    def __getitem__(self, name: str) -> Any:
        return resolved(super().__getitem__(name))


SHAPES = _Shapes(
    {
        "cube": "remodel_fenicsx.body.box:Cube",
        "tendon": "remodel_fenicsx.body.tendon:Tendon",
        "tube": "remodel_fenicsx.body.tube:Tube",
        "sheet": "remodel_fenicsx.body.box:Sheet",
        "mesh": "remodel_fenicsx.body.mesh_body:MeshBody",
        "solid": "remodel_fenicsx.body.mesh_body:Solid",
    }
)
"""The shapes that a scene may name; a script adds its own."""

# a reader of files, in a process of its own, needs none of them
MODULES = {
    "Cube": "body.box",
    "LoadKind": "body.shape",
    "Shape": "body.shape",
    "Tendon": "body.tendon",
    "Tube": "body.tube",
}
__getattr__ = on_demand(__name__, MODULES)
