"""Columns of a history, numbers and units as people read them."""

from __future__ import annotations

import re
from typing import Any

WORDS = {"max_chain_extension": "largest r/L", "min_jacobian": "smallest J", "seconds": "seconds a step"}


def words(name: str) -> str:
    """A column's name."""
    known = next((known for known in WORDS if f"{name}_".startswith(f"{known}_")), "")
    return WORDS.get(known, "") + name.removeprefix(known).replace("_", " ")


def number(value: float) -> str:
    """Three digits, all of them: 3.40 beside 2.45."""
    if value == 0:
        return "0"
    return f"{value:#.3g}".rstrip(".") if 1e-3 <= abs(value) < 1e5 else f"{value:.2e}"


def with_unit(value: float, unit: str) -> str:
    """A number and its unit."""
    return number(value) + (unit if unit == "°" else f" {unit}" if unit else "")


def unit_of(scene: Any, dimension: str) -> str:
    """The unit of a `Column` by what it measures, where the scene says what it is, else nothing."""
    names = {"stress": scene.material.stress_unit, "length": scene.geometry.length_unit, "degrees": "°"}
    parts = re.split(r"(\w+)", dimension.replace("force", "stress length^2"))
    if not all(names.get(part, part) for part in parts if part):
        return ""
    return "".join(names.get(part) or part for part in parts).replace("^2", "²").replace("^3", "³")
