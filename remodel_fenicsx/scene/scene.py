"""A scene: what to simulate, as TOML or as Python objects, validated before any solve.

`read_scene` reads a file, `Scene(...)` and `scene_from_dict` take the same keys from Python. docs/scene.md lists all
keys (`scene_reference`).
"""

from __future__ import annotations

import bisect
import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, Field, model_validator

from remodel_fenicsx.scene.parameters import (
    FORMAT,
    LOAD_DIMENSIONS,
    PRESETS,
    RENAMED,
    Cells,
    Material,
    Remodeling,
    length_fault,
)
from remodel_fenicsx.schema.tables import SceneError, Table, checked, fault, is_number, one_of, quoted, shown
from remodel_fenicsx.schema.toml import merged, parse_override, put, read_toml, toml_text
from remodel_fenicsx.schema.units import AREA, FORCE, LENGTH, STRESS, LengthUnit
from remodel_fenicsx.scene.values import base_material, in_own_units, in_present_format, known_shape

MOST_STEPS = 1_000_000
SAME_TIME = 1e-9  # relative: times closer than this are the same

# Defaults that a shape changes, under the keys of preset and scene: with global axes a tube of isotropic cells would
# not stay round in the first step.
SHAPE_DEFAULTS: dict[str, dict[str, Any]] = {"tube": {"cells": {"axes": "cylindrical"}}}


# ---------------------------------------------------------------- geometry


LARGEST_MESH = 10_000_000  # hexahedra; Gmsh, which is serial, needs about 10 GB for them


def _check_lengths(body: Table, lengths: dict[str, float]) -> None:
    """Raise the fault of `length_fault` at its key."""
    found = length_fault(lengths)
    if found is not None:
        raise fault(found[1], found[0], getattr(body, found[0]))


class Cube(Table):
    """A cube, pulled along z: the homogeneous body of the paper's Fig. 5."""

    load_names: ClassVar[tuple[str, ...]] = ("force",)
    axis_kinds: ClassVar[tuple[str, ...]] = ("global",)
    number_of_elements: ClassVar[int] = 1

    shape: Literal["cube"] = Field(default="cube", description="Which body it is.")
    side: Annotated[float, LENGTH] = Field(
        default=1.0, gt=0, description="Length of an edge, in the scene's unit of length."
    )
    length_unit: LengthUnit = None

    @property
    def loaded_area(self) -> float:
        """Area that carries `force`."""
        return self.side**2

    @model_validator(mode="after")
    def _can_be_meshed(self) -> Cube:
        _check_lengths(self, {"side": self.side})
        return self


class Tendon(Table):
    """A cylinder along z, held at its bottom and pulled at its top: the tendon of the paper's Fig. 6.

    Length and square root of the area: 1e-6 to 1e6, one up to 10,000 times the other.
    """

    load_names: ClassVar[tuple[str, ...]] = ("force",)
    axis_kinds: ClassVar[tuple[str, ...]] = ("global", "cylindrical")
    number_of_elements: ClassVar[int] = 480

    shape: Literal["tendon"] = Field(default="tendon", description="Which body it is.")
    length: Annotated[float, LENGTH] = Field(
        default=10.0, gt=0, description="Length along z, in the scene's unit of length."
    )
    area: Annotated[float, AREA] = Field(
        default=10.0, gt=0, description="Area of the cross-section, in the unit of length squared."
    )
    length_unit: LengthUnit = None

    @property
    def loaded_area(self) -> float:
        """Area that carries `force`."""
        return self.area

    @model_validator(mode="after")
    def _can_be_meshed(self) -> Tendon:
        _check_lengths(self, {"length": self.length, "area": math.sqrt(self.area)})
        return self


class Tube(Table):
    """A thick-walled tube about z under inner pressure and axial stretch: the artery of the paper's Fig. 7.

    Inner radius, wall thickness and length: 1e-6 to 1e6, one up to 10,000 times the other.
    """

    load_names: ClassVar[tuple[str, ...]] = ("pressure", "stretch")
    axis_kinds: ClassVar[tuple[str, ...]] = ("global", "cylindrical")
    number_of_elements: ClassVar[int] = 1536

    shape: Literal["tube"] = Field(default="tube", description="Which body it is.")
    inner_radius: Annotated[float, LENGTH] = Field(gt=0, description="Inner radius R_i, in the scene's unit of length.")
    outer_radius: Annotated[float, LENGTH] = Field(gt=0, description="Outer radius R_o, in the scene's unit of length.")
    length: Annotated[float, LENGTH] = Field(gt=0, description="Length along z, in the scene's unit of length.")
    length_unit: LengthUnit = None

    @model_validator(mode="after")
    def _has_a_wall(self) -> Tube:
        if self.inner_radius >= self.outer_radius:
            limit = f"must be smaller than geometry.outer_radius = {shown(self.outer_radius)}"
            raise fault(limit, "inner_radius", self.inner_radius)
        wall = self.outer_radius - self.inner_radius
        _check_lengths(self, {"inner_radius": self.inner_radius, "outer_radius": wall, "length": self.length})
        return self


Geometry = Annotated[Cube | Tendon | Tube, Field(discriminator="shape")]


class Mesh(Table):
    """The finite elements."""

    refinement: int = Field(
        default=1,
        ge=1,
        description="Factor on the paper's number of elements in every direction (1: its own meshes). More than 10 "
        "million hexahedra, or those split into tetrahedra, are refused.",
    )
    cell: Literal["hexahedron", "tetrahedron"] = Field(default="hexahedron", description="Shape of the elements.")
    degree: Annotated[int, one_of((1, 2))] = Field(
        default=1, description="Polynomial degree of the displacement: 1 (the paper's) or 2."
    )


class Model(Table):
    """Which unknowns describe the deformation."""

    kinematics: Literal["full"] = Field(default="full", description="'full': the displacement in three dimensions.")


# ---------------------------------------------------------------- loads and time


def _ramp(value: Any) -> tuple[tuple[float, float], ...]:
    """Pairs (time, factor) whose times increase; anything else is a fault that names the entry."""
    if not isinstance(value, (list, tuple)) or not value:
        raise fault("must be a list of pairs [time, factor], at least one")
    for index, entry in enumerate(value):
        if not isinstance(entry, (list, tuple)) or len(entry) != 2 or not all(map(is_number, entry)):
            raise fault("must be a pair [time, factor] of finite numbers", f"[{index}]", entry)
    for index, (time, _) in enumerate(value):
        if time < 0:
            raise fault("must be at least 0, where the simulation starts", f"[{index}][0]", time)
        if index and time <= value[index - 1][0]:
            rule = f"must be later than the time {shown(value[index - 1][0])} of the entry before"
            raise fault(rule, f"[{index}][0]", time)
    return tuple((float(time), float(factor)) for time, factor in value)


class Load(Table):
    """A load by name: `force` of cube and tendon, `pressure` and `stretch` of a tube. One that is not listed is zero.

    `force` is the total dead force along z on the top; `pressure` acts on the deformed inner face; `stretch` is the
    prescribed axial elongation over the length (0.1: 10 %).
    """

    value: float = Field(
        description="Full value at factor 1: force in stress_unit times length squared, pressure in stress_unit, "
        "stretch without unit (above -1)."
    )
    ramp: Annotated[tuple[tuple[float, float], ...], checked(_ramp)] = Field(
        description="Factor on the value over time, as [time, factor] pairs with increasing times: linear in between, "
        "held before the first and after the last pair. Times up to time.end must be multiples of time.step.",
        json_schema_extra={"allowed": "a list of pairs [time, factor] with increasing times"},
    )

    def factor(self, time: float) -> float:
        """Factor on the value at a time: piecewise linear, held before the first and after the last pair."""
        for ramp_time, factor in self.ramp:  # exact at its own times
            if abs(time - ramp_time) <= SAME_TIME * abs(ramp_time):
                return factor
        after = bisect.bisect_right(self.ramp, time, key=lambda pair: pair[0])
        if after == 0:
            return self.ramp[0][1]
        if after == len(self.ramp):
            return self.ramp[-1][1]
        (time0, factor0), (time1, factor1) = self.ramp[after - 1], self.ramp[after]
        return factor0 + (factor1 - factor0) * (time - time0) / (time1 - time0)

    def largest(self, end: float) -> float:
        """The value of largest magnitude from time 0 to `end`, with its sign."""
        times = [end, *(time for time, _ in self.ramp if time < end)]
        return max((self.value * self.factor(time) for time in times), key=abs)


class Time(Table):
    """Simulated time, in the unit of 1/kappa. It starts at 0 with the unloaded body."""

    end: float = Field(gt=0, description="Last time; a whole number of steps.")
    step: float = Field(default=1.0, gt=0, description="Time between two remodeling passes.")

    @model_validator(mode="after")
    def _whole_number_of_steps(self) -> Time:
        if self.step > self.end:
            raise fault(f"must be at most time.end = {shown(self.end)}", "step", self.step)
        if self.end / self.step > MOST_STEPS:
            rule = f"must be at least time.end / {MOST_STEPS} = {self.end / MOST_STEPS:.6g}"
            raise fault(rule, "step", self.step)
        if not _is_multiple(self.end, self.step):
            raise fault(_nearest_multiples(self.end, self.step, "time.step"), "end", self.end)
        return self

    @property
    def number_of_steps(self) -> int:
        """Number of steps from 0 to the end."""
        return round(self.end / self.step)


def _is_multiple(time: float, step: float) -> bool:
    return abs(time / step - round(time / step)) <= SAME_TIME * max(1.0, time / step)


def _nearest_multiples(time: float, step: float, name: str) -> str:
    below = math.floor(time / step)
    nearest = f"{below * step:.12g} and {(below + 1) * step:.12g}"
    return f"must be a multiple of {name} = {shown(step)}; the nearest are {nearest}"


# ---------------------------------------------------------------- solver and output


def _petsc_options(value: Any) -> Any:
    if isinstance(value, Mapping):
        for name, entry in value.items():
            if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name):
                raise fault("not a PETSc option; write its name without the leading '-'", quoted(str(name)), entry)
            if name in ("snes_rtol", "snes_atol", "snes_stol"):
                raise fault("has no effect; use solver.relative_tolerance, solver.absolute_tolerance", name, entry)
            if not isinstance(entry, (str, bool)) and not is_number(entry):
                raise fault("must be a string, a finite number, true or false", name, entry)
    return value


class Solver(Table):
    """Solution of the nonlinear problem of each step."""

    profile: Literal["direct"] = Field(
        default="direct", description="'direct': Newton's method, each system factorised."
    )
    absolute_tolerance: Annotated[float, FORCE] = Field(
        default=0.0,
        ge=0,
        description="A step is solved when |R| <= absolute_tolerance + relative_tolerance |nodal forces|, R the "
        "vector of out-of-balance nodal forces; in the unit of force, so that it depends on the units of the scene.",
    )
    relative_tolerance: float = Field(
        default=1e-10,
        ge=0,
        lt=1,
        description="See absolute_tolerance; relative to the norm of the internal nodal forces, which stays when the "
        "load is held.",
    )
    maximum_iterations: int = Field(default=25, ge=1, description="Newton iterations before a step counts as failed.")
    maximum_halvings: int = Field(
        default=12, ge=0, description="How often a failed step is halved before the run ends with an error."
    )
    petsc_options: Annotated[dict[str, Any], checked(_petsc_options)] = Field(
        default_factory=dict,
        description="PETSc options that override the profile's, without the leading '-': snes_..., ksp_..., pc_....",
    )

    @model_validator(mode="after")
    def _has_a_tolerance(self) -> Solver:
        if self.absolute_tolerance == 0.0 and self.relative_tolerance == 0.0:
            raise fault("must be greater than 0 where absolute_tolerance is 0", "relative_tolerance", 0.0)
        return self


class Output(Table):
    """What a run writes beside its history table."""

    fields: bool = Field(default=True, description="Whether to write fields for ParaView.")
    every: int = Field(default=1, ge=1, description="Write the fields of every n-th step; the last one always.")


# ---------------------------------------------------------------- the scene


def _name(value: Any) -> Any:
    if not isinstance(value, str) or not re.fullmatch(r"\w(?:[\w .+-]{0,98}[\w+-])?", value):
        raise fault("must be a file name: letters, digits, spaces and . + - _, at most 100, a letter or digit first")
    return value


class Scene(Table):
    """A whole scene: all keys above the first table, and the tables."""

    renamed: ClassVar[Mapping[str, str]] = RENAMED

    format: int = Field(
        default=FORMAT,
        ge=1,
        le=FORMAT,
        description="Number of the form in which a scene is written; a scene as run has it. Version 0.1.0 wrote none.",
    )
    name: Annotated[str, checked(_name)] = Field(
        default="scene",
        description="Name of the scene and of its results folder. Default: the file's name without its ending.",
        json_schema_extra={"allowed": "a file name without a path"},
    )
    preset: str | None = Field(
        default=None,
        description="Named parameters that lie under the scene's own keys, table by table (see Presets below).",
        json_schema_extra={"allowed": "one of " + ", ".join(map(repr, PRESETS))},
    )
    geometry: Geometry
    mesh: Mesh = Mesh()
    model: Model = Model()
    material: Material = Material()
    cells: Cells = Cells()
    loads: dict[str, Load] = {}
    remodeling: Remodeling = Remodeling()
    time: Time
    solver: Solver = Solver()
    output: Output = Output()

    @model_validator(mode="before")
    @classmethod
    def _merge_preset(cls, values: Any) -> Any:
        """The scene's keys over those of its preset over those of its shape; numbers in place of values with units."""
        if not isinstance(values, dict):
            return values
        plain = in_present_format(_plain(values))
        preset = plain.get("preset")
        if preset is not None and (not isinstance(preset, str) or preset not in PRESETS):
            raise fault("allowed are " + ", ".join(map(repr, PRESETS)), "preset", preset)
        shape = known_shape(plain.get("geometry", {}), _SHAPES)
        _check_load_names(shape, plain.get("loads"))
        base = SHAPE_DEFAULTS.get(shape, {})
        if preset is not None:
            if shape not in PRESETS[preset]:
                known = ", ".join(map(repr, PRESETS[preset]))
                raise fault(f"the preset {preset!r} has {known}", "geometry.shape", shape)
            base = merged(base, PRESETS[preset][shape])
        return in_own_units(merged(base, plain), cls, _SHAPES[shape], Load)

    @model_validator(mode="after")
    def _tables_fit_together(self) -> Scene:
        cells, material, geometry = self.cells, self.material, self.geometry
        if cells.end_to_end_length >= material.contour_length:
            rule = f"must be smaller than material.contour_length = {shown(material.contour_length)}"
            raise fault(rule, "cells.end_to_end_length", cells.end_to_end_length)
        if cells.axes not in geometry.axis_kinds:
            rule = f"allowed for shape {geometry.shape!r} is " + ", ".join(map(repr, geometry.axis_kinds))
            raise fault(rule, "cells.axes", cells.axes)
        elements = geometry.number_of_elements * self.mesh.refinement**3
        if elements > LARGEST_MESH:
            largest = math.floor((LARGEST_MESH / geometry.number_of_elements) ** (1 / 3))
            rule = f"must be at most {largest} for a {geometry.shape}: more makes over {LARGEST_MESH:g} elements"
            raise fault(rule, "mesh.refinement", self.mesh.refinement)
        for name, load in self.loads.items():
            self._check_load(name, load)
        return self

    def _check_load(self, name: str, load: Load) -> None:
        step, key = self.time.step, f"loads.{name}"
        for index, (time, factor) in enumerate(load.ramp):
            if time <= self.time.end and not _is_multiple(time, step):
                raise fault(_nearest_multiples(time, step, "time.step"), f"{key}.ramp[{index}][0]", time)
            stretch = load.value * factor
            if name == "stretch" and stretch <= -1:
                rule = f"must be greater than -1 at every time; with the factor {shown(factor)} it is {stretch:.6g}"
                raise fault(rule, f"{key}.value", load.value)

    def summary(self) -> str:
        """Stiffness of network and matrix and the largest loads, in one unit and on one line."""
        loads = {}
        for name, load in self.loads.items():
            largest, dimension = load.largest(self.time.end), LOAD_DIMENSIONS.get(name)
            if dimension == STRESS:
                loads[f"largest {name}"] = largest
            elif dimension == FORCE:
                loads[f"largest {name} over its area"] = largest / self.geometry.loaded_area  # type: ignore[union-attr]
        return self.material.summary(loads)

    def warnings(self) -> list[str]:
        """What is allowed but hardly meant, each on one line."""
        under = {} if self.preset is None else PRESETS[self.preset][self.geometry.shape].get("material", {})
        return self.material.warnings(base_material(under))

    def with_values(self, changes: Mapping[str, Any]) -> Scene:
        """A validated copy with other values by dotted key: ``scene.with_values({"loads.pressure.value": 2.4})``.

        Every value of the copy is its own: changing `preset` alone changes nothing.

        Raises
        ------
        SceneError
            One line: key, value, what is allowed.
        """
        values = _plain({name: getattr(self, name) for name in type(self).model_fields}, every_value=True)
        for key, value in changes.items():
            put(values, key, value)
        return Scene(**values)

    def to_toml(self, header: str = "") -> str:
        """The scene with all its values as TOML, each under its description; `read_scene` gives the same scene back.

        Parameters
        ----------
        header
            Lines for the top, each becomes a comment.
        """
        return toml_text(self, header)


_SHAPES: dict[str, type[Cube] | type[Tendon] | type[Tube]] = {"cube": Cube, "tendon": Tendon, "tube": Tube}


def _check_load_names(shape: str, loads: Any) -> None:
    """A load that the shape does not have, before anything is said about what is missing in it."""
    names = _SHAPES[shape].load_names
    for name, load in loads.items() if isinstance(loads, Mapping) else ():
        if name not in names:
            key, listed = f"loads.{quoted(str(name))}", ", ".join(f"loads.{known}" for known in names)
            rule = f"is now {RENAMED[key]}" if key in RENAMED else f"a {shape} has no such load; allowed: {listed}"
            raise fault(rule, key, load)


def _plain(value: Any, every_value: bool = False) -> Any:
    """Tables as dicts of the values that were set (or of all), so that they merge as the same keys in TOML do."""
    if isinstance(value, BaseModel):
        kind = {"shape": value.shape} if isinstance(value, (Cube, Tendon, Tube)) else {}
        names = [name for name in type(value).model_fields if every_value or name in value.model_fields_set]
        return kind | {name: _plain(getattr(value, name), every_value) for name in names}
    if isinstance(value, Mapping):
        return {name: _plain(entry, every_value) for name, entry in value.items()}
    return value


# ---------------------------------------------------------------- reading


def scene_from_dict(values: Mapping[str, Any]) -> Scene:
    """A scene from nested dicts with the keys of the TOML file.

    Raises
    ------
    SceneError
        One line: key, value, what is allowed.
    """
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        raise SceneError(f"scene = {shown(values)}: must be a table")
    return Scene(**values)


def preset_scene(preset: str, shape: str) -> Scene:
    """The scene of a preset on one of its shapes, named after the shape.

    Raises
    ------
    SceneError
        If there is no such preset or shape, or if the preset leaves something for a scene to choose.
    """
    return scene_from_dict({"name": shape, "preset": preset, "geometry": {"shape": shape}})


def read_scene(path: str | os.PathLike[str], overrides: Iterable[str] = ()) -> Scene:
    """A scene from a TOML file.

    Parameters
    ----------
    path
        The file, UTF-8.
    overrides
        "KEY=VALUE" with a dotted key and a TOML value (a bare word is a string): laid over the file's keys, before the
        preset is.

    Raises
    ------
    SceneError
        One line: file and line, or key, value and what is allowed.
    """
    values = read_toml(Path(path))
    for override in overrides:
        key, value = parse_override(override)
        put(values, key, value)
    values.setdefault("name", re.sub(r"^[^\w]+|[^\w+-]+$|[^\w .+-]", "", Path(path).stem)[:100].rstrip(" .") or "scene")
    return scene_from_dict(values)
