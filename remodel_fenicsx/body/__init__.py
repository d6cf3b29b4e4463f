"""Bodies: meshed domains with supports and loads, one file a shape; `SHAPES` names them."""

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
    """Registry of shapes: classes, or their dotted names, which are imported on first access."""

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
"""Shapes by their name in a scene; scripts may add shapes."""

# The child process that reads files needs none of these modules.
MODULES = {
    "Cube": "body.box",
    "LoadKind": "body.shape",
    "Shape": "body.shape",
    "Tendon": "body.tendon",
    "Tube": "body.tube",
}
__getattr__ = on_demand(__name__, MODULES)
