"""What libraries do again for every kernel is done once, and comes out the same."""

from __future__ import annotations

import importlib.metadata

import basix.ufl
import pytest
import ufl

from remodel_fenicsx.fem.done_once import packages_read_once, share_cells

share_cells()


@pytest.mark.parametrize("kind", ["interval", "triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_elements_of_a_kind_have_one_cell(kind: str) -> None:
    scalar, vector = basix.ufl.element("P", kind, 1), basix.ufl.element("P", kind, 2, shape=(3,))
    points = basix.ufl.quadrature_element(kind, (), degree=2)
    assert scalar.cell is vector.cell is points.cell
    assert scalar.cell == ufl.Cell(kind)
    assert [scalar.cell.num_sub_entities(dimension) for dimension in range(4)] == [
        ufl.Cell(kind).num_sub_entities(dimension) for dimension in range(4)
    ]


def test_entry_points_are_read_once_and_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    group = "distutils.commands"  # what setuptools asks for when it compiles
    as_ever = importlib.metadata.entry_points(group=group)
    with packages_read_once():
        assert importlib.metadata.entry_points(group=group) == as_ever
        monkeypatch.setattr(importlib.metadata, "distributions", lambda: pytest.fail("the packages are read again"))
        assert importlib.metadata.entry_points(group=group) == as_ever
        assert not importlib.metadata.entry_points(group="none.such")
    monkeypatch.undo()
    assert importlib.metadata.entry_points(group=group) == as_ever
    assert importlib.metadata.entry_points.__module__ == "importlib.metadata"


def test_no_group_is_every_group() -> None:
    with packages_read_once():
        groups = importlib.metadata.entry_points().groups
    assert groups == importlib.metadata.entry_points().groups
