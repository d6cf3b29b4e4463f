"""A scene: what to simulate, as TOML or as Python objects, validated before any solve.

`read_scene` reads a file, `Scene(...)` and `scene_from_dict` take the same keys from Python. docs/scene.md lists all
keys (`scene.reference`).
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, BeforeValidator, Field, ModelWrapValidatorHandler, SerializeAsAny, model_validator

from remodel_fenicsx.body import LoadKind, SHAPES, Shape
from remodel_fenicsx.body.reductions import AUTO, check_number, choice, objections
from remodel_fenicsx.body.shape import Column, TURNOVER_POWER, columns_of, columns_of_region, columns_on_request
from remodel_fenicsx.fem.formulations import FORMULATIONS, NOT_LOCKING
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.fem.solver_methods import SOLVER_METHODS
from remodel_fenicsx.model.chains import CHAINS
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES
from remodel_fenicsx.model.energy import MATRICES, Matrix, REPULSIONS, TURNED_OVER
from remodel_fenicsx.model.laws import LAWS, MEANS_OF_CASES
from remodel_fenicsx.scene.presets import (
    PRESETS,
    PROFILES,
    check_exclusive,
    default_method,
    nested,
    profile_for,
    with_own_numbers,
    without_replaced,
)
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
    Natural,
    Output,
    Properties,
    REGION,
    Region,
    Remodeling,
    STRESS_UNITS,
    Solver,
    Supports,
    Time,
    UNLOADED,
    faces_of,
    nearest_multiples,
    tables_of,
)
from remodel_fenicsx.schema.tables import KeysOfParts, SceneError, Table, VariantOf, allowed, fault, quoted, shown
from remodel_fenicsx.schema.toml import merged, parse_override, put, read_toml, toml_text
from remodel_fenicsx.schema.units import FORCE, LENGTH_UNIT, LENGTH_UNITS, STRESS, STRESS_UNIT, in_units


# ---------------------------------------------------------------- what a scene may say but hardly means
# What a scene may say but hardly means: numbers in another unit than the others, told from ratios by decades.

# Decades in which a ratio may lie. Units differ by a thousand and more, choices seldom by a hundred.
NETWORK = (-2, 2)  # initial stiffness of the network over that of the matrix; the paper's bodies: 1.1 and 1.5
LOAD = (-4, 2)  # largest stress of a load over the stiffness of both; the paper's: 0.7 to 4.6. Weak loads are a choice
TEMPERATURES = (250.0, 400.0)  # K: of what is neither ice nor cooked


def doubts(
    material: Material, geometry: Shape, loads: Mapping[str, Load], end_to_end_length: float, end: float
) -> list[str]:
    """Lines on what is hardly meant; none on bodies of plausible tissue."""
    network = chain_stress(material, end_to_end_length)
    found, kinds = [*_of_material(material, network), *_of_lengths(geometry)], geometry.loads_on(faces_of(loads))
    for name, load in loads.items():
        found += _of_load(name, kinds[name], load.largest(end), material, geometry, network)
    return found


def chain_stress(material: Material, end_to_end_length: float) -> float:
    """c g(r0) r0^2, in stress_unit: whatever the unit of chain lengths; 0 without chains."""
    tissue = material.tissue(end_to_end_length)
    return float(tissue.repulsion_modulus * end_to_end_length**2) if tissue.chain is not None else 0.0


def largest_stress(kind: LoadKind, value: float, geometry: Shape) -> float | None:
    """Of a load: a stress itself, or a force over its area; None of an elongation."""
    if kind.dimension == FORCE:
        return value / geometry.loaded_area
    return value if kind.dimension == STRESS else None


def _of_material(material: Material, network: float) -> Iterator[str]:
    unit, lowest, highest = material.stress_unit, *TEMPERATURES
    ratio = network / material.lame_mu
    if network and (way := _beyond(ratio, NETWORK)):
        pascal = STRESS_UNITS[unit]
        density = f": {material.chain_density:g} of a scene in Pa is {material.chain_density * pascal:g} in {unit}"
        yield (
            f"material.chain_density = {material.chain_density:g}: the network (c g(r0) r0^2 = {network:.3g} {unit}) "
            f"is {_times(ratio)} {'softer' if way < 0 else 'stiffer'} than the matrix (lame_mu = "
            f"{material.lame_mu:.4g} {unit}); the density is in 1/m^3 in every scene{density if pascal > 1 else ''}"
        )
    if not lowest <= material.temperature <= highest:
        yield f"material.temperature = {material.temperature:g}: an absolute temperature in K; 37 degC are 310.15"


def _of_lengths(geometry: Shape) -> Iterator[str]:
    for key, words, ratio, decades in geometry.proportions:
        if _beyond(ratio, decades):
            value = getattr(geometry, key)
            unit = "all lengths are in one unit, geometry.length_unit"
            yield f"geometry.{key} = {value:g}: {words} is {ratio:.3g}; {unit}"


def _of_load(
    name: str, kind: LoadKind, value: float, material: Material, geometry: Shape, network: float
) -> Iterator[str]:
    key = f"loads.{name}.value"
    if kind.doubtful is not None and abs(value) >= kind.doubtful[0]:
        yield f"{key}: {value:g} at its largest; {kind.doubtful[1]}"
    stress = largest_stress(kind, value, geometry)
    if not stress:
        return
    ratio = abs(stress) / (material.lame_mu + network)
    if way := _beyond(ratio, LOAD):
        yield (
            f"{key}: a stress of {abs(stress):.3g} {material.stress_unit} at its largest, {_times(ratio)} "
            f"{'more' if way > 0 else 'less'} than the stiffness of matrix and network (lame_mu + c g(r0) r0^2 = "
            f"{material.lame_mu + network:.3g} {material.stress_unit}); all are in one unit, material.stress_unit"
        )


def _beyond(ratio: float, decades: tuple[int, int]) -> int:
    """-1 or 1 where it is below or above them, else 0."""
    return (ratio > 10.0 ** decades[1]) - (ratio < 10.0 ** decades[0])


def _times(ratio: float) -> str:
    """By what it differs from one: two digits, and decades."""
    factor = max(ratio, 1 / ratio)
    return f"{float(f'{factor:.2g}'):g} times ({math.log10(factor):.1f} decades)"


NAME = r"[A-Za-z][A-Za-z0-9_]{0,39}"  # of a region or a further load: part of the name of a column
PARTS_OF_MATERIAL = {"chain": CHAINS, "matrix": MATRICES, "repulsion": REPULSIONS}  # which may bring keys of [material]
FORMAT = 2  # of recorded scenes: raised where a reader of the one before would not understand them
RENAMED = {"mesh.cell": "mesh.element", "loads.stretch": "loads.elongation", "solver.profile": "solver.method"}
"""Dotted key of an earlier format -> the key that has taken its place, for the error."""
SUM_OF_WEIGHTS = 1e-9  # how far from 1 the weights of load cases may sum: rounding, and 1/3 with ten digits
FORGOTTEN_AFTER = (
    1000.0  # times 1/kappa after which nothing is left of a start, of cells under a hundredth of a tension too
)


# ---------------------------------------------------------------- the scene


def _name(value: Any) -> Any:
    if not isinstance(value, str) or not re.fullmatch(r"\w(?:[\w .+-]{0,98}[\w+-])?", value):
        raise fault("must be a file name: letters, digits, spaces and . + - _, at most 100, a letter or digit first")
    return value


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

    renamed: ClassVar[Mapping[str, str]] = RENAMED

    format: int = Field(
        default=FORMAT,
        ge=1,
        le=FORMAT,
        description="Number of the format of scenes. A scene as run has it; version 0.1.0 wrote none.",
    )
    name: Annotated[str, BeforeValidator(_name)] = Field(
        default="scene",
        description=("Name of the scene and of its results folder. Default: the name of the file without `.toml`."),
        json_schema_extra={"allowed": "a file name without a path"},
    )
    preset: str | None = Field(
        default=None,
        description=(
            "A published model whose values hold where the scene says nothing, table by table (see the "
            "presets below)."
        ),
        json_schema_extra={"allowed": "one of " + ", ".join(map(repr, PRESETS))},
    )
    profile: str | None = Field(
        default=None,
        description=(
            "Chooses speed or accuracy: settings of mesh, kinematics and steps "
            "(docs/speed_and_accuracy.md has their errors and costs). They replace those of the preset,"
            " and the scene's own keys replace them. `--profile` on the command line replaces all of "
            "these."
        ),
        json_schema_extra={"allowed": "one of " + ", ".join(map(repr, PROFILES))},
    )
    geometry: Annotated[SerializeAsAny[Shape], VariantOf(SHAPES, "shape")]
    mesh: Mesh = Mesh()
    model: Model = Model()
    material: Annotated[SerializeAsAny[Material], KeysOfParts(PARTS_OF_MATERIAL)] = Material()
    cells: Cells = Cells()
    supports: Supports = Supports()
    natural: Natural = Natural()
    regions: dict[str, Region] = {}
    loads: dict[str, Load] = {}
    cases: Annotated[tuple[LoadCase, ...], tables_of("cases")] = Field(
        default=(),
        description="Load cases of a cycle, a table `[[cases]]` each. Without them the loads act all the time.",
        json_schema_extra={"allowed": "a list of tables"},
    )
    remodeling: Annotated[SerializeAsAny[Remodeling], KeysOfParts({"law": LAWS})] = Remodeling()
    time: Time
    solver: Solver = Solver()
    output: Output = Output()

    @model_validator(mode="wrap")
    @classmethod
    def _on_its_preset(cls, values: Any, handler: ModelWrapValidatorHandler[Scene]) -> Scene:
        """The scene's keys over those of profile, preset and shape; numbers in place of values with units."""
        if not isinstance(values, dict):
            return handler(values)
        own = _with_measured_cells(_in_present_format(_plain(values)))
        check_exclusive(own)
        preset, profile = own.get("preset"), own.get("profile")
        if preset is not None:
            _check_name("preset", preset, PRESETS)
        shape = _known_shape(own.get("geometry", {}))
        _check_load_names(shape, own.get("loads"))
        base = SHAPES[shape].defaults_of(own)
        if preset is None:
            base = merged(base, default_method(own))
        else:
            if shape not in PRESETS[preset]:
                known = ", ".join(map(repr, PRESETS[preset]))
                raise fault(f"the preset {preset!r} has the shapes {known}", "geometry.shape", shape)
            base = merged(base, PRESETS[preset][shape])

        def made(settings: Mapping[str, Any]) -> Scene:
            values = merged(merged(base, nested(settings)), own)
            return handler(with_own_numbers(_in_own_units(values, SHAPES[shape])))

        if profile is None:
            return made({})
        _check_name("profile", profile, PROFILES)
        return _with_profile(profile, made)

    @model_validator(mode="after")
    def _tables_fit_together(self) -> Scene:
        cells, material, geometry = self.cells, self.material, self.geometry
        self._check_regions()
        ends = self.supports.ends
        for key, name, names in (
            ("cells.axes", cells.axes, geometry.axis_kinds),
            ("supports.ends", ends, geometry.ends),
        ):
            if name not in names:
                raise fault(f"allowed for shape {geometry.name!r} is {', '.join(map(repr, names))}", key, name)
        for name, support in self.supports.faces.items():
            if not geometry.holds_faces and name not in geometry.surrounded_faces:
                springs = " or ".join(f"supports.{face} of kind 'elastic'" for face in geometry.surrounded_faces)
                rule = f"a {geometry.name} is held by supports.ends" + (
                    f"; allowed beside is {springs}" if springs else ""
                )
                raise fault(rule, f"supports.{quoted(name)}", None)
            if not geometry.holds_faces and support.kind != "elastic":
                raise fault("allowed here is 'elastic'", f"supports.{quoted(name)}.kind", support.kind)
        formulation = self.mesh.formulation
        if formulation != AUTO and FORMULATIONS[formulation].takes_parts and not self._tells_volume_apart:
            rule = (
                f"needs a material.matrix with a known volumetric part, made as a Matrix; {material.matrix!r} has none"
            )
            raise fault(rule, "mesh.formulation", formulation)
        missing = self.missing_for_implicit() if self.remodeling.coupling == "implicit" else None
        if missing is not None:
            raise fault(f"needs {missing}", "remodeling.coupling", "implicit")
        if self.time.is_equilibrium and (missing := self._missing_for_equilibrium()) is not None:
            raise fault(missing, "time.end", self.time.end)
        geometry.check_size(self.mesh)
        for name, load in self.loads.items():
            self._check_load(name, load)
        self._check_output_times()
        for field, reason in self.lacking_fields.items():
            if field in _listed(self.output.fields):
                raise fault(reason, "output.fields", field)
        self._check_columns()
        self._check_length()
        self._check_natural()
        self._check_loaded_shape()
        self._check_cases()
        if self.model.kinematics != AUTO and (reasons := objections(self, self.model.kinematics)):
            raise fault("; ".join(reasons), "model.kinematics", self.model.kinematics)
        if geometry.refines:
            check_number(self)
        return self

    @property
    def _stiffness_ratio(self) -> float:
        """Largest lambda/mu of its regions."""
        materials = [one.material for one in self.properties().values()]
        return max(material.lame_lambda / material.lame_mu for material in materials)

    @property
    def _tells_volume_apart(self) -> bool:
        return isinstance(MATRICES[self.material.matrix], Matrix)

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
        if self.remodeling.coupling == "implicit":
            return "remodeling.coupling = 'implicit'"
        if not self.natural.is_of_the_mesh:
            return "[natural]"
        if not self._tells_volume_apart:
            return f"material.matrix = {self.material.matrix!r}"
        return "a body of one F" if KINEMATICS[choice(self).name].homogeneous else ""

    def formulation_in_words(self) -> str:
        """What "auto" takes, and why."""
        needs = self.needs_all_points() if self._bulk_is_stiff else ""
        ratio = f"lambda/mu = {self._stiffness_ratio:.4g}"
        return f"formulation {self.formulation!r}: {ratio}{f', but {needs} needs it' if needs else ''}"

    def missing_for_implicit(self) -> str | None:
        """What the scene lacks for the coupling "implicit"; None where it lacks nothing."""
        from remodel_fenicsx.model.implicit import refused  # six modules that most runs need not load

        material, remodeling = self.material, self.remodeling
        if self.formulation != "displacement":
            return "mesh.formulation = 'displacement': in the others the stress at a point depends on its whole element"
        if not material.chain_density:
            return "chains: material.chain_density above 0"
        if self.cases[1:]:
            return "a scene without [[cases]]: it finds the cells for the stress of one load case"
        if remodeling.has_set_point:
            return "remodeling.exponent = 2 and remodeling.threshold = 0: derivatives of other targets are not known"
        parts = LAWS[remodeling.law], DRIVERS[remodeling.driver], FRAMES[remodeling.frame]
        return refused(*parts, MATRICES[material.matrix], REPULSIONS[material.repulsion])

    @property
    def has_exact_coupling(self) -> bool:
        """Whether the coupling "implicit" leaves no error in time: steps of any length lead to the same cells.

        So it is where the cells depend on the time and the tension that they have then alone. From random cells some
        points have no such state and are held (docs/couplings.md).
        """
        depends_on_now = LAWS[self.remodeling.law].of_absolute_time and not self.has_random_cells
        return depends_on_now and self.missing_for_implicit() is None

    def _missing_for_equilibrium(self) -> str | None:
        """Why there is no equilibrium of the cells, or one that depends on the way there; None where neither is so."""
        law, laws = self.remodeling.law, ", ".join(repr(name) for name, law in LAWS.items() if law.has_limit)
        if not LAWS[law].has_limit:
            return f"remodeling.law = {law!r} has no limit that is the same on every path; allowed are the laws {laws}"
        if self.remodeling.threshold:
            return "remodeling.threshold is above 0: where cells rest depends on the path; set time.end to a late time"
        if self.remodeling.has_set_point:
            return "remodeling.exponent is not 2: derivatives of its target are not known; set time.end to a late time"
        for name, properties in self.properties().items():
            if properties.kappa == 0:
                return f"{in_region(name)}remodeling.kappa = 0: the cells never change"
        return None if self.material.chain_density else "needs chains: material.chain_density above 0"

    @property
    def end_of_ramps(self) -> float:
        """The time from which on no load changes; 0 without loads."""
        return max((load.ramp[-1][0] for load in self.loads.values()), default=0.0)

    @property
    def last_time(self) -> float:
        """The time of the last row: where the equilibrium is asked for, one at which nothing is left of the start."""
        if not self.time.is_equilibrium:
            return float(self.time.end)
        rates = [properties.kappa for properties in self.properties().values()]
        rates += [1 / self.remodeling.turnover.time] if self.remodeling.turnover.time else []
        return self.end_of_ramps + FORGOTTEN_AFTER / min(rates)

    def _check_regions(self) -> None:
        shape, columns = self.geometry, {column.name for column in columns_of(self.geometry)}
        columns |= set(columns_on_request(shape))
        for name in self.regions:
            key = f"regions.{quoted(name)}"
            if not shape.has_regions:
                able = ", ".join(repr(other) for other, kind in SHAPES.items() if kind.has_regions)
                raise fault(f"a {shape.name} has no regions; shapes with regions: {able}", key, None)
            if not re.fullmatch(NAME, name):
                raise fault(
                    "the name of a region must be a letter, then letters, digits and _, at most 40 in all", key, None
                )
            if taken := columns.intersection(column.name for column in columns_of_region(name)):
                raise fault(f"the column {min(taken)!r} has another meaning; choose another name", key, None)
        shape.check_regions(self.regions, self.mesh)
        for name, properties in self.properties().items():
            self._check_properties(in_region(name), properties)

    def _check_properties(self, region: str, properties: Properties) -> None:
        """What the keys of a region say together with those of the whole body."""
        material, cells = properties.material, properties.cells
        if CHAINS[material.chain].locks and cells.end_to_end_length >= material.contour_length:
            rule = f"must be smaller than {region}material.contour_length = {shown(material.contour_length)}"
            raise fault(rule, f"{region}cells.end_to_end_length", cells.end_to_end_length)
        if (length := cells.fault_of_length()) is not None:
            raise fault(length, f"{region}cells.initial", cells.initial)
        if cells.initial == MEASURED_CELLS and cells.fibres is None:
            raise fault("needs cells.fibres, the name of a file", f"{region}cells.initial", cells.initial)
        if bool(material.chain_density) != bool(self.material.chain_density):
            rule = "must be above 0 in every region, or 0 in all of the body (material.chain_density)"
            raise fault(rule, f"{region}material.chain_density", material.chain_density)
        self._check_turnover(region, properties)
        law = LAWS[self.remodeling.law]
        plain = self.remodeling.speed(self.remodeling.kappa, material.temperature)
        if properties.kappa != plain and law.remodels and not law.asks_kappa:
            raise fault(f"the law {self.remodeling.law!r} has no kappa", f"{region}remodeling.kappa", properties.kappa)

    def _check_turnover(self, region: str, properties: Properties) -> None:
        turnover, material, r0 = self.remodeling.turnover, properties.material, properties.cells.end_to_end_length
        if not turnover.is_on:
            return
        if not material.chain_density:
            raise fault("needs chains: material.chain_density above 0", "remodeling.turnover", None)
        longest = material.contour_length / r0
        if CHAINS[material.chain].locks and turnover.deposition_stretch >= longest:
            rule = f"must be smaller than {region}contour_length / end_to_end_length = {shown(longest)}"
            raise fault(rule, "remodeling.turnover.deposition_stretch", turnover.deposition_stretch)

    def each_case(self) -> list[Scene]:
        """Of each load case a scene with its loads alone; where there are no cases, the scene itself."""
        found = []
        for case in self.cases:
            loads = dict(self.loads)
            for name in {*case.loads} & {*loads}:
                loads[name] = loads[name].model_copy(update={"value": loads[name].value * case.loads[name]})
            found.append(self.model_copy(update={"loads": loads, "cases": ()}))
        return found or [self]

    def _check_cases(self) -> None:
        """Shares of one whole and factors on loads that there are; what has no load cases is refused by name."""
        for index, case in enumerate(self.cases):
            for name, factor in case.loads.items():
                if name not in self.loads:
                    rule = "no such load; the scene has " + (", ".join(self.loads) or "none")
                    raise fault(rule, f"cases[{index}].loads.{quoted(name)}", factor)
        total = math.fsum(case.weight for case in self.cases)
        if self.cases and abs(total - 1.0) > SUM_OF_WEIGHTS:
            last = len(self.cases) - 1
            rule = f"the weights of all cases sum to {total:.10g}; they must sum to 1"
            raise fault(rule, f"cases[{last}].weight", self.cases[last].weight)
        remodeling = self.remodeling
        if remodeling.mean != "tensor" and not self.cases:
            raise fault("needs [[cases]]", "remodeling.mean", remodeling.mean)
        if MEANS_OF_CASES[remodeling.mean].of_targets and LAWS[remodeling.law].target is None:
            able = ", ".join(repr(name) for name, law in LAWS.items() if law.target is not None)
            raise fault(f"needs a remodeling.law with a target: {able}", "remodeling.mean", remodeling.mean)
        if self.cases and self.geometry.is_loaded:
            raise fault(
                "not allowed with [[cases]]: the loaded body belongs to one set of loads; remodel-fenicsx unload "
                "SCENE, with those alone, writes the scene of the unloaded one, to which [[cases]] may be added",
                "geometry.is",
                "loaded",
            )
        if self.cases[1:] and not COUPLINGS[remodeling.coupling].takes_cases:
            able = ", ".join(repr(name) for name, kind in COUPLINGS.items() if kind.takes_cases)
            raise fault(f"with [[cases]] must be one of: {able}", "remodeling.coupling", remodeling.coupling)

    def properties(self) -> dict[str, Properties]:
        """What holds in each region by its name, and under "" what holds beside them, where there may be anything."""
        body = Properties(self.material, self.cells, self.remodeling.kappa)
        found = {"": body} | {name: region.over(body) for name, region in self.regions.items()}
        if self.regions and self.geometry.is_filled_by_regions:
            del found[""]
        speed = self.remodeling.speed
        return {name: one._replace(kappa=speed(one.kappa, one.material.temperature)) for name, one in found.items()}

    @property
    def has_random_cells(self) -> bool:
        """Whether cells are drawn anywhere."""
        return any(properties.cells.initial == "random" for properties in self.properties().values())

    @property
    def measured_cells(self) -> dict[str, Cells]:
        """Cells that a file gives, by region, "" for what holds beside them."""
        found = {name: properties.cells for name, properties in self.properties().items()}
        return {name: cells for name, cells in found.items() if cells.initial == MEASURED_CELLS}

    def _check_load(self, name: str, load: Load) -> None:
        step, key = self.time.step, f"loads.{name}"
        for index, (time, factor) in enumerate(load.ramp):
            if not self.time.is_equilibrium and time <= self.time.end and not self.time.is_hit(time):
                raise fault(nearest_multiples(time, step, "time.step"), f"{key}.ramp[{index}][0]", time)
            for case in self.each_case():
                full, above = case.loads[name].value, self.load_kinds[name].above
                if full * factor <= above:
                    share = factor * full / load.value if load.value else factor
                    words = f"with the factor {shown(share)} it is {full * factor:.6g}"
                    raise fault(f"must be greater than {above:g} at every time; {words}", f"{key}.value", load.value)

    def _check_output_times(self) -> None:
        for index, time in enumerate(self.output.times):
            if self.time.is_equilibrium:
                raise fault(
                    "not allowed with time.end = 'equilibrium', which has no times", f"output.times[{index}]", time
                )
            if time > self.time.end:
                raise fault(f"must be at most time.end = {shown(self.time.end)}", f"output.times[{index}]", time)
            if not self.time.is_hit(time):
                rule = nearest_multiples(time, self.time.step, "time.step")
                raise fault(rule, f"output.times[{index}]", time)

    def _check_columns(self) -> None:
        always = columns_of(self.geometry, regions=self.regions)
        known = dict.fromkeys([*columns_on_request(self.geometry), *(column.name for column in always)])
        for name in self.output.columns:
            if name == "time_error" and self.time.is_equilibrium:
                rule = "is an error of steps; must be left out with time.end = 'equilibrium'"
                raise fault(f"{name!r} {rule}", "output.columns", name)
            if self.regions and name in self.geometry.columns_of_one_tissue:
                raise fault(f"{name!r} is for bodies of one tissue; the scene has regions", "output.columns", name)
            if name in (*TURNED_OVER, TURNOVER_POWER) and not self.remodeling.turnover.is_on:
                raise fault(f"{name!r} changes only with remodeling.turnover, which is not set", "output.columns", name)
            if name not in known:
                rule = f"no such column on request; allowed for shape {self.geometry.name!r} are "
                raise fault(rule + ", ".join(map(repr, known)), "output.columns", name)

    def columns(self, more: Iterable[str] = ()) -> tuple[Column, ...]:
        """Of its history, in the order of the file; with `more` of those on request."""
        requested = [*self.output.columns, *more]
        return columns_of(self.geometry, requested, self.loads, self.regions, len(self.cases))

    def stops(self) -> list[float]:
        """Times at which a step ends, however long steps are: corners of ramps, output.times and the end."""
        end = self.last_time
        times = {time for load in self.loads.values() for time, _ in load.ramp if 0 < time < end}
        return sorted({*times, *self.output.times, end})

    @property
    def load_kinds(self) -> dict[str, LoadKind]:
        """All loads that it can have, by name."""
        return self.geometry.loads_on(faces_of(self.loads))

    @property
    def lacking_fields(self) -> dict[str, str]:
        """Fields that the body has not, each with the reason."""
        found = {} if self.regions else {REGION: "the scene has no regions"}
        same = "the mesh is free of stress ([natural]): 'fibre_angle' is that of the unloaded body"
        found |= {UNLOADED: same} if self.natural.is_of_the_mesh else {}
        stays = "it changes only with remodeling.turnover, which is not set"
        return found | ({} if self.remodeling.turnover.is_on else dict.fromkeys(TURNED_OVER, stays))

    @property
    def has_free_length(self) -> bool:
        """Whether the body's length is an unknown."""
        kinds = self.load_kinds
        return self.supports.ends in self.geometry.ends_that_free_length or any(
            kinds[name].frees_length for name in self.loads
        )

    def _check_natural(self) -> None:
        """What goes with an opening angle; all else is refused by name."""
        natural, shape = self.natural, self.geometry
        if natural.is_of_the_mesh:
            return
        asked, value, none = "natural.opening_angle", natural.opening_angle, "0"
        able = [name for name, kind in SHAPES.items() if kind.closes_from_a_sector]
        if not natural.opening_angle:
            asked, value, none = "natural.layers", len(natural.layers), "none"
            able = [name for name, kind in SHAPES.items() if kind.has_a_wall]
        needs: list[tuple[str, Any, list[str]]] = [
            ("geometry.shape", shape.name, able),
            ("mesh.formulation", self.formulation, ["displacement"]),
        ]
        if shape.closes_from_a_sector:  # the closing knows isotropic cells
            needs.append(("cells.axes", self.cells.axes, ["cylindrical"]))
            for name, properties in self.properties().items():
                needs.append((f"{in_region(name)}cells.initial", properties.cells.initial, ["isotropic"]))
        for key, has, possible in needs:
            if has not in possible:
                rule = f"must be {none} unless {key} is {' or '.join(map(repr, possible))}"
                raise fault(rule, asked, value)

    def _check_loaded_shape(self) -> None:
        """Whose unloaded shape can be found."""
        shape, cells = self.geometry, self.natural.cells
        if cells == "equilibrium":
            if not (shape.is_loaded and shape.unloads_by_numbers):
                able = " or ".join(repr(name) for name, kind in SHAPES.items() if kind.unloads_by_numbers)
                raise fault(f"needs geometry.is = 'loaded' of the shape {able}", "natural.cells", cells)
            if not self.time.is_equilibrium:
                raise fault("needs time.end = 'equilibrium'", "natural.cells", cells)
        if not shape.is_loaded:
            return
        if not shape.unloads:
            able = ", ".join(repr(name) for name, kind in SHAPES.items() if kind.unloads)
            raise fault(f"allowed for the shapes {able}", "geometry.is", "loaded")
        if self.supports.ends == "clamped":
            raise fault(
                "not allowed with supports.ends = 'clamped': the loaded tube would not have one radius",
                "geometry.is",
                "loaded",
            )
        if self.measured_cells:
            key = f"{in_region(next(iter(self.measured_cells)))}cells.fibres"
            raise fault(
                f"not allowed with {key}: its rows belong to places, which unloading moves", "geometry.is", "loaded"
            )

    def _check_length(self) -> None:
        """A length is prescribed or unknown."""
        load = self.loads.get("elongation")
        if self.has_free_length and load is not None and any(load.value * factor for _, factor in load.ramp):
            rule = "must be 0 where the length is an unknown, with loads.axial_force or closed ends"
            raise fault(rule, "loads.elongation.value", load.value)
        if self.has_free_length and self.solver.method == "iterative":
            names = ", ".join(repr(name) for name in (AUTO, *SOLVER_METHODS) if name != "iterative")
            rule = f"allowed where the length is an unknown, with loads.axial_force or closed ends, are {names}"
            raise fault(rule, "solver.method", self.solver.method)

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
        return "; ".join(parts)

    def warnings(self) -> list[str]:
        """What is allowed but hardly meant, each on one line."""
        found: dict[str, None] = {}
        properties = self.properties()
        if self.geometry.fills(self.regions):
            properties.pop("", None)  # it holds nowhere
        for name, (material, cells, _) in properties.items():
            for case in self.each_case():
                lines = doubts(material, self.geometry, case.loads, cells.end_to_end_length, self.last_time)
                found |= dict.fromkeys(line if line.startswith("geometry.") else _words(name) + line for line in lines)
        return [*found, *self.turned_away(), *self._too_long_for_turnover(), *self.remodeling.warnings()]

    def turned_away(self) -> list[str]:
        """Whether rows leave the loaded shape that is given, for its cells turn; with the way out."""
        turns = LAWS[self.remodeling.law].remodels and any(one.kappa for one in self.properties().values())
        if not (self.geometry.is_loaded and turns and self.natural.cells == AS_GIVEN):
            return []
        way = "let all loads act in the first step to have a row with it"
        if self.geometry.unloads_by_numbers:
            way = (
                "natural.cells = 'equilibrium' with time.end = 'equilibrium' takes it for that of cells that have come "
                f"to rest; or {way}"
            )
        return [
            "geometry.is = 'loaded': the given shape is that under all loads with the cells of t = 0. They turn while "
            f"loads rise and afterwards, so rows have another one; {way}"
        ]

    def _too_long_for_turnover(self) -> list[str]:
        """Explicit steps of turnover that are longer than its time: content then swings about its rest."""
        turnover, step = self.remodeling.turnover, self.time.step
        chosen = self.time.is_equilibrium or self.time.tolerance is not None
        if chosen or self.remodeling.coupling == "implicit" or step <= (turnover.time or math.inf):
            return []
        return [
            f"time.step = {step:g} is longer than remodeling.turnover.time = {turnover.time:g}: content and natural "
            "length overshoot in each step; set a shorter time.step, time.tolerance, or remodeling.coupling = "
            "'implicit'"
        ]

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
            if not isinstance(key, str):
                raise SceneError(f"{shown(key)} = {shown(value)}: a key must be text, as in 'cells.seed'")
            put(values, key, value)
        without_replaced(values, changes)
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


def _in_present_format(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values with the present format number; a newer one is refused before the keys that are new in it are."""
    written = values.get("format")
    if not isinstance(written, int) or isinstance(written, bool) or written < 1:
        return dict(values)  # none, or a fault that the field's own error describes
    if written > FORMAT:
        rule = f"written by a newer version of remodel_fenicsx; this one reads formats up to {FORMAT}"
        raise fault(rule, "format", written)
    return {**values, "format": FORMAT}


def _with_measured_cells(values: dict[str, Any]) -> dict[str, Any]:
    """cells.initial = 'fibres' wherever a file of fibres is given, in the whole body and in regions."""
    regions = values.get("regions")
    tables = {"": values, **{in_region(quoted(str(name))): table for name, table in _items(regions)}}
    found = {}
    for key, table in tables.items():
        cells = table.get("cells") if isinstance(table, Mapping) else None
        if not isinstance(table, Mapping) or not isinstance(cells, Mapping) or cells.get("fibres") is None:
            continue
        if cells.get("initial", MEASURED_CELLS) != MEASURED_CELLS:
            rule = f"{key}cells.initial = {shown(cells['initial'])} is there too; one of them gives the cells"
            raise fault(rule, f"{key}cells.fibres", cells["fibres"])
        found[key] = {**table, "cells": {**cells, "initial": MEASURED_CELLS}}
    values = found.get("", values)
    if regions is None or not found:
        return values
    own = {name: found.get(in_region(quoted(str(name))), table) for name, table in _items(regions)}
    return {**values, "regions": own if isinstance(regions, Mapping) else regions}


def _items(table: Any) -> list[tuple[Any, Any]]:
    return list(table.items()) if isinstance(table, Mapping) else []


def _beside(values: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The keys of a file in this folder, with the places of the files that they name."""

    def placed(table: Any) -> Any:
        cells: Any = table.get("cells") if isinstance(table, Mapping) else None
        file = cells.get("fibres") if isinstance(cells, Mapping) else None
        return (
            {**table, "cells": {**cells, "fibres": str(folder.absolute() / file)}} if isinstance(file, str) else table
        )

    values = placed(values)
    geometry = values.get("geometry")
    if isinstance(geometry, Mapping) and isinstance(kind := geometry.get("shape"), str) and kind in SHAPES:
        values = {**values, "geometry": SHAPES[kind].with_files_from(geometry, folder)}
    if isinstance(regions := values.get("regions"), Mapping):
        values = {**values, "regions": {name: placed(table) for name, table in regions.items()}}
    return values


def _listed(fields: Any) -> tuple[str, ...]:
    return () if isinstance(fields, bool) else tuple(fields)


def in_region(name: str) -> str:
    """Of a dotted key in a region, or in the whole body: what stands before."""
    return f"regions.{name}." if name else ""


def _words(region: str) -> str:
    return f"{region}: " if region else ""


def _check_name(key: str, name: Any, names: Iterable[str]) -> None:
    if not isinstance(name, str) or name not in names:
        raise fault("allowed are " + ", ".join(map(repr, names)), key, name)


def _known_shape(geometry: Any) -> str:
    """The shape that is asked for. Without it nothing else can be judged: preset, loads and units depend on it."""
    if not isinstance(geometry, Mapping):
        raise fault("must be a table", "geometry", geometry)
    if "shape" not in geometry:
        raise fault("missing; allowed are " + ", ".join(map(repr, SHAPES)), "geometry.shape", None)
    _check_name("geometry.shape", geometry["shape"], SHAPES)
    return str(geometry["shape"])


def _in_own_units(values: Mapping[str, Any], shape: type[Shape]) -> dict[str, Any]:
    """The values, those of preset and shape among them, with numbers in the scene's units in place of "5 mm"."""
    units: dict[str, str | None] = {}
    for key, table, known in ((STRESS_UNIT, Material, tuple(STRESS_UNITS)), (LENGTH_UNIT, shape, LENGTH_UNITS)):
        table_name, name = key.split(".")
        chosen, field = values.get(table_name), table.model_fields[name]
        units[key] = chosen.get(name, field.default) if isinstance(chosen, Mapping) else field.default
        if units[key] not in (*known, None):
            raise fault(allowed(field), key, units[key])
    result: dict[str, Any] = in_units(values, Scene, units)
    result["geometry"] = in_units(result["geometry"], shape, units, "geometry")
    if isinstance(regions := result.get("regions"), Mapping):
        result["regions"] = {
            name: in_units(entry, Region, units, f"regions.{quoted(str(name))}") for name, entry in regions.items()
        }
    if isinstance(loads := result.get("loads"), Mapping):
        kinds = shape.loads_on(faces_of(loads))
        result["loads"] = {
            name: in_units(entry, Load, units, f"loads.{name}", {"value": kinds[name].dimension})
            for name, entry in loads.items()
        }
    return result


def _check_load_names(shape: str, loads: Any) -> None:
    """A load that the shape does not have, before anything is said about what is missing in it."""
    kind = SHAPES[shape]
    names = kind.loads
    for name, load in loads.items() if isinstance(loads, Mapping) else ():
        if kind.holds_faces and isinstance(load, Mapping) and ("kind" in load or "face" in load):
            _check_load_on_face(kind, str(name), load)
        elif name not in names:
            key, listed = f"loads.{quoted(str(name))}", ", ".join(f"loads.{known}" for known in names)
            rule = f"is now {RENAMED[key]}" if key in RENAMED else f"a {shape} has no such load; allowed: {listed}"
            raise fault(rule, key, load)


def _check_load_on_face(shape: type[Shape], name: str, load: Mapping[str, Any]) -> None:
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


def _plain(value: Any, every_value: bool = False) -> Any:
    """Tables as dicts of the values that were set (or of all), so that they merge as the same keys in TOML do."""
    if isinstance(value, BaseModel):
        kind = {"shape": value.name} if isinstance(value, Shape) else {}
        names = [name for name in type(value).model_fields if every_value or name in value.model_fields_set]
        names += value.model_extra or ()
        found = {name: _plain(getattr(value, name), every_value) for name in names}
        return kind | {name: entry for name, entry in found.items() if entry is not None}
    if isinstance(value, Mapping):
        return {name: _plain(entry, every_value) for name, entry in value.items()}
    return value


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
    >>> preset_scene("kuhl-holzapfel-2007", "ball")
    Traceback (most recent call last):
        ...
    remodel_fenicsx.schema.tables.SceneError: geometry.shape = 'ball': allowed are 'cube', 'tendon', 'tube', 'mesh'
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
    changes = [parse_override(override) for override in overrides]

    def made(settings: Mapping[str, Any]) -> Scene:
        values = merged(read, nested(settings))
        for key, value in changes:
            put(values, key, value)
        return scene_from_dict(_beside(values, Path(path).parent))

    if profile is None:
        return made({})
    return _with_profile(profile, lambda settings: made({"profile": profile, **settings}))


def _with_profile(name: str, made: Callable[[Mapping[str, Any]], Scene]) -> Scene:
    """The scene that is made with a profile's settings: they depend on its cells and loads."""
    scene = made(PROFILES[name].values)
    settings = profile_for(name, scene).settings(scene)
    return scene if settings == PROFILES[name].values else made(settings)


# ---------------------------------------------------------------- where a run goes on

# what decides no number of the steps done, or only how they were solved
# (of a file only its contents, geometry.sha256, count)
FREE = ("format", "name", "preset", "profile", "output", "solver", "loads", "time.end", "geometry.file")
SAME_LOAD = 1e-12  # relative difference of two loads that are the same


def check_continuation(old: Scene, new: Scene, time: float) -> None:
    """Check that the physics of a scene is that of the run so far, until `time`."""
    rule = f"a resumed run may change time.end, output, solver, and loads after its checkpoint at {time:g}"
    before, now = (dict(_physics(scene.model_dump(mode="json"))) for scene in (old, new))
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


def _physics(table: Mapping[str, Any], key: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of all values that must stay."""
    for name, value in table.items():
        path = f"{key}.{name}" if key else name
        if path in FREE or path.endswith("cells.fibres"):  # the SHA-256 beside it must stay
            continue
        if isinstance(value, Mapping):
            yield from _physics(value, path)
        else:
            yield path, value
