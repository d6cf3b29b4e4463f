"""Names that are imported when they are first asked for: a leaf."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any


def on_demand(module: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a module (PEP 562)."""

    def imported(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"remodel_fenicsx.{places[name]}"), name)

    return imported


def resolved(maker: Callable[..., Any] | str) -> Callable[..., Any]:
    """A class or function that a registry names: itself, or what its dotted name stands for."""
    return _named(maker) if isinstance(maker, str) else maker


@functools.cache  # points ask for it at every iteration
def _named(place: str) -> Callable[..., Any]:
    found: Callable[..., Any] = pkgutil.resolve_name(place)
    return found


class Late:
    """A module of others that is imported when something of it is asked for."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self._name), name)
