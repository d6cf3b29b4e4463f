"""UFL's side of a mesh."""

from __future__ import annotations

from typing import Any

import ufl


class SymbolicMesh(ufl.Mesh):
    """A `ufl.Mesh` that makes its cell once.

    UFL asks for the cell thousands of times while it handles a form. What it asks, basix answers with a new cell each
    time, and a hexahedron makes its faces and edges anew: a third of what a cached kernel costs.
    """

    def __init__(self, coordinate_element: Any) -> None:
        super().__init__(coordinate_element)
        self._cell = super().ufl_cell()

    def ufl_cell(self) -> Any:
        """The same cell each time."""
        return self._cell
