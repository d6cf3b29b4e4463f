"""Imports on first access, without imports of the package."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any

from remodel_fenicsx._renamed import OLD_NAMES, new_name


def on_demand(module: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a module's `__getattr__` (PEP 562) that imports names on first access."""

    def imported(name: str) -> Any:
        if name in OLD_NAMES.get(module, {}):
            name = new_name(module, name)
        if name not in places:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"remodel_fenicsx.{places[name]}"), name)

    return imported


def resolved(maker: Callable[..., Any] | str) -> Callable[..., Any]:
    """Return the class or function of a registry, which may be its dotted name."""
    return _named(maker) if isinstance(maker, str) else maker


@functools.cache  # called in every iteration
def _named(place: str) -> Callable[..., Any]:
    return pkgutil.resolve_name(place)


class Late:
    """Third-party module that is imported on first access to one of its names."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self._name), name)
