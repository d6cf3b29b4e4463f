"""Deprecated names of modules, classes and arguments, which work for one release with a warning."""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import TypeVar, cast

Wrapped = TypeVar("Wrapped", bound=Callable[..., object])
Kind = TypeVar("Kind", bound=type)

OLD_NAMES: Mapping[str, Mapping[str, str]] = {
    "remodel_fenicsx.extend": {"EveryTangent": "FullNewton"},
    "CouplingKind": {"makes_a_share": "relaxes"},
    "End": {"frees_length": "makes_length_unknown"},
    "Formulation": {
        "on": "discretise",
        "has": "applies_to",
        "pays_above": "auto_threshold",
        "takes_parts": "splits_energy",
    },
    "FullNewton": {
        "second_try": "fallback",
        "keep_nothing": "disable_reuse",
        "more_iterations": "iteration_factor",
        "keeps": "reuses_factorisation",
    },
    "Kinematics": {"on": "for_mesh", "moves_rigidly": "has_rigid_modes", "closing": "closed_ring"},
    "Law": {
        "share": "relax",
        "of_absolute_time": "depends_on_absolute_time",
        "asks_kappa": "stops_at_zero_kappa",
        "takes_set_points": "uses_exponent_and_threshold",
    },
    "LoadKind": {"instead_of": "replaces", "frees_length": "makes_length_unknown"},
    "Loading": {"measure_alone": "separate_measure"},
    "Material": {"tells_volume_apart": "has_volumetric_split"},
    "Matrix": {"of": "with_parameters"},
    "Measurement": {"tool": "cached", "tool_of_step": "cached_for_step"},
    "NaturalConfiguration": {"closing": "closed_ring"},
    "Parameter": {"above": "exclusive_minimum"},
    "Quadrature": {
        "beyond": "polynomial_residual",
        "mean_of_known": "nanmean",
        "element_mean_of_known": "element_nanmean",
        "place_of_largest": "argmax_position",
    },
    "Remodeling": {"has_set_point": "changes_exponent_or_threshold"},
    "Scene": {
        "turned_away": "loaded_shape_warnings",
        "needs_all_points": "displacement_reason",
        "jumps_by_rank": "cell_order_can_change",
        "formulation_in_words": "describe_formulation",
    },
    "Shape": {"depth_in_words": "depth_labels", "fills": "covers_body"},
    "Staggered": {"balanced": "solve_equilibrium", "better": "higher_order_cells"},
    "State": {
        "settle_cells": "mark_cells_in_equilibrium",
        "reach": "complete_step",
        "others": "other_cases",
    },
    "Step": {"moment": "label", "extension": "limits"},
    "Tissue": {"relative": "normalised_length", "present_modulus": "current_modulus"},
    "Traits": {"longest": "max_scaled_step"},
    "CellField": {"ufl_cell": "symbolic_cell"},
    "WatcherKind": {"each_case": "checks_each_case"},
    "WarnsOnce": {"of": "for_scene", "look": "check", "find": "emit", "said": "is_reported"},
    "WithParameters": {"of": "with_parameters"},
    "hold_facets": {"way": "direction"},
    "ranked": {"of_absolute_time": "depends_on_absolute_time"},
}
"""Old names with their new names, by module, class or function."""


def new_name(owner: str, old: str) -> str:
    """Warn that a name is deprecated, and return the new name."""
    new = OLD_NAMES[owner][old]
    warnings.warn(f"{owner}: {old} is now {new}", DeprecationWarning, stacklevel=3)
    return new


def with_old_arguments(owner: str, function: Wrapped) -> Wrapped:
    """Return a function that accepts the old names of its keyword arguments."""

    @functools.wraps(function)
    def translated(*positional: object, **keywords: object) -> object:
        known = {
            new_name(owner, key) if key in OLD_NAMES[owner] else key: keywords[key]
            for key in keywords
        }
        return function(*positional, **known)

    return cast(Wrapped, translated)


class OldAttribute:
    """Descriptor that gives access to an attribute or method under its old name."""

    def __init__(self, owner: str, old: str):
        self.owner, self.old = owner, old

    def __get__(self, instance: object, kind: type) -> object:
        return getattr(kind if instance is None else instance, new_name(self.owner, self.old))


def with_old_names(kind: Kind, arguments: bool = True) -> Kind:
    """Make a class accept its old names: attributes, overridden methods, and arguments."""
    owner, inherit = kind.__name__, kind.__init_subclass__

    def overridden(subclass: type, **keywords: object) -> None:
        inherit(**keywords)
        for old in OLD_NAMES[owner].keys() & vars(subclass).keys():
            setattr(subclass, new_name(owner, old), vars(subclass)[old])

    for old in OLD_NAMES[owner]:
        setattr(kind, old, OldAttribute(owner, old))
    setattr(kind, "__init_subclass__", classmethod(overridden))
    if arguments and {*OLD_NAMES[owner].values()} & {*inspect.signature(kind).parameters}:
        maker = "__new__" if issubclass(kind, tuple) else "__init__"
        setattr(kind, maker, with_old_arguments(owner, getattr(kind, maker)))
    return kind
