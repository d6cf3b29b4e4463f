"""Columns of a history, numbers and units as people read them."""

from __future__ import annotations

from typing import Any

WORDS = {"max_chain_extension": "largest r/L", "min_jacobian": "smallest J", "seconds": "seconds a step"}


def words(name: str) -> str:
    """A column's name."""
    return WORDS.get(name) or name.replace("_", " ")


def number(value: float) -> str:
    """Three digits."""
    return f"{value:.3g}" if abs(value) < 1e5 and (abs(value) >= 1e-3 or value == 0) else f"{value:.2e}"


def with_unit(value: float, unit: str) -> str:
    """A number and its unit."""
    return number(value) + (unit if unit == "°" else f" {unit}" if unit else "")


def unit_of(scene: Any, dimension: str) -> str:
    """The unit of a `Column` by what it measures, where the scene says what it is, else nothing."""
    names = {"stress": scene.material.stress_unit, "length": scene.geometry.length_unit, "degrees": "°", "s": "s"}
    return names.get(dimension) or ""
