"""Scenes: the simulation to run, as TOML or as Python objects, validated before any solve.

`read_scene` reads a file; `Scene(...)` and `scene_from_dict` take the same keys from Python.
docs/scene.md lists all keys.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import re
from functools import partial
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, Field, ModelWrapValidatorHandler, SerializeAsAny, model_validator

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx.body import LoadKind, SHAPES, Shape
from remodel_fenicsx.body.reductions import AUTO, choice, negative_loads
from remodel_fenicsx.body.shape import Column, columns_of, columns_on_request
from remodel_fenicsx.body.wall import RoundWall, Walled
from remodel_fenicsx.fem.formulations import FORMULATIONS, NOT_LOCKING
from remodel_fenicsx.fem.kinematics import KINEMATICS, Kinematics
from remodel_fenicsx.model.axes import GROWTH, NATURAL_GRADIENT
from remodel_fenicsx.model.chains import CHAINS
from remodel_fenicsx.model.energy import MATRICES, REPULSIONS, TURNED_OVER, Tissue, neo_hookean
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.scene import presets
from remodel_fenicsx.schema.settings import (
    AS_GIVEN,
    COUPLINGS,
    Cells,
    Load,
    LoadCase,
    MEASURED_CELLS,
    Material,
    Mesh,
    Model,
    NAME,
    Natural,
    Output,
    Properties,
    REGION,
    REMODELS,
    Region,
    Remodeling,
    Solver,
    Supports,
    Time,
    UNLOADED,
    WALL_STRESSES,
    faces_of,
)
from remodel_fenicsx.schema.tables import (
    Faults,
    IN_A_LIST,
    KeysOfParts,
    OneOf,
    SceneError,
    Table,
    VariantOf,
    allowed,
    choices,
    validation_error,
    is_number,
    quoted,
    format_value,
)
from remodel_fenicsx.schema.text import (
    merge_nested,
    parse_override,
    set_nested,
    read_toml,
    toml_text,
)
from remodel_fenicsx.schema.units import (
    FORCE,
    LENGTH_UNIT,
    LARGEST_NUMBER,
    STRESS,
    STRESS_UNIT,
    NUMBER_TOO_LARGE,
    convention_doubt,
    scene_units,
)
from remodel_fenicsx.system.interrupts import is_first_rank

log = logging.getLogger(__name__)


# ---------------------------------------------------------------- plausibility
# Numbers that are probably in another unit than the rest, from ratios in decades.

# Usual ranges of ratios in decades. Units differ by a factor of 1000 or more, deliberate choices
# seldom by 100. NETWORK: initial stiffness of the network over that of the matrix; the paper's
# bodies have 1.1 and 1.5. LOAD: largest stress of a load over the stiffness of both; the paper's
# loads have 0.7 to 4.6, and weak loads can be deliberate.
NETWORK = (-2, 2)
LOAD = (-4, 2)


def doubts(
    material: Material,
    geometry: Shape,
    loads: Mapping[str, Load],
    end_to_end_length: float,
    end: float,
) -> Iterator[str]:
    """Yield a line for each implausible value; none for plausible tissue."""
    unit = material.stress_unit
    network = chain_stress(material, end_to_end_length)
    ratio, stiffness = network / material.lame_mu, material.lame_mu + network
    if network and (way := _outside_decades(ratio, NETWORK)):
        yield (
            f"material.chain_density = {material.chain_density:g}: "
            f"the network (c g(r0) r0^2 = {network:.3g} {unit}) is "
            f"{_format_factor(ratio)} {'softer' if way < 0 else 'stiffer'} "
            f"than the matrix (lame_mu = {material.lame_mu:.4g} {unit}); "
            "check chain_density (in 1/m^3), lame_mu and stress_unit"
        )
    for key, words, ratio, decades in geometry.proportions:
        if _outside_decades(ratio, decades):
            one = "check the units, all lengths are in geometry.length_unit"
            yield f"geometry.{key} = {getattr(geometry, key):g}: {words} is {ratio:.3g}; {one}"
    for name, load in loads.items():
        key, kind = f"loads.{name}.value", geometry.loads_on(faces_of(loads))[name]
        value = load.largest(end)
        if words := convention_doubt(name, value):
            yield f"{key}: {words}"
        stress = abs(largest_stress(kind, value, geometry) or 0.0)
        if stress and (way := _outside_decades(stress / stiffness, LOAD)):
            yield (
                f"{key}: the largest stress, {stress:.3g} {unit}, is "
                f"{_format_factor(stress / stiffness)} {'more' if way > 0 else 'less'} "
                "than the stiffness of matrix and network "
                f"(lame_mu + c g(r0) r0^2 = {stiffness:.3g} {unit}); check material.stress_unit"
            )


# r/L above which a wall is too soft. In three dimensions a thin wall that reaches 0.98 takes 1,200
# Newton iterations in its first step; with 0.96 it takes 100, with 0.90 23.
NEAR_LOCKING = 0.9


def borne(tissue: Tissue, is_loaded: bool) -> float:
    """Return p / ln(r_o/r_i) of a neo-Hookean wall with isotropic cells at r = `NEAR_LOCKING` L.

    Radii are as prescribed; length and volume are constant. Without chains: the limit load.
    """
    # The stretch is the square of the circumferential one.
    chain, modulus = tissue.chain, tissue.lame_mu
    stretch = math.inf
    if tissue.matrix is not neo_hookean or tissue.elastin_axial is not None:
        return math.inf
    if chain is not None:
        length, start = NEAR_LOCKING * tissue.contour_length, tissue.end_to_end_length
        half = (3 * (length / start) ** 2 - 1) / 2
        if not chain.locks or half <= 1:
            return math.inf
        stretch = half + math.sqrt(half**2 - 1)
        modulus += (
            tissue.network_modulus * chain.stiffness(length, tissue.contour_length) * start**2 / 3
        )
    return float(modulus * (1 - stretch**-2) * (stretch if is_loaded else 1))


def too_soft(scene: Scene, wall: object = None) -> Iterator[str]:
    """Yield a line if the pressure stretches the wall until its chains nearly lock."""
    log_of_radii = scene.geometry.log_of_radii(wall)
    if log_of_radii is None or "pressure" not in scene.loads:
        return
    stress = (
        max(case.loads["pressure"].largest(scene.last_time) for case in scene.each_case())
        / log_of_radii
    )
    most = max(borne(one.tissue, scene.geometry.is_loaded) for one in scene.properties().values())
    if stress > most:
        unit = scene.material.stress_unit
        yield (
            "loads.pressure.value: the largest pressure causes a mean wall stress of "
            f"{stress:.3g} {unit}, but with chains at {100 * NEAR_LOCKING:g} % of their contour "
            f"length the tissue bears {most:.3g} {unit}. The pressure is high for this "
            "tissue: steps may be slow or fail; check the pressure, its unit and stress_unit"
        )


def _doubted_keys(values: Mapping[str, object]) -> Iterator[str]:
    """Yield a line for each number that may follow another convention, such as percent."""
    for key, value in leaves(values):
        numbers = value if isinstance(value, (list, tuple)) else [value]
        is_of_numbers = bool(numbers) and all(isinstance(number, float) for number in numbers)
        if is_of_numbers and (words := convention_doubt(key, numbers)):
            yield f"{key}: {words}"


def chain_stress(material: Material, end_to_end_length: float) -> float:
    """Return the network's initial stiffness c g(r0) r0^2 in stress_unit; 0 without chains."""
    tissue = material.tissue(end_to_end_length)
    return (
        float(tissue.repulsion_modulus * end_to_end_length**2) if tissue.chain is not None else 0.0
    )


def largest_stress(kind: LoadKind, value: float, geometry: Shape) -> float | None:
    """Return the stress of a load: the load itself, a force over its area, or None (elongation)."""
    if kind.dimension == FORCE and kind.area is not None:
        return value / kind.area(geometry)
    return value if kind.dimension == STRESS else None


def _outside_decades(ratio: float, decades: tuple[float, float]) -> int:
    """Return -1 below the range, 1 above it, and 0 inside."""
    return (ratio > 10.0 ** decades[1]) - (ratio < 10.0 ** decades[0])


def _format_factor(ratio: float) -> str:
    """Format a ratio's distance from one: a factor with two digits, and decades."""
    factor = max(ratio, 1 / ratio)
    return f"{float(f'{factor:.2g}'):g} times ({math.log10(factor):.1f} decades)"


# components that may bring keys of [material]
PARTS_OF_MATERIAL = {"chain": CHAINS, "matrix": MATRICES, "repulsion": REPULSIONS}
FORMAT = 2  # format of recorded scenes; increased if earlier versions could not read them
# per kind of table; each table is checked against all others and has its own columns
MOST_TABLES = 200
# times 1/kappa: no trace of the start is left, also in cells below a hundredth of a tension
STEADY_STATE_TIME = 1000.0


# ---------------------------------------------------------------- the scene


@with_old_names
class Scene(Table):
    """A scene: its top-level keys and its tables.

    Its keyword arguments are the keys of a scene file (docs/scene.md), with a dictionary for each
    table. Stresses are in `material.stress_unit`, lengths in `geometry.length_unit`, times in any
    one unit. A scene is immutable: `with_values` returns a changed copy.

    Raises
    ------
    SceneError
        If a key is unknown or missing, or a value is not allowed; one line.

    Examples
    --------
    >>> from remodel_fenicsx import Scene
    >>> scene = Scene(
    ...     preset="kuhl-holzapfel-2007",
    ...     geometry={"shape": "cube"},
    ...     loads={"force": {"value": 10.0, "ramp": [[0.0, 0.0], [10.0, 1.0]]}},
    ...     time={"end": 100.0},
    ... )
    >>> scene.remodeling.kappa, scene.material.lame_mu  # from the preset
    (0.025, 3.103)
    >>> scene.with_values({"remodeling.kappa": 0.1}).remodeling.kappa
    0.1
    >>> scene.with_values({"remodeling.kappa": -1.0})
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: remodeling.kappa = -1.0: must be a finite number ...
    """

    # the rules of `scene.rules`, in order
    _rules: ClassVar[Sequence[Callable[[Scene], Faults]]] = ()

    format: int = Field(default=FORMAT, ge=1, le=FORMAT)
    """Format number of the scene. Recorded scenes have it; version 0.1.0 wrote none."""
    name: str = Field(
        default="scene",
        pattern=r"^\w(?:[\w .+-]{0,98}[\w+-])?$",
        json_schema_extra={
            "allowed": "a file name: letters, digits, spaces and . + - _, at most 100, "
            "a letter or digit first"
        },
    )
    """Name of the scene and of its results folder. Default: the file name without `.toml`."""
    preset: Annotated[str | None, OneOf(presets.PRESETS)] = None
    """Published model with the values of all keys that the scene does not set (presets below)."""
    profile: Annotated[str | None, OneOf(presets.PROFILES)] = None
    """Settings of mesh, kinematics and steps for speed or accuracy (docs/reliability.md)."""
    geometry: Annotated[SerializeAsAny[Shape], VariantOf(SHAPES, "shape")]
    mesh: Mesh = Mesh()
    model: Model = Model()
    material: Annotated[SerializeAsAny[Material], KeysOfParts(PARTS_OF_MATERIAL)] = Material()
    cells: Cells = Cells()
    supports: Supports = Supports()
    natural: Natural = Natural()
    regions: dict[str, Region] = {}
    loads: dict[str, Load] = {}
    cases: Annotated[tuple[LoadCase, ...], IN_A_LIST] = Field(
        default=(), json_schema_extra={"allowed": "a list of tables, each [[cases]]"}
    )
    """Load cases of a cycle, a table `[[cases]]` each. Without them the loads act all the time."""
    remodeling: Annotated[
        SerializeAsAny[Remodeling], KeysOfParts({"law": LAWS}, tables=REMODELS)
    ] = Remodeling()
    time: Time
    solver: Solver = Solver()
    output: Output = Output()

    @model_validator(mode="wrap")
    @classmethod
    def _on_its_preset(cls, values: object, handler: ModelWrapValidatorHandler[Scene]) -> Scene:
        """Merge the scene's keys over profile, preset and shape defaults; convert units."""
        if not isinstance(values, dict):
            return handler(values)
        own = _with_measured_cells(_in_present_format(_plain(values)))
        for name in ("regions", "loads", "cases", "supports"):
            if (
                isinstance(tables := own.get(name), dict | list | tuple)
                and len(tables) > MOST_TABLES
            ):
                raise validation_error(
                    f"has {len(tables)} tables; must have at most {MOST_TABLES}", name, None
                )
        presets.check_exclusive(own)
        preset, profile = own.get("preset"), own.get("profile")
        if preset is not None:
            _check_name("preset", preset, presets.PRESETS)
        shape = _known_shape(own.get("geometry", {}))
        _check_load_names(shape, own.get("loads"))
        base = SHAPES[shape].defaults_of(own)
        if preset is None:
            base = merge_nested(base, presets.default_method(own))
        else:
            if shape not in presets.PRESETS[preset]:
                known = ", ".join(map(repr, presets.PRESETS[preset]))
                raise validation_error(
                    f"the preset {preset!r} has the shapes {known}", "geometry.shape", shape
                )
            base = merge_nested(base, presets.PRESETS[preset][shape])
            loads, kinds = base.get("loads", {}), SHAPES[shape].loads.items()
            own_kinds = [kind for name, kind in kinds if presets.said(own, "loads", name)]
            replaced = {kind.replaces for kind in own_kinds}
            base["loads"] = {name: loads[name] for name in loads if name not in replaced}
        presets.without_coupling(base, own)

        def made(settings: Mapping[str, object]) -> Scene:
            values = merge_nested(merge_nested(base, presets.nested(settings)), own)
            if large := [
                item
                for item in leaves(values)
                if is_number(item[1]) and abs(item[1]) > LARGEST_NUMBER
            ]:
                raise validation_error(NUMBER_TOO_LARGE, *large[0])
            with scene_units(_units(values, SHAPES[shape])):
                return handler(_with_numbers_of_loads(values, SHAPES[shape]))

        if profile is None:
            return made({})
        _check_name("profile", profile, presets.PROFILES)
        return _with_profile(profile, made)

    def _faults(self) -> Faults:
        """Yield faults across tables, after conversion of the experimental parameters."""
        whole = presets.with_own_numbers(self, Scene.whole)
        over = partial(Region.over, others=whole.whole())
        regions = {
            name: presets.with_own_numbers(region, over) for name, region in self.regions.items()
        }
        self.__dict__ |= {
            "material": whole.material,
            "cells": whole.cells,
            "remodeling": whole.remodeling,
            "regions": regions,
        }
        for rule in self._rules:
            yield from rule(self)

    @property
    def _stiffness_ratio(self) -> float:
        """Largest lambda/mu over the regions."""
        materials = [one.material for one in self.properties().values()]
        return max(material.lame_lambda / material.lame_mu for material in materials)

    @property
    def kinematics(self) -> Kinematics:
        """The kinematics that are set, or the ones that "auto" resolves to."""
        return KINEMATICS[choice(self).name]

    @property
    def formulation(self) -> str:
        """The formulation that is set, or the one that "auto" resolves to."""
        if self.mesh.formulation != AUTO:
            return self.mesh.formulation
        return (
            "displacement" if not self._bulk_is_stiff or self.displacement_reason() else NOT_LOCKING
        )

    @property
    def _bulk_is_stiff(self) -> bool:
        return self._stiffness_ratio > FORMULATIONS[NOT_LOCKING].auto_threshold(
            self.mesh.element, self.mesh.degree
        )

    @property
    def is_stress_free(self) -> bool:
        """Whether G = 1: no residual stress, and no prestretch of elastin."""
        properties = self.properties().values()
        return self.natural.is_trivial and not any(one.material.has_elastin for one in properties)

    def displacement_reason(self) -> str:
        """Return why "auto" cannot use the locking-free formulation, or an empty string."""
        if COUPLINGS[self.remodeling.coupling].solves_cells:
            return f"remodeling.coupling = {self.remodeling.coupling!r}"
        if not self.is_stress_free:
            return "[natural]" if not self.natural.is_trivial else "material.elastin"
        if key := self.remodeling.growth_key:
            return f"{key} above 0"
        if not self.material.has_volumetric_split:
            return f"material.matrix = {self.material.matrix!r}"
        return "homogeneous deformation" if self.kinematics.homogeneous else ""

    def describe_formulation(self) -> str:
        """Describe the resolved formulation and its reason."""
        needs = self.displacement_reason() if self._bulk_is_stiff else ""
        return (
            f"formulation {self.formulation!r}: lambda/mu = {self._stiffness_ratio:.4g}, "
            f"{'above' if self._bulk_is_stiff else 'not above'} the limit of 'auto'"
            f"{f'; {needs} needs displacement' if needs else ''}"
        )

    @property
    def end_of_ramps(self) -> float:
        """Time after which no load changes; 0 without loads."""
        return max((load.ramp[-1][0] for load in self.loads.values()), default=0.0)

    @property
    def hold_before_change(self) -> tuple[float, float] | None:
        """Start and end of the hold in which cells reach equilibrium before growth, or None."""
        waits = any(process.starts_at_equilibrium for process in self.remodeling.processes)
        return self.last_hold if waits else None

    @property
    def last_hold(self) -> tuple[float, float] | None:
        """Start and end of the last hold of all loads before a further change, or None."""
        corners = sorted({time for load in self.loads.values() for time, _ in load.ramp})
        last, held = None, None
        for start, end in itertools.pairwise(corners):
            if all(load.factor(start) == load.factor(end) for load in self.loads.values()):
                held = start, end
            else:
                last = held
        return last

    @property
    def last_time(self) -> float:
        """Time of the last row; with "equilibrium" a time at which the start has no effect."""
        if not self.time.is_equilibrium:
            return float(self.time.end)
        rates = [properties.kappa for properties in self.properties().values()]
        rates += [one.rate for one in self.remodeling.processes if one.rate]
        return self.end_of_ramps + STEADY_STATE_TIME / min(rates)

    def each_case(self) -> list[Scene]:
        """Return a scene for each load case with its loads; the scene itself if it has no cases."""
        scenes = []
        for case in self.cases:
            loads = dict(self.loads)
            for name in {*case.loads} & {*loads}:
                loads[name] = loads[name].model_copy(
                    update={"value": loads[name].value * case.loads[name]}
                )
            scenes.append(self.model_copy(update={"loads": loads, "cases": ()}))
        return scenes or [self]

    def whole(self) -> Properties:
        """Return the properties of the whole body, which hold unless a region sets its own."""
        return Properties(self.material, self.cells, self.remodeling.kappa)

    def properties(self) -> dict[str, Properties]:
        """Return the properties of each region, and under "" of the remaining body, if any."""
        body = self.whole()
        properties = {"": body} | {name: region.over(body) for name, region in self.regions.items()}
        if self.regions and isinstance(self.geometry, RoundWall):
            del properties[""]
        has_chains = any(one.material.chain_density for one in properties.values())
        for name, one in properties.items():
            stays = has_chains and not one.material.chain_density  # These cells have no collagen.
            kappa = 0.0 if stays else self.remodeling.speed(one.kappa, one.material.temperature)
            properties[name] = one._replace(kappa=kappa)
        return properties

    @property
    def has_random_cells(self) -> bool:
        """Whether any cells are random."""
        return any(
            properties.cells.initial == "random" for properties in self.properties().values()
        )

    @property
    def cell_order_can_change(self) -> bool:
        """Whether the law is ranked and the lengths of cells vary, so that their order can jump."""
        return LAWS[self.remodeling.law].is_ranked and (
            self.has_random_cells or bool(self.measured_cells)
        )

    @property
    def is_as_run(self) -> bool:
        """Whether the scene sets its format, as recorded scenes do."""
        return "format" in self.model_fields_set

    @property
    def measured_cells(self) -> dict[str, Cells]:
        """Cells from fibre files by region, under "" for the remaining body."""
        by_region = {name: properties.cells for name, properties in self.properties().items()}
        return {name: cells for name, cells in by_region.items() if cells.initial == MEASURED_CELLS}

    @property
    def column_names(self) -> list[str]:
        """Names of all columns that a history can have; a region's name can cause duplicates."""
        always = columns_of(self.geometry, regions=self.regions)
        return [
            *columns_on_request(self.geometry, self.regions, self.held_faces),
            *(column.name for column in always),
        ]

    def columns(self, more: Iterable[str] = ()) -> tuple[Column, ...]:
        """Return the columns of the history in file order, with `more` of those on request."""
        requested = [*self.output.columns, *more]
        return columns_of(
            self.geometry, requested, self.loads, self.regions, len(self.cases), self.held_faces
        )

    @property
    def held_faces(self) -> list[str]:
        """Supported faces that have force columns."""
        return self.geometry.held_faces(self.supports.faces)

    def stops(self) -> list[float]:
        """Return the times that steps hit exactly: corners of ramps, output.times and the end."""
        end = self.last_time
        times = {time for load in self.loads.values() for time, _ in load.ramp if 0 < time < end}
        times.update(*(process.stops for process in self.remodeling.processes))
        return sorted({*times, *self.output.times, end})

    @property
    def load_kinds(self) -> dict[str, LoadKind]:
        """All loads that the scene can have, by name."""
        return self.geometry.loads_on(faces_of(self.loads))

    @property
    def lacking_fields(self) -> dict[str, str]:
        """Fields that the body does not have, each with the reason."""
        same, processes = self.is_stress_free, self.remodeling.processes
        stress_free = (
            "the mesh is stress-free ([natural]): 'fibre_angle' is the angle in the unloaded body"
        )
        reasons: list[tuple[bool, Sequence[str], str]] = [
            (not self.regions, (REGION,), "the scene has no regions"),
            (
                not isinstance(self.geometry, Walled),
                WALL_STRESSES,
                f"hoop and axial are directions of a wall; a {self.geometry.name} has none",
            ),
            (same, (UNLOADED,), stress_free),
            (same and not self.remodeling.growth_key, (NATURAL_GRADIENT,), stress_free),
            (not processes, (*TURNED_OVER, GROWTH), "no process changes it"),
        ]
        lacking = {name: reason for lacks, names, reason in reasons if lacks for name in names}
        return lacking | {name: why for one in processes for name, why in one.absent.items()}

    @property
    def has_free_length(self) -> bool:
        """Whether the body's length is an unknown."""
        kinds, shape = self.load_kinds, self.geometry
        return (
            self.supports.ends in shape.ends and shape.ends[self.supports.ends].makes_length_unknown
        ) or any(kinds[name].makes_length_unknown for name in self.loads)

    @property
    def has_unknown_pressure(self) -> bool:
        """Whether the pressure in the lumen is an unknown, because its volume is prescribed."""
        return any(self.load_kinds[name].makes_pressure_unknown for name in self.loads)

    def summary(self) -> str:
        """Describe stiffness of network and matrix and largest loads on one line, in one unit."""
        loads = {}
        for name in self.loads:
            largest = max(
                (case.loads[name].largest(self.last_time) for case in self.each_case()), key=abs
            )
            stress = largest_stress(self.load_kinds[name], largest, self.geometry)
            if stress is not None:
                is_force = self.load_kinds[name].dimension == FORCE
                loads[f"largest {name}{' over its area' if is_force else ''}"] = stress
        parts = [
            _words(name) + properties.material.summary(loads)
            for name, properties in self.properties().items()
        ]
        parts += [one.summary() for one in self.remodeling.processes if one.is_on]
        return "; ".join(parts)

    def warnings(self, wall: object = None) -> list[str]:
        """Return warnings on values that are allowed but implausible, one line each.

        Parameters
        ----------
        wall
            Domain of a meshed wall, for the areas of its faces.
        """
        warnings: dict[str, None] = {}
        properties = self.properties()
        if self.geometry.covers_body(self.regions):
            properties.pop("", None)  # The entry holds nowhere.
        for name, (material, cells, _) in properties.items():
            for case in self.each_case():
                lines = doubts(
                    material, self.geometry, case.loads, cells.end_to_end_length, self.last_time
                )
                warnings |= dict.fromkeys(
                    line if line.startswith("geometry.") else _words(name) + line for line in lines
                )
        # Doubtful units explain a soft wall.
        warnings |= {} if warnings else dict.fromkeys(too_soft(self, wall))
        if "pressure" in negative_loads(self):
            cost = "" if self.kinematics.reduced else " The run is in 3D, which takes minutes"
            warnings[f"loads.pressure: below zero, suction; is its sign right?{cost}"] = None
        warnings |= dict.fromkeys(self.geometry.unresolved(self.mesh, self.output.columns))
        tables = self.model_dump(exclude={"loads", "cases"})
        warnings |= dict.fromkeys(_doubted_keys(tables))
        return [
            *warnings,
            *self.loaded_shape_warnings(),
            *self._process_warnings(),
            *self.remodeling.warnings(),
        ]

    def loaded_shape_warnings(self) -> list[str]:
        """Return a warning if the cells reorient, so that rows leave the loaded geometry."""
        turns = LAWS[self.remodeling.law].remodels and any(
            one.kappa for one in self.properties().values()
        )
        if not (self.geometry.is_loaded and turns and self.natural.cells == AS_GIVEN):
            return []
        way = "apply all loads in the first step to have a row with this shape"
        if isinstance(self.geometry, RoundWall):
            way = (
                "set natural.cells = 'equilibrium' and time.end = 'equilibrium' if its cells are "
                f"in equilibrium, or {way}"
            )
        return [
            "geometry.is = 'loaded': it is the shape under all loads with the initial cells. The "
            f"cells reorient while and after the loads rise, and the body leaves this shape; {way}"
        ]

    def _process_warnings(self) -> Iterator[str]:
        """Yield warnings on the additional processes that are on."""
        chosen = self.time.is_equilibrium or self.time.is_adaptive
        step = 0.0 if chosen or COUPLINGS[self.remodeling.coupling].solves_cells else self.time.step
        for process in (one for one in self.remodeling.processes if one.is_on):
            for name, properties in self.properties().items():
                yield from (_words(name) + line for line in process.warnings(properties.tissue))
            yield from filter(None, [process.step_warning(step)])

    def _values(self) -> dict[str, Any]:
        """Return all values, from which the same scene can be made."""
        return self.model_dump(exclude_none=True, exclude=None if self.is_as_run else {"format"})

    # For child processes: classes with keys of components cannot be found by name there.
    def __reduce__(self) -> tuple[object, ...]:
        return scene_from_dict, (self._values(),)

    def with_values(self, changes: Mapping[str, object]) -> Scene:
        """Return a validated copy with other values by dotted key.

        For example ``scene.with_values({"loads.pressure.value": 2.4})``. The copy has all values of
        its own: changing only `preset` changes nothing.

        Raises
        ------
        SceneError
            One line: key, value, allowed values.
        """
        values = self._values()
        for key, value in changes.items():
            if not isinstance(key, str):
                raise SceneError(
                    f"{format_value(key)} = {format_value(value)}: a key must be text, "
                    "as in 'cells.seed'"
                )
            set_nested(values, key, value)
        _follow(values, changes, is_whole=True)
        return type(self)(**values)

    def to_toml(self, header: str = "") -> str:
        """Return the scene with all its values as TOML, which `read_scene` reads back.

        Parameters
        ----------
        header
            Lines of comment for the top.
        """
        return toml_text(self, header)


# ---------------------------------------------------------------- values as read from a file


def _in_present_format(values: Mapping[str, object]) -> dict[str, object]:
    """Update values to the present format; reject a newer format before its unknown keys."""
    written = values.get("format")
    if not isinstance(written, int) or isinstance(written, bool) or written < 1:
        return dict(values)  # The field's own error describes a wrong value.
    if written > FORMAT:
        rule = (
            f"written by a newer version of remodel_fenicsx; this one reads formats up to {FORMAT}"
        )
        raise validation_error(rule, "format", written)
    values = {**values, "format": FORMAT}
    turnover = presets.said(values, "remodeling", "turnover")
    if isinstance(turnover, Mapping) and "time" in turnover:  # defaults of version 0.3.0
        values = merge_nested(
            {"remodeling": {"turnover": {"rates": "tension", "volume": 0.0}}}, values
        )
    return values


def _with_measured_cells(values: dict[str, object]) -> dict[str, Any]:
    """Set cells.initial = "fibres" for the body and for regions with a fibre file."""
    for name, part in presets.parts_of(values):
        fibres, initial = (presets.said(part, "cells", key) for key in ("fibres", "initial"))
        if fibres is not None and initial not in (None, MEASURED_CELLS):
            place = f"{presets.region_prefix(name)}cells"
            raise validation_error(
                f"{place}.initial = {format_value(initial)} is also set; set only one of them",
                f"{place}.fibres",
                fibres,
            )
        if fibres is not None:
            values = presets.with_part(values, name, {"cells": {"initial": MEASURED_CELLS}})
    return values


def _beside(values: dict[str, object], folder: Path) -> dict[str, object]:
    """Resolve the file names of a scene against its folder."""
    for name, part in presets.parts_of(values):
        if isinstance(file := presets.said(part, "cells", "fibres"), str):
            values = presets.with_part(
                values, name, {"cells": {"fibres": str(folder.absolute() / file)}}
            )
    kind = presets.said(values, "geometry", "shape")
    if isinstance(kind, str) and kind in SHAPES:
        values = {**values, "geometry": SHAPES[kind].with_files_from(values["geometry"], folder)}
    return values


def _words(region: str) -> str:
    return f"{region}: " if region else ""


def _follow(values: dict[str, Any], changed: Mapping[str, object], is_whole: bool) -> None:
    """Remove values that no longer fit changed keys; with `is_whole` also replaced values."""
    times, end = presets.said(values, "output", "times"), presets.said(values, "time", "end")
    if (
        "time.end" in changed
        and "output.times" not in changed
        and is_number(end)
        and isinstance(times, list | tuple)
    ):
        values["output"]["times"] = [time for time in times if not is_number(time) or time <= end]
        if (dropped := len(times) - len(values["output"]["times"])) and is_first_rank():
            log.warning("output.times: dropped %d times after time.end = %g", dropped, end)
    if is_whole:
        presets.without_replaced(values, changed)


def _check_name(key: str, name: object, names: Iterable[str]) -> None:
    if not isinstance(name, str) or name not in names:
        raise validation_error("must be one of " + ", ".join(map(repr, names)), key, name)


def _known_shape(geometry: object) -> str:
    """Return the shape. Check it first: preset, loads and units depend on it."""
    if not isinstance(geometry, Mapping):
        raise validation_error("must be a table", "geometry", geometry)
    if "shape" not in geometry:
        raise validation_error(
            "missing; must be one of " + ", ".join(map(repr, SHAPES)), "geometry.shape", None
        )
    _check_name("geometry.shape", geometry["shape"], SHAPES)
    return str(geometry["shape"])


def _units(values: Mapping[str, object], shape: type[Shape]) -> dict[str, str | None]:
    """Return the units that a scene chooses, by key."""
    units: dict[str, str | None] = {}
    for key, kind in ((STRESS_UNIT, Material), (LENGTH_UNIT, shape)):
        table, name = key.split(".")
        field, chosen = kind.model_fields[name], presets.said(values, table, name)
        if chosen not in (*choices(field), None):
            raise validation_error(allowed(field), key, chosen)
        units[key] = field.default if chosen is None else chosen
    return units


def _with_numbers_of_loads(values: Mapping[str, object], shape: type[Shape]) -> dict[str, object]:
    """Convert loads with units to numbers; the shape knows their dimensions."""
    loads = values.get("loads")
    if not isinstance(loads, Mapping):
        return dict(values)
    converted = dict(loads)
    for name, kind in shape.loads_on(faces_of(loads)).items():
        load = loads.get(name)
        if isinstance(load, Mapping) and "value" in load and kind.dimension is not None:
            converted[name] = {
                **load,
                "value": kind.dimension.number(load["value"], f"loads.{quoted(name)}.value"),
            }
    return {**values, "loads": converted}


def _check_load_names(shape: str, loads: object) -> None:
    """Reject loads that the shape does not have, before errors on their missing keys."""
    kind = SHAPES[shape]
    names = kind.loads
    for name, load in loads.items() if isinstance(loads, Mapping) else ():
        if (
            kind.supported_faces is None
            and isinstance(load, Mapping)
            and ("kind" in load or "face" in load)
        ):
            _check_load_on_face(kind, str(name), load)
        elif name not in names:
            key, listed = f"loads.{quoted(str(name))}", ", ".join(
                f"loads.{known}" for known in names
            )
            raise validation_error(f"a {shape} has no such load; allowed: {listed}", key, load)


def _check_load_on_face(shape: type[Shape], name: str, load: Mapping[str, object]) -> None:
    key = f"loads.{quoted(name)}"
    if not isinstance(load.get("face"), str):
        raise validation_error("missing or not the name of a face", f"{key}.face", load.get("face"))
    if name in shape.loads:
        raise validation_error(
            f"{shape.loads[name].meaning}; rename the load to use another face",
            f"{key}.face",
            load["face"],
        )
    if not re.fullmatch(NAME, name) or name in {column.name for column in columns_of(shape)}:
        raise validation_error(
            "its name must be a letter, then letters, digits and _, at most 40 in all, "
            "and not the name of a column",
            key,
            None,
        )


def _plain(value: object) -> Any:
    """Convert tables to dicts of the values that were set, which merge as TOML keys do."""
    if isinstance(value, BaseModel):
        kind = {"shape": value.name} if isinstance(value, Shape) else {}
        return kind | value.model_dump(exclude_unset=True, exclude_none=True)
    return (
        {name: _plain(entry) for name, entry in value.items()}
        if isinstance(value, Mapping)
        else value
    )


# ---------------------------------------------------------------- reading


def scene_from_dict(values: Mapping[str, Any]) -> Scene:
    """Make a scene from nested dicts with the keys of a scene file."""
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        raise SceneError(f"scene = {format_value(values)}: must be a table")
    return Scene(**values)


def preset_scene(preset: str, shape: str) -> Scene:
    """Make the scene of a preset on one of its shapes, named after the shape.

    Parameters
    ----------
    preset
        Name of the preset: "kuhl-holzapfel-2007" (the paper), "consistent", "sun-2002"
        or "carotid" (a tube alone).
    shape
        "cube", "tendon" or "tube".

    Returns
    -------
    Scene
        Scene with all values of the preset, and with its units of stress and length, if any.

    Raises
    ------
    SceneError
        If preset or shape are unknown, or the preset does not set all required keys.

    Examples
    --------
    >>> from remodel_fenicsx import preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "tube")  # the artery of Fig. 7
    >>> scene.name, scene.geometry.outer_radius, scene.loads["pressure"].value
    ('tube', 3.0, 4.8)
    >>> preset_scene("a", "tube")
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: preset = 'a': must be one of 'kuhl-holzap...
    """
    return scene_from_dict({"name": shape, "preset": preset, "geometry": {"shape": shape}})


def read_scene(
    path: str | os.PathLike[str], overrides: Iterable[str] = (), profile: str | None = None
) -> Scene:
    """Read a scene from a TOML file.

    Parameters
    ----------
    path
        The file, in UTF-8.
    overrides
        "KEY=VALUE" with a dotted key and a TOML value (a bare word is a string). Overrides replace
        keys of the file before the preset is applied.
    profile
        Name of a profile. Its settings replace keys of the file, but not `overrides`.

    Returns
    -------
    Scene
        The validated scene, with the preset's values for all other keys.

    Raises
    ------
    SceneError
        One line: file and line, or key, value and allowed values.

    Examples
    --------
    >>> from pathlib import Path
    >>> from remodel_fenicsx import preset_scene, read_scene
    >>> text = preset_scene("kuhl-holzapfel-2007", "cube").to_toml()
    >>> size = Path("cube.toml").write_text(text)
    >>> scene = read_scene("cube.toml", ["time.end=5", "remodeling.kappa=0.1"])
    >>> scene.time.end, scene.remodeling.kappa
    (5.0, 0.1)
    """
    read = read_toml(Path(path))
    # Other dots belong to the name.
    name = re.sub(r"\.toml$", "", Path(path).name, flags=re.IGNORECASE)
    read.setdefault(
        "name", re.sub(r"^[^\w]+|[^\w+-]+$|[^\w .+-]", "", name)[:100].rstrip(" .") or "scene"
    )
    changes = dict(parse_override(override) for override in overrides)
    chosen = set(CHOSEN_BY_RUNS) - set(changes) if changes and "format" in read else set()

    def made(settings: Mapping[str, object]) -> Scene:
        values = merge_nested(read, presets.nested(settings))
        for key, value in changes.items():
            set_nested(values, key, value)
        _follow(values, changes, is_whole="format" in values)
        return _chosen_anew(_beside(values, Path(path).parent), chosen)

    if profile is None:
        return made({})
    return _with_profile(profile, lambda settings: made({"profile": profile, **settings}))


CHOSEN_BY_RUNS = ("model.kinematics", "mesh.formulation")


def _chosen_anew(values: dict[str, object], chosen: set[str]) -> Scene:
    """Make the scene, with "auto" for choices of the run that are no longer valid."""
    try:
        return scene_from_dict(values)
    except SceneError as error:
        key = str(error).partition(" ")[0]
        if key not in chosen:
            raise
        scene = _chosen_anew(merge_nested(values, presets.nested({key: AUTO})), chosen - {key})
        if is_first_rank():
            log.warning("%s; using %s instead", error, format_value(AUTO))
        return scene


def _with_profile(name: str, made: Callable[[Mapping[str, object]], Scene]) -> Scene:
    """Make the scene with a profile's settings, which depend on its cells and loads."""
    # An unknown name is rejected here.
    scene = made(presets.PROFILES[name].values if name in presets.PROFILES else {})
    settings = presets.profile_for(name, scene).settings(scene)
    return scene if settings == presets.PROFILES[name].values else made(settings)


# ---------------------------------------------------------------- resumed runs

# Keys that may change: they determine no result of the steps done, or only how these were solved.
# Of a mesh file only the contents matter (geometry.sha256).
RESUMABLE_KEYS = (
    "format",
    "name",
    "preset",
    "profile",
    "output",
    "solver",
    "loads",
    "time.end",
    "geometry.file",
)
SAME_LOAD = 1e-12  # relative difference below which two loads are equal


def check_continuation(old: Scene, new: Scene, time: float) -> None:
    """Check that a scene has the physics of the recorded run until `time`."""
    rule = (
        "a resumed run may change time.end, output, solver, and loads after its checkpoint "
        f"at {time:g}"
    )
    before, now = (
        dict(leaves(scene.model_dump(mode="json"), RESUMABLE_KEYS)) for scene in (old, new)
    )
    for key in [*before, *(key for key in now if key not in before)]:
        if before.get(key) != now.get(key):
            was = format_value(before[key]) if key in before else "not set"
            raise SceneError(f"{key} = {format_value(now.get(key))}: was {was}; {rule}")
    for name in {**old.load_kinds, **new.load_kinds}:
        first, second = old.loads.get(name), new.loads.get(name)
        for key in ("face", "kind", "direction") if first and second else ():
            was, value = getattr(first, key), getattr(second, key)
            if was != value:
                words = f"loads.{name}.{key} = {format_value(value)}: was {format_value(was)}"
                raise SceneError(f"{words}; {rule}")
        for moment in sorted({0.0, time, *_ramp_times(first), *_ramp_times(second)}):
            old_value, value = (
                0.0 if one is None else one.value * one.factor(moment) for one in (first, second)
            )
            if moment <= time and abs(old_value - value) > SAME_LOAD * max(
                abs(old_value), abs(value)
            ):
                raise SceneError(
                    f"loads.{name} = {value:g} at time {moment:g}: was {old_value:g}; {rule}"
                )
    if new.last_time < time:
        raise SceneError(
            f"time.end = {format_value(new.time.end)}: must be at least {time:g}, "
            "the checkpoint's time"
        )


def _ramp_times(load: Load | None) -> list[float]:
    return [] if load is None else [time for time, _ in load.ramp]


def leaves(value: object, free: Sequence[str] = (), key: str = "") -> Iterator[tuple[str, object]]:
    """Yield (dotted key, value) of all values in tables and lists of tables, except free keys."""
    if key in free or key.endswith("cells.fibres"):  # The file's SHA-256 must not change.
        return
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from leaves(inner, free, f"{key}.{name}" if key else str(name))
    elif isinstance(value, (list, tuple)) and any(isinstance(entry, Mapping) for entry in value):
        for number, inner in enumerate(value):
            yield from leaves(inner, free, f"{key}[{number}]")
    else:
        yield key, value
