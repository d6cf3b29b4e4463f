"""A scene: what to simulate, as TOML or as Python objects, validated before any solve.

`read_scene` reads a file, `Scene(...)` and `scene_from_dict` take the same keys from Python. docs/scene.md lists all
keys.
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

from remodel_fenicsx.body import LoadKind, SHAPES, Shape
from remodel_fenicsx.body.reductions import AUTO, choice
from remodel_fenicsx.body.shape import Column, columns_of, columns_on_request
from remodel_fenicsx.body.wall import RoundWall
from remodel_fenicsx.fem.formulations import FORMULATIONS, NOT_LOCKING
from remodel_fenicsx.fem.kinematics import KINEMATICS
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
    STRESS_UNITS,
    Solver,
    Supports,
    Time,
    UNLOADED,
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
    fault,
    is_number,
    quoted,
    shown,
)
from remodel_fenicsx.schema.text import merged, parse_override, put, read_toml, toml_text
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


# ---------------------------------------------------------------- what a scene may say but hardly means
# Numbers in another unit than the others, told from ratios by decades.

# Decades in which a ratio may lie. Units differ by a thousand and more, choices seldom by a hundred.
NETWORK = (-2, 2)  # initial stiffness of the network over that of the matrix; the paper's bodies: 1.1 and 1.5
LOAD = (-4, 2)  # largest stress of a load over the stiffness of both; the paper's: 0.7 to 4.6. Weak loads are a choice


def doubts(
    material: Material, geometry: Shape, loads: Mapping[str, Load], end_to_end_length: float, end: float
) -> Iterator[str]:
    """Lines on what is hardly meant; none on bodies of plausible tissue."""
    unit, pascal, density = material.stress_unit, STRESS_UNITS[material.stress_unit], material.chain_density
    network = chain_stress(material, end_to_end_length)
    ratio, stiffness = network / material.lame_mu, material.lame_mu + network
    if network and (way := _beyond(ratio, NETWORK)):
        of_pascal = f": {density:g} of a scene in Pa is {density * pascal:g} in {unit}" if pascal > 1 else ""
        yield (
            f"material.chain_density = {density:g}: the network (c g(r0) r0^2 = {network:.3g} {unit}) is "
            f"{_times(ratio)} {'softer' if way < 0 else 'stiffer'} than the matrix (lame_mu = "
            f"{material.lame_mu:.4g} {unit}); the density is in 1/m^3 in every scene{of_pascal}"
        )
    for key, words, ratio, decades in geometry.proportions:
        if _beyond(ratio, decades):
            one = "all lengths are in one unit, geometry.length_unit"
            yield f"geometry.{key} = {getattr(geometry, key):g}: {words} is {ratio:.3g}; {one}"
    for name, load in loads.items():
        key, kind, value = f"loads.{name}.value", geometry.loads_on(faces_of(loads))[name], load.largest(end)
        if words := convention_doubt(name, value):
            yield f"{key}: {words}"
        stress = abs(largest_stress(kind, value, geometry) or 0.0)
        if stress and (way := _beyond(stress / stiffness, LOAD)):
            yield (
                f"{key}: a stress of {stress:.3g} {unit} at its largest, {_times(stress / stiffness)} "
                f"{'more' if way > 0 else 'less'} than the stiffness of matrix and network (lame_mu + c g(r0) r0^2 = "
                f"{stiffness:.3g} {unit}); all are in one unit, material.stress_unit"
            )


# r/L at which a wall is too soft: in three dimensions a thin one that comes to 0.98 takes 1,200 Newton iterations in
# its first step, to 0.96 100, to 0.90 23
NEAR_LOCKING = 0.9


def borne(tissue: Tissue, is_loaded: bool) -> float:
    """p / ln(r_o/r_i), radii as given, of a wall of neo-Hookean matrix and isotropic cells there; length, volume stay.

    Without chains the most that the wall bears.
    """
    chain, modulus, stretch = tissue.chain, tissue.lame_mu, math.inf  # the square of that around
    if tissue.matrix is not neo_hookean:
        return math.inf
    if chain is not None:
        length, start = NEAR_LOCKING * tissue.contour_length, tissue.end_to_end_length
        half = (3 * (length / start) ** 2 - 1) / 2
        if not chain.locks or half <= 1:
            return math.inf
        stretch = half + math.sqrt(half**2 - 1)
        modulus += tissue.network_modulus * chain.stiffness(length, tissue.contour_length) * start**2 / 3
    return float(modulus * (1 - stretch**-2) * (stretch if is_loaded else 1))


def too_soft(scene: Scene, wall: object = None) -> Iterator[str]:
    """A line where the pressure inside stretches the wall until its chains nearly lock."""
    log_of_radii = scene.geometry.log_of_radii(wall)
    if log_of_radii is None or "pressure" not in scene.loads:
        return
    stress = max(case.loads["pressure"].largest(scene.last_time) for case in scene.each_case()) / log_of_radii
    most = max(borne(one.tissue, scene.geometry.is_loaded) for one in scene.properties().values())
    if stress > most:
        unit = scene.material.stress_unit
        yield (
            f"loads.pressure.value: p r/h = {stress:.3g} {unit} at its largest; where its chains come to "
            f"{100 * NEAR_LOCKING:g} % of their length the tissue bears {most:.3g} {unit}. It is too soft: steps "
            "take minutes or fail; all are in one unit, material.stress_unit"
        )


def _doubted_keys(values: Mapping[str, object]) -> Iterator[str]:
    """Yield a line on each number of tables, or list of numbers, that may be in another convention."""
    for key, value in leaves(values):
        numbers = value if isinstance(value, (list, tuple)) else [value]
        is_of_numbers = bool(numbers) and all(isinstance(number, float) for number in numbers)
        if is_of_numbers and (words := convention_doubt(key, numbers)):
            yield f"{key}: {words}"


def chain_stress(material: Material, end_to_end_length: float) -> float:
    """c g(r0) r0^2, in stress_unit: whatever the unit of chain lengths; 0 without chains."""
    tissue = material.tissue(end_to_end_length)
    return float(tissue.repulsion_modulus * end_to_end_length**2) if tissue.chain is not None else 0.0


def largest_stress(kind: LoadKind, value: float, geometry: Shape) -> float | None:
    """Of a load: a stress itself, or a force over its area; None of an elongation."""
    if kind.dimension == FORCE and kind.area is not None:
        return value / kind.area(geometry)
    return value if kind.dimension == STRESS else None


def _beyond(ratio: float, decades: tuple[float, float]) -> int:
    """-1 or 1 where it is below or above them, else 0."""
    return (ratio > 10.0 ** decades[1]) - (ratio < 10.0 ** decades[0])


def _times(ratio: float) -> str:
    """By what it differs from one: two digits, and decades."""
    factor = max(ratio, 1 / ratio)
    return f"{float(f'{factor:.2g}'):g} times ({math.log10(factor):.1f} decades)"


PARTS_OF_MATERIAL = {"chain": CHAINS, "matrix": MATRICES, "repulsion": REPULSIONS}  # which may bring keys of [material]
FORMAT = 2  # of recorded scenes: raised where a reader of the one before would not understand them
MOST_TABLES = 200  # of one kind: each is checked against all others, and has columns of its own
SLOW_REST = 3.0  # of k a, below which a wall with turnover takes more than about 5 T for a factor of e
FORGOTTEN_AFTER = (
    1000.0  # times 1/kappa after which nothing is left of a start, of cells under a hundredth of a tension too
)


# ---------------------------------------------------------------- the scene


class Scene(Table):
    """A whole scene: all keys above the first table, and the tables.

    Its keyword arguments are the keys of a scene's file (docs/scene.md), each table a dictionary. Stresses are in
    `material.stress_unit`, lengths in `geometry.length_unit`, times in any one unit. A scene never changes:
    `with_values` gives a copy.

    Raises
    ------
    SceneError
        If a key is unknown or missing, or a value is not allowed: one line.

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
    remodel_fenicsx.schema.tables.SceneError: remodeling.kappa = -1.0: must be a finite number at least 0
    """

    _rules: ClassVar[Sequence[Callable[[Scene], Faults]]] = ()  # those of `scene.rules`, in their order

    format: int = Field(default=FORMAT, ge=1, le=FORMAT)
    """Number of the format of scenes. A scene as run has it; version 0.1.0 wrote none."""
    name: str = Field(
        default="scene",
        pattern=r"^\w(?:[\w .+-]{0,98}[\w+-])?$",
        json_schema_extra={
            "allowed": "a file name: letters, digits, spaces and . + - _, at most 100, a letter or digit first"
        },
    )
    """Name of the scene and of its results folder. Default: the name of the file without `.toml`."""
    preset: Annotated[str | None, OneOf(presets.PRESETS)] = None
    """A published model whose values hold where the scene says nothing, table by table (see the presets below)."""
    profile: Annotated[str | None, OneOf(presets.PROFILES)] = None
    """Speed or accuracy: settings of mesh, kinematics and steps (docs/speed_and_accuracy.md)."""
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
    remodeling: Annotated[SerializeAsAny[Remodeling], KeysOfParts({"law": LAWS}, tables=REMODELS)] = Remodeling()
    time: Time
    solver: Solver = Solver()
    output: Output = Output()

    @model_validator(mode="wrap")
    @classmethod
    def _on_its_preset(cls, values: object, handler: ModelWrapValidatorHandler[Scene]) -> Scene:
        """The scene's keys over those of profile, preset and shape; numbers in place of values with units."""
        if not isinstance(values, dict):
            return handler(values)
        own = _with_measured_cells(_in_present_format(_plain(values)))
        for name in ("regions", "loads", "cases", "supports"):
            if isinstance(found := own.get(name), dict | list | tuple) and len(found) > MOST_TABLES:
                raise fault(f"has {len(found)} tables; at most {MOST_TABLES} are allowed", name, None)
        presets.check_exclusive(own)
        preset, profile = own.get("preset"), own.get("profile")
        if preset is not None:
            _check_name("preset", preset, presets.PRESETS)
        shape = _known_shape(own.get("geometry", {}))
        _check_load_names(shape, own.get("loads"))
        base = SHAPES[shape].defaults_of(own)
        if preset is None:
            base = merged(base, presets.default_method(own))
        else:
            if shape not in presets.PRESETS[preset]:
                known = ", ".join(map(repr, presets.PRESETS[preset]))
                raise fault(f"the preset {preset!r} has the shapes {known}", "geometry.shape", shape)
            base = merged(base, presets.PRESETS[preset][shape])
        presets.without_coupling(base, own)

        def made(settings: Mapping[str, object]) -> Scene:
            values = merged(merged(base, presets.nested(settings)), own)
            if large := [item for item in leaves(values) if is_number(item[1]) and abs(item[1]) > LARGEST_NUMBER]:
                raise fault(NUMBER_TOO_LARGE, *large[0])
            with scene_units(_units(values, SHAPES[shape])):
                return handler(_with_numbers_of_loads(values, SHAPES[shape]))

        if profile is None:
            return made({})
        _check_name("profile", profile, presets.PROFILES)
        return _with_profile(profile, made)

    def _faults(self) -> Faults:
        """What its tables do not bear of each other, once numbers of experiments are those of the model."""
        whole = presets.with_own_numbers(self, Scene.whole)
        over = partial(Region.over, others=whole.whole())
        regions = {name: presets.with_own_numbers(region, over) for name, region in self.regions.items()}
        self.__dict__ |= {"material": whole.material, "remodeling": whole.remodeling, "regions": regions}
        for rule in self._rules:
            yield from rule(self)

    @property
    def _stiffness_ratio(self) -> float:
        """Largest lambda/mu of its regions."""
        materials = [one.material for one in self.properties().values()]
        return max(material.lame_lambda / material.lame_mu for material in materials)

    @property
    def formulation(self) -> str:
        """That of `mesh.formulation`, or the one that "auto" takes."""
        if self.mesh.formulation != AUTO:
            return self.mesh.formulation
        return "displacement" if not self._bulk_is_stiff or self.needs_all_points() else NOT_LOCKING

    @property
    def _bulk_is_stiff(self) -> bool:
        return self._stiffness_ratio > FORMULATIONS[NOT_LOCKING].pays_above(self.mesh.element, self.mesh.degree)

    def needs_all_points(self) -> str:
        """What keeps "auto" from the formulation that does not lock, in words; nothing where nothing does."""
        if COUPLINGS[self.remodeling.coupling].solves_cells:
            return f"remodeling.coupling = {self.remodeling.coupling!r}"
        if not self.natural.is_of_the_mesh:
            return "[natural]"
        if self.remodeling.turnover.grows:
            return "remodeling.turnover.volume above 0"
        if not self.material.tells_volume_apart:
            return f"material.matrix = {self.material.matrix!r}"
        return "a body of one F" if KINEMATICS[choice(self).name].homogeneous else ""

    def formulation_in_words(self) -> str:
        """What "auto" takes, and why."""
        needs = self.needs_all_points() if self._bulk_is_stiff else ""
        ratio = f"lambda/mu = {self._stiffness_ratio:.4g}"
        return f"formulation {self.formulation!r}: {ratio}{f', but {needs} needs it' if needs else ''}"

    @property
    def end_of_ramps(self) -> float:
        """The time from which on no load changes; 0 without loads."""
        return max((load.ramp[-1][0] for load in self.loads.values()), default=0.0)

    @property
    def hold_before_change(self) -> tuple[float, float] | None:
        """The last hold, from and to, where all rests in it before collagen takes room; None otherwise."""
        return self.last_hold if self.remodeling.turnover.starts_at_rest else None

    @property
    def last_hold(self) -> tuple[float, float] | None:
        """When loads stay for the last time before they change again: from and to; None where they never do."""
        corners = sorted({time for load in self.loads.values() for time, _ in load.ramp})
        found, held = None, None
        for start, end in itertools.pairwise(corners):
            if all(load.factor(start) == load.factor(end) for load in self.loads.values()):
                held = start, end
            else:
                found = held
        return found

    @property
    def last_time(self) -> float:
        """The time of the last row: where the equilibrium is asked for, one at which nothing is left of the start."""
        if not self.time.is_equilibrium:
            return float(self.time.end)
        rates = [properties.kappa for properties in self.properties().values()]
        rates += [1 / self.remodeling.turnover.time] if self.remodeling.turnover.time else []
        return self.end_of_ramps + FORGOTTEN_AFTER / min(rates)

    def each_case(self) -> list[Scene]:
        """Of each load case a scene with its loads alone; where there are no cases, the scene itself."""
        found = []
        for case in self.cases:
            loads = dict(self.loads)
            for name in {*case.loads} & {*loads}:
                loads[name] = loads[name].model_copy(update={"value": loads[name].value * case.loads[name]})
            found.append(self.model_copy(update={"loads": loads, "cases": ()}))
        return found or [self]

    def whole(self) -> Properties:
        """What holds where no region says otherwise."""
        return Properties(self.material, self.cells, self.remodeling.kappa)

    def properties(self) -> dict[str, Properties]:
        """What holds in each region by its name, and under "" what holds beside them, where there may be anything."""
        body = self.whole()
        found = {"": body} | {name: region.over(body) for name, region in self.regions.items()}
        if self.regions and isinstance(self.geometry, RoundWall):
            del found[""]
        has_chains = any(one.material.chain_density for one in found.values())
        for name, one in found.items():
            stays = has_chains and not one.material.chain_density  # cells that hold no collagen
            kappa = 0.0 if stays else self.remodeling.speed(one.kappa, one.material.temperature)
            found[name] = one._replace(kappa=kappa)
        return found

    @property
    def has_random_cells(self) -> bool:
        """Whether cells are drawn anywhere."""
        return any(properties.cells.initial == "random" for properties in self.properties().values())

    @property
    def jumps_by_rank(self) -> bool:
        """Whether cells whose lengths differ from point to point go from rank to rank, under a law of lengths."""
        return LAWS[self.remodeling.law].is_ranked and (self.has_random_cells or bool(self.measured_cells))

    @property
    def is_as_run(self) -> bool:
        """Whether it names its format, as scenes in the folders of runs do."""
        return "format" in self.model_fields_set

    @property
    def measured_cells(self) -> dict[str, Cells]:
        """Cells that a file gives, by region, "" for what holds beside them."""
        found = {name: properties.cells for name, properties in self.properties().items()}
        return {name: cells for name, cells in found.items() if cells.initial == MEASURED_CELLS}

    @property
    def column_names(self) -> list[str]:
        """Of all that a history of it may have; one is there twice where a region's name makes it."""
        always = columns_of(self.geometry, regions=self.regions)
        return [*columns_on_request(self.geometry, self.regions, self.held_faces), *(column.name for column in always)]

    def columns(self, more: Iterable[str] = ()) -> tuple[Column, ...]:
        """Of its history, in the order of the file; with `more` of those on request."""
        requested = [*self.output.columns, *more]
        return columns_of(self.geometry, requested, self.loads, self.regions, len(self.cases), self.held_faces)

    @property
    def held_faces(self) -> list[str]:
        """Faces with supports that have columns of their forces."""
        return self.geometry.held_faces(self.supports.faces)

    def stops(self) -> list[float]:
        """Times at which a step ends, however long steps are: corners of ramps, output.times and the end."""
        end = self.last_time
        times = {time for load in self.loads.values() for time, _ in load.ramp if 0 < time < end}
        growth = {self.remodeling.turnover.start} - {0.0, math.inf}
        return sorted({*times, *growth, *self.output.times, end})

    @property
    def load_kinds(self) -> dict[str, LoadKind]:
        """All loads that it can have, by name."""
        return self.geometry.loads_on(faces_of(self.loads))

    @property
    def lacking_fields(self) -> dict[str, str]:
        """Fields that the body has not, each with the reason."""
        turnover, same = self.remodeling.turnover, self.natural.is_of_the_mesh
        stress_free = "the mesh is free of stress ([natural]): 'fibre_angle' is that of the unloaded body"
        reasons: list[tuple[bool, Sequence[str], str]] = [
            (not self.regions, (REGION,), "the scene has no regions"),
            (same, (UNLOADED,), stress_free),
            (same and not turnover.grows, (NATURAL_GRADIENT,), stress_free),
            (not turnover.is_on, TURNED_OVER, "it changes only with remodeling.turnover, which is not set"),
            (not turnover.grows, (GROWTH,), "tissue grows only with a remodeling.turnover.volume above 0"),
        ]
        return {name: reason for lacks, names, reason in reasons if lacks for name in names}

    @property
    def has_free_length(self) -> bool:
        """Whether the body's length is an unknown."""
        kinds, shape = self.load_kinds, self.geometry
        return (self.supports.ends in shape.ends and shape.ends[self.supports.ends].frees_length) or any(
            kinds[name].frees_length for name in self.loads
        )

    def summary(self) -> str:
        """Stiffness of network and matrix and the largest loads, in one unit and on one line."""
        loads = {}
        for name in self.loads:
            largest = max((case.loads[name].largest(self.last_time) for case in self.each_case()), key=abs)
            stress = largest_stress(self.load_kinds[name], largest, self.geometry)
            if stress is not None:
                is_force = self.load_kinds[name].dimension == FORCE
                loads[f"largest {name}{' over its area' if is_force else ''}"] = stress
        found = self.properties()
        parts = [_words(name) + properties.material.summary(loads) for name, properties in found.items()]
        turnover = self.remodeling.turnover
        if turnover.is_on:
            parts.append(f"turnover with rates = {turnover.rates!r} and volume = {turnover.volume:g}")
        return "; ".join(parts)

    def warnings(self, wall: object = None) -> list[str]:
        """What is allowed but hardly meant, each on one line; of a wall on a mesh with the areas of its faces."""
        found: dict[str, None] = {}
        properties = self.properties()
        if self.geometry.fills(self.regions):
            properties.pop("", None)  # it holds nowhere
        for name, (material, cells, _) in properties.items():
            for case in self.each_case():
                lines = doubts(material, self.geometry, case.loads, cells.end_to_end_length, self.last_time)
                found |= dict.fromkeys(line if line.startswith("geometry.") else _words(name) + line for line in lines)
        found |= {} if found else dict.fromkeys(too_soft(self, wall))  # units in doubt say why
        found |= dict.fromkeys(self.geometry.unresolved(self.mesh, self.output.columns))
        tables = self.model_dump(exclude={"loads", "cases"})
        found |= dict.fromkeys(_doubted_keys(tables))
        return [*found, *self.turned_away(), *self._of_turnover(), *self.remodeling.warnings()]

    def turned_away(self) -> list[str]:
        """Whether rows leave the loaded shape that is given, for its cells turn; with the way out."""
        turns = LAWS[self.remodeling.law].remodels and any(one.kappa for one in self.properties().values())
        if not (self.geometry.is_loaded and turns and self.natural.cells == AS_GIVEN):
            return []
        way = "let all loads act in the first step to have a row with it"
        if isinstance(self.geometry, RoundWall):
            way = (
                "natural.cells = 'equilibrium' with time.end = 'equilibrium' takes it for that of cells that have come "
                f"to rest; or {way}"
            )
        return [
            "geometry.is = 'loaded': the given shape is that under all loads with the cells of t = 0. They turn while "
            f"loads rise and afterwards, so rows have another one; {way}"
        ]

    def _of_turnover(self) -> Iterator[str]:
        """Gains that do not rest, or slowly; explicit steps longer than its time, in which content overshoots."""
        turnover, step = self.remodeling.turnover, self.time.step
        if turnover.time is None:
            return
        for name, properties in self.properties().items():
            power, slowly = turnover.rule.rest(properties.tissue)
            says = f"{_words(name)}remodeling.turnover.gain = {turnover.gain:g}"
            if power <= 2:
                least = 2 * turnover.gain / power if turnover.gain else math.inf
                yield f"{says}: does not come to rest with this deposition_stretch; rest needs more than {least:.3g}"
            elif power < SLOW_REST:
                words = "by a factor of e where collagen alone bears the loads, and sooner with a matrix"
                yield f"{says}: comes to rest slowly, in a time of {slowly:.3g} {words}"
        chosen = self.time.is_equilibrium or self.time.tolerance is not None
        if not chosen and not COUPLINGS[self.remodeling.coupling].solves_cells and step > turnover.time:
            yield (
                f"time.step = {step:g} is longer than remodeling.turnover.time = {turnover.time:g}: content and "
                "natural length overshoot in each step; set a shorter time.step or time.tolerance"
            )

    def _values(self) -> dict[str, Any]:
        """All of them, from which the same scene can be made."""
        return self.model_dump(exclude_none=True, exclude=None if self.is_as_run else {"format"})

    def __reduce__(self) -> tuple[object, ...]:  # for other processes: keys of parts are in no class that they find
        return scene_from_dict, (self._values(),)

    def with_values(self, changes: Mapping[str, object]) -> Scene:
        """A validated copy with other values by dotted key: ``scene.with_values({"loads.pressure.value": 2.4})``.

        Every value of the copy is its own: changing `preset` alone changes nothing.

        Raises
        ------
        SceneError
            One line: key, value, what is allowed.
        """
        values = self._values()
        for key, value in changes.items():
            if not isinstance(key, str):
                raise SceneError(f"{shown(key)} = {shown(value)}: a key must be text, as in 'cells.seed'")
            put(values, key, value)
        _follow(values, changes, is_whole=True)
        return type(self)(**values)

    def to_toml(self, header: str = "") -> str:
        """The scene with all its values as TOML, each under its description; `read_scene` gives the same scene back.

        Parameters
        ----------
        header
            Lines for the top, each becomes a comment.
        """
        return toml_text(self, header)


# ---------------------------------------------------------------- values as they were read


def _in_present_format(values: Mapping[str, object]) -> dict[str, object]:
    """The values with the present format number; a newer one is refused before the keys that are new in it are."""
    written = values.get("format")
    if not isinstance(written, int) or isinstance(written, bool) or written < 1:
        return dict(values)  # none, or a fault that the field's own error describes
    if written > FORMAT:
        rule = f"written by a newer version of remodel_fenicsx; this one reads formats up to {FORMAT}"
        raise fault(rule, "format", written)
    values = {**values, "format": FORMAT}
    turnover = presets.said(values, "remodeling", "turnover")
    if isinstance(turnover, Mapping) and "time" in turnover:  # as version 0.3.0 ran it, where it does not say
        values = merged({"remodeling": {"turnover": {"rates": "tension", "volume": 0.0}}}, values)
    return values


def _with_measured_cells(values: dict[str, object]) -> dict[str, Any]:
    """cells.initial = 'fibres' wherever a file of fibres is given, in the whole body and in regions."""
    for name, part in presets.parts_of(values):
        fibres, initial = (presets.said(part, "cells", key) for key in ("fibres", "initial"))
        if fibres is not None and initial not in (None, MEASURED_CELLS):
            place = f"{presets.place_of(name)}cells"
            raise fault(
                f"{place}.initial = {shown(initial)} is there too; one of them gives the cells",
                f"{place}.fibres",
                fibres,
            )
        if fibres is not None:
            values = presets.with_part(values, name, {"cells": {"initial": MEASURED_CELLS}})
    return values


def _beside(values: dict[str, object], folder: Path) -> dict[str, object]:
    """The keys of a file in this folder, with the places of the files that they name."""
    for name, part in presets.parts_of(values):
        if isinstance(file := presets.said(part, "cells", "fibres"), str):
            values = presets.with_part(values, name, {"cells": {"fibres": str(folder.absolute() / file)}})
    kind = presets.said(values, "geometry", "shape")
    if isinstance(kind, str) and kind in SHAPES:
        values = {**values, "geometry": SHAPES[kind].with_files_from(values["geometry"], folder)}
    return values


def _words(region: str) -> str:
    return f"{region}: " if region else ""


def _follow(values: dict[str, Any], changed: Mapping[str, object], is_whole: bool) -> None:
    """Take out what no longer fits to changed values; of a scene that has all values, a choice may be the run's own."""
    times, end = presets.said(values, "output", "times"), presets.said(values, "time", "end")
    if "time.end" in changed and "output.times" not in changed and is_number(end) and isinstance(times, list | tuple):
        values["output"]["times"] = [time for time in times if not is_number(time) or time <= end]
        if (dropped := len(times) - len(values["output"]["times"])) and is_first_rank():
            log.warning("output.times: %d after time.end = %g dropped", dropped, end)
    if is_whole:
        presets.without_replaced(values, changed)


def _check_name(key: str, name: object, names: Iterable[str]) -> None:
    if not isinstance(name, str) or name not in names:
        raise fault("allowed are " + ", ".join(map(repr, names)), key, name)


def _known_shape(geometry: object) -> str:
    """The shape that is asked for. Without it nothing else can be judged: preset, loads and units depend on it."""
    if not isinstance(geometry, Mapping):
        raise fault("must be a table", "geometry", geometry)
    if "shape" not in geometry:
        raise fault("missing; allowed are " + ", ".join(map(repr, SHAPES)), "geometry.shape", None)
    _check_name("geometry.shape", geometry["shape"], SHAPES)
    return str(geometry["shape"])


def _units(values: Mapping[str, object], shape: type[Shape]) -> dict[str, str | None]:
    """The units that a scene chooses, by their keys."""
    units: dict[str, str | None] = {}
    for key, kind in ((STRESS_UNIT, Material), (LENGTH_UNIT, shape)):
        table, name = key.split(".")
        field, chosen = kind.model_fields[name], presets.said(values, table, name)
        if chosen not in (*choices(field), None):
            raise fault(allowed(field), key, chosen)
        units[key] = field.default if chosen is None else chosen
    return units


def _with_numbers_of_loads(values: Mapping[str, object], shape: type[Shape]) -> dict[str, object]:
    """The values with numbers in place of units of loads, whose dimensions the shape knows."""
    loads = values.get("loads")
    if not isinstance(loads, Mapping):
        return dict(values)
    found = dict(loads)
    for name, kind in shape.loads_on(faces_of(loads)).items():
        load = loads.get(name)
        if isinstance(load, Mapping) and "value" in load and kind.dimension is not None:
            found[name] = {**load, "value": kind.dimension.number(load["value"], f"loads.{quoted(name)}.value")}
    return {**values, "loads": found}


def _check_load_names(shape: str, loads: object) -> None:
    """A load that the shape does not have, before anything is said about what is missing in it."""
    kind = SHAPES[shape]
    names = kind.loads
    for name, load in loads.items() if isinstance(loads, Mapping) else ():
        if kind.supported_faces is None and isinstance(load, Mapping) and ("kind" in load or "face" in load):
            _check_load_on_face(kind, str(name), load)
        elif name not in names:
            key, listed = f"loads.{quoted(str(name))}", ", ".join(f"loads.{known}" for known in names)
            raise fault(f"a {shape} has no such load; allowed: {listed}", key, load)


def _check_load_on_face(shape: type[Shape], name: str, load: Mapping[str, object]) -> None:
    key = f"loads.{quoted(name)}"
    if not isinstance(load.get("face"), str):
        raise fault("missing; a load of this kind needs the name of a face", f"{key}.face", load.get("face"))
    if name in shape.loads:
        raise fault(
            f"{shape.loads[name].meaning}; give a load on another face another name", f"{key}.face", load["face"]
        )
    if not re.fullmatch(NAME, name) or name in {column.name for column in columns_of(shape)}:
        raise fault(
            "its name must be a letter, then letters, digits and _, at most 40 in all, and not the name of a column",
            key,
            None,
        )


def _plain(value: object) -> Any:
    """Tables as dicts of the values that were set, so that they merge as the same keys in TOML do."""
    if isinstance(value, BaseModel):
        kind = {"shape": value.name} if isinstance(value, Shape) else {}
        return kind | value.model_dump(exclude_unset=True, exclude_none=True)
    return {name: _plain(entry) for name, entry in value.items()} if isinstance(value, Mapping) else value


# ---------------------------------------------------------------- reading


def scene_from_dict(values: Mapping[str, Any]) -> Scene:
    """A scene from nested dicts with the keys of the TOML file."""
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        raise SceneError(f"scene = {shown(values)}: must be a table")
    return Scene(**values)


def preset_scene(preset: str, shape: str) -> Scene:
    """The scene of a preset on one of its shapes, named after the shape.

    Parameters
    ----------
    preset
        Its name: "kuhl-holzapfel-2007" (the paper), "consistent" or "sun-2002".
    shape
        "cube", "tendon" or "tube".

    Returns
    -------
    Scene
        With all values of the preset; it has a unit of stress and of length where the preset has.

    Raises
    ------
    SceneError
        If there is no such preset or shape, or if the preset leaves something for a scene to choose.

    Examples
    --------
    >>> from remodel_fenicsx import preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "tube")  # the artery of Fig. 7
    >>> scene.name, scene.geometry.outer_radius, scene.loads["pressure"].value
    ('tube', 3.0, 4.8)
    >>> preset_scene("a", "tube")
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: preset = 'a': allowed are 'kuhl-holzapfel-2007', 'consistent', 'sun-2002'
    """
    return scene_from_dict({"name": shape, "preset": preset, "geometry": {"shape": shape}})


def read_scene(path: str | os.PathLike[str], overrides: Iterable[str] = (), profile: str | None = None) -> Scene:
    """A scene from a TOML file.

    Parameters
    ----------
    path
        The file, UTF-8.
    overrides
        "KEY=VALUE" with a dotted key and a TOML value (a bare word is a string): laid over the file's keys, before the
        preset is.
    profile
        Name of a profile whose settings are laid over the file's keys, under those of `overrides`.

    Returns
    -------
    Scene
        Checked, with the preset's values where the file has none.

    Raises
    ------
    SceneError
        One line: file and line, or key, value and what is allowed.

    Examples
    --------
    >>> from pathlib import Path
    >>> from remodel_fenicsx import preset_scene, read_scene
    >>> written = Path("cube.toml").write_text(preset_scene("kuhl-holzapfel-2007", "cube").to_toml())
    >>> scene = read_scene("cube.toml", ["time.end=5", "remodeling.kappa=0.1"])
    >>> scene.time.end, scene.remodeling.kappa
    (5.0, 0.1)
    """
    read = read_toml(Path(path))
    name = re.sub(r"\.toml$", "", Path(path).name, flags=re.IGNORECASE)  # what follows another dot is part of it
    read.setdefault("name", re.sub(r"^[^\w]+|[^\w+-]+$|[^\w .+-]", "", name)[:100].rstrip(" .") or "scene")
    changes = dict(parse_override(override) for override in overrides)
    chosen = set(CHOSEN_BY_RUNS) - set(changes) if changes and "format" in read else set()

    def made(settings: Mapping[str, object]) -> Scene:
        values = merged(read, presets.nested(settings))
        for key, value in changes.items():
            put(values, key, value)
        _follow(values, changes, is_whole="format" in values)
        return _chosen_anew(_beside(values, Path(path).parent), chosen)

    if profile is None:
        return made({})
    return _with_profile(profile, lambda settings: made({"profile": profile, **settings}))


CHOSEN_BY_RUNS = ("model.kinematics", "mesh.formulation")


def _chosen_anew(values: dict[str, object], chosen: set[str]) -> Scene:
    """The scene, with "auto" in place of what a run had chosen and what does not go with the rest any more."""
    try:
        return scene_from_dict(values)
    except SceneError as error:
        key = str(error).partition(" ")[0]
        if key not in chosen:
            raise
        scene = _chosen_anew(merged(values, presets.nested({key: AUTO})), chosen - {key})
        if is_first_rank():
            log.warning("%s; %s takes its place", error, shown(AUTO))
        return scene


def _with_profile(name: str, made: Callable[[Mapping[str, object]], Scene]) -> Scene:
    """The scene that is made with a profile's settings: they depend on its cells and loads."""
    scene = made(presets.PROFILES[name].values if name in presets.PROFILES else {})  # refuses a name that is none
    settings = presets.profile_for(name, scene).settings(scene)
    return scene if settings == presets.PROFILES[name].values else made(settings)


# ---------------------------------------------------------------- where a run goes on

# what decides no number of the steps done, or only how they were solved
# (of a file only its contents, geometry.sha256, count)
FREE = ("format", "name", "preset", "profile", "output", "solver", "loads", "time.end", "geometry.file")
SAME_LOAD = 1e-12  # relative difference of two loads that are the same


def check_continuation(old: Scene, new: Scene, time: float) -> None:
    """Check that the physics of a scene is that of the run so far, until `time`."""
    rule = f"a resumed run may change time.end, output, solver, and loads after its checkpoint at {time:g}"
    before, now = (dict(leaves(scene.model_dump(mode="json"), FREE)) for scene in (old, new))
    for key in [*before, *(key for key in now if key not in before)]:
        if before.get(key) != now.get(key):
            was = shown(before[key]) if key in before else "not there"
            raise SceneError(f"{key} = {shown(now.get(key))}: was {was}; {rule}")
    for name in {**old.load_kinds, **new.load_kinds}:
        first, second = old.loads.get(name), new.loads.get(name)
        if first and second and first.face != second.face:
            raise SceneError(f"loads.{name}.face = {shown(second.face)}: was {shown(first.face)}; {rule}")
        for moment in sorted({0.0, time, *_ramp_times(first), *_ramp_times(second)}):
            old_value, value = (0.0 if one is None else one.value * one.factor(moment) for one in (first, second))
            if moment <= time and abs(old_value - value) > SAME_LOAD * max(abs(old_value), abs(value)):
                raise SceneError(f"loads.{name} = {value:g} at time {moment:g}: was {old_value:g}; {rule}")
    if new.last_time < time:
        raise SceneError(f"time.end = {shown(new.time.end)}: must be at least {time:g}, where the checkpoint is")


def _ramp_times(load: Load | None) -> list[float]:
    return [] if load is None else [time for time, _ in load.ramp]


def leaves(value: object, free: Sequence[str] = (), key: str = "") -> Iterator[tuple[str, object]]:
    """(dotted key, value) of all values in tables and lists of tables, but those that are free."""
    if key in free or key.endswith("cells.fibres"):  # the SHA-256 beside it must stay
        return
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from leaves(inner, free, f"{key}.{name}" if key else str(name))
    elif isinstance(value, (list, tuple)) and any(isinstance(entry, Mapping) for entry in value):
        for number, inner in enumerate(value):
            yield from leaves(inner, free, f"{key}[{number}]")
    else:
        yield key, value
