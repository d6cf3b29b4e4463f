"""The tables of a scene beside material, cells and remodeling: mesh, model, loads, time, solver, output."""

from __future__ import annotations

import bisect
import itertools
import math
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from remodel_fenicsx.body.reductions import AUTO
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.fem.solver_methods import AUTO as AUTOMATIC
from remodel_fenicsx.fem.solver_methods import (
    LARGE,
    LARGE_ON_RANKS,
    MEANINGS,
    METHODS,
    REMOVED,
    SMALL_BODY,
    SMALL_REDUCTION,
    fault_of_option,
)
from remodel_fenicsx.schema.tables import Table, checked, fault, is_number, one_of, quoted, shown
from remodel_fenicsx.schema.times import is_multiple, same_time
from remodel_fenicsx.schema.units import FORCE

MOST_STEPS = 1_000_000


class Mesh(Table):
    """The finite elements."""

    refinement: int = Field(
        default=1,
        ge=1,
        description="Factor on the paper's number of elements in every direction (1: its own meshes). More than 10 "
        "million hexahedra, or those split into tetrahedra, are refused.",
    )
    element: Literal["hexahedron", "tetrahedron"] = Field(default="hexahedron", description="Shape of the elements.")
    degree: Annotated[int, one_of((1, 2))] = Field(
        default=1, description="Polynomial degree of the displacement: 1 (the paper's) or 2."
    )
    formulation: Annotated[str, one_of(FORMULATIONS)] = Field(
        default="displacement",
        description="Where the elements take the change of volume: "
        + "; ".join(f"{name!r}: {formulation.meaning}" for name, formulation in FORMULATIONS.items())
        + ".",
    )

    @model_validator(mode="after")
    def _formulation_has_the_element(self) -> Mesh:
        pair = self.element, self.degree
        if not FORMULATIONS[self.formulation].has(*pair):
            able = [name for name, formulation in FORMULATIONS.items() if formulation.has(*pair)]
            rule = f"allowed for elements {self.element!r} of degree {self.degree} is {', '.join(map(repr, able))}"
            raise fault(rule, "formulation", self.formulation)
        return self


def _kinematics(value: Any) -> Any:
    if value not in (AUTO, *KINEMATICS):
        raise fault("allowed are " + ", ".join(map(repr, (AUTO, *KINEMATICS))))
    return value


class Model(Table):
    """Which unknowns describe the deformation."""

    kinematics: Annotated[str, checked(_kinematics)] = Field(
        default=AUTO,
        description="'auto': the cheapest that is exact for the scene; a scene as run has its name. "
        + "; ".join(f"{name!r}: {kinematics.meaning}" for name, kinematics in KINEMATICS.items())
        + ". One that would be wrong for the scene is refused with the reason (docs/kinematics.md).",
        json_schema_extra={"allowed": "one of " + ", ".join(map(repr, (AUTO, *KINEMATICS)))},
    )


class Supports(Table):
    """How the body is held."""

    ends: str = Field(
        default="free",
        description="Ends of a tube: 'free' to move radially in their planes; 'clamped', which keeps their circles; "
        "or 'closed': free, with caps on which the pressure acts, and the length an unknown.",
        json_schema_extra={"allowed": "'free', for a tube also 'clamped' and 'closed'"},
    )


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
    """A load by name: `force` of cube and tendon, `pressure` and `elongation` of a tube; zero if it is not listed.

    `force` is the total dead force along z on the top; `pressure` acts on the deformed inner face; `elongation` is the
    prescribed engineering strain of the length (0.1: 10 % longer). A tube with `axial_force` in place of `elongation`
    has a length that is an unknown.
    """

    value: float = Field(
        description="Full value at factor 1: force in stress_unit times length squared, pressure in stress_unit, "
        "elongation without unit (above -1)."
    )
    ramp: Annotated[tuple[tuple[float, float], ...], checked(_ramp)] = Field(
        description="Factor on the value over time, as [time, factor] pairs with increasing times: linear in between, "
        "held before the first and after the last pair. Times up to time.end must be multiples of time.step; with "
        "time.tolerance they are hit.",
        json_schema_extra={"allowed": "a list of pairs [time, factor] with increasing times"},
    )

    def factor(self, time: float) -> float:
        """Factor on the value at a time: piecewise linear, held before the first and after the last pair."""
        for ramp_time, factor in self.ramp:  # exact at its own times
            if same_time(time, ramp_time):
                return factor
        after = bisect.bisect_right(self.ramp, time, key=lambda pair: pair[0])
        if after == 0:
            return self.ramp[0][1]
        if after == len(self.ramp):
            return self.ramp[-1][1]
        (time0, factor0), (time1, factor1) = self.ramp[after - 1], self.ramp[after]
        return factor0 + (factor1 - factor0) * (time - time0) / (time1 - time0)

    @property
    def falls(self) -> bool:
        """Whether it is ever smaller than before, or changes its sign."""
        factors = [0.0, *(factor for _, factor in self.ramp)]
        return any(abs(new) < abs(old) or new * old < 0 for old, new in itertools.pairwise(factors))

    def largest(self, end: float) -> float:
        """The value of largest magnitude from time 0 to `end`, with its sign."""
        times = [end, *(time for time, _ in self.ramp if time < end)]
        return max((self.value * self.factor(time) for time in times), key=abs)


EQUILIBRIUM = "equilibrium"
"""What `time.end` says where the way there is not asked for."""


def _end(value: Any) -> Any:
    """A time, or the word."""
    if value == EQUILIBRIUM:
        return value
    if not is_number(value) or not value > 0:
        raise fault(f"must be a finite number greater than 0, or {EQUILIBRIUM!r}")
    return float(value)


class Time(Table):
    """Simulated time, in the unit of 1/kappa. It starts at 0 with the unloaded body."""

    # a number for all who step through time; those who take the word ask `is_equilibrium` first
    end: Annotated[Any, checked(_end)] = Field(
        description="Last time, a whole number of steps, or any time with a tolerance; or 'equilibrium': at once to "
        "the state that remodeling comes to under the loads at the end of their ramps (docs/theory.md, Equilibrium at "
        "once).",
        json_schema_extra={"allowed": "a finite number greater than 0, or 'equilibrium'"},
    )
    step: float = Field(
        default=1.0, gt=0, description="Time between two remodeling passes; with a tolerance the first step."
    )
    tolerance: float | None = Field(
        default=None,
        gt=0,
        description="Where it is given, steps are as long as the estimated error in time stays below it, in degrees: "
        "of the direction of the chains, root mean square over the body, and of lengths, relative, as an angle (1 "
        "degree is 1.7 %). Times of ramps and output.times are hit. On the way to an equilibrium steps are always "
        "chosen so; default there: 3 degrees, 0.5 where a load falls.",
        json_schema_extra={"allowed": "a number greater than 0, in degrees"},
    )

    @model_validator(mode="after")
    def _whole_number_of_steps(self) -> Time:
        if self.is_equilibrium:
            return self
        if self.step > self.end:
            raise fault(f"must be at most time.end = {shown(self.end)}", "step", self.step)
        if self.end / self.step > MOST_STEPS:
            rule = f"must be at least time.end / {MOST_STEPS} = {self.end / MOST_STEPS:.6g}"
            raise fault(rule, "step", self.step)
        if not self.is_hit(self.end):
            raise fault(nearest_multiples(self.end, self.step, "time.step"), "end", self.end)
        return self

    @property
    def is_equilibrium(self) -> bool:
        """Whether the end is no time."""
        return bool(self.end == EQUILIBRIUM)

    @property
    def number_of_steps(self) -> int:
        """Number of steps from 0 to the end, the equilibrium is one; with a tolerance the run's own are others."""
        return 1 if self.is_equilibrium else round(self.end / self.step)

    def is_hit(self, time: float) -> bool:
        """Whether a step ends at a time, or may end there."""
        return self.tolerance is not None or is_multiple(time, self.step)

    def progress(self, number: int, time: float) -> int:
        """How many of `number_of_steps` are behind a step; with a tolerance, by its time."""
        return number if self.tolerance is None or self.is_equilibrium else math.floor(time / self.step * (1 + 1e-12))

    def in_words(self) -> str:
        """How it is divided."""
        if self.tolerance is None:
            return f"{self.number_of_steps} steps"
        return f"steps of an error below {self.tolerance:g} degrees"


def nearest_multiples(time: float, step: float, name: str) -> str:
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
            if refused := fault_of_option(name, entry):
                raise fault(refused, name, entry)
    return value


def _method(value: Any) -> Any:
    if isinstance(value, str) and value in REMOVED:
        raise fault(REMOVED[value])
    if value not in (AUTOMATIC, *METHODS):
        raise fault("allowed are " + ", ".join(map(repr, (AUTOMATIC, *METHODS))))
    return value


class Solver(Table):
    """Solution of the nonlinear problem of each step."""

    method: Annotated[str, checked(_method)] = Field(
        default=AUTOMATIC,
        description=f"'auto': 'direct' up to {SMALL_BODY} unknowns ({SMALL_REDUCTION} of a reduction), then 'lagged', "
        f"above {LARGE} 'iterative'; "
        f"on more ranks 'direct' up to {LARGE_ON_RANKS}, then 'iterative'; "
        + "; ".join(f"{name!r}: {meaning}" for name, meaning in MEANINGS.items())
        + " (docs/speed.md).",
        json_schema_extra={"allowed": "one of " + ", ".join(map(repr, (AUTOMATIC, *METHODS)))},
    )
    predictor: Literal["none", "autoregressive", "with-tolerance"] = Field(
        default="autoregressive",
        description="Where Newton's method starts a step: 'none': at the displacement of the step before; "
        "'autoregressive': at what the increments of the last steps predict; 'with-tolerance': as predicted where "
        "steps are chosen (time.tolerance), 'none' where they are equal. The solutions are the same to the "
        "tolerance.",
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
    unstable: Literal["warn", "stop"] = Field(
        default="warn",
        description="What happens at an equilibrium that the body would leave, one with more negative eigenvalues of "
        "the tangent than before: a warning that says where, or, looked for in every step, the end of the run after "
        "the last stable step (exit code 3).",
    )
    petsc_options: Annotated[dict[str, Any], checked(_petsc_options)] = Field(
        default_factory=dict,
        description="PETSc options that override the method's, without the leading '-': snes_..., ksp_..., pc_... "
        "and mat_.... None that runs code or writes files; those of PETSC_OPTIONS are the user's own.",
    )

    @model_validator(mode="after")
    def _has_a_tolerance(self) -> Solver:
        if self.absolute_tolerance == 0.0 and self.relative_tolerance == 0.0:
            raise fault("must be greater than 0 where absolute_tolerance is 0", "relative_tolerance", 0.0)
        return self


FIELDS_BY_NAME = (
    "displacement", "deformation_gradient", "cauchy_stress", "cell_dimensions", "axis_1", "axis_2", "axis_3",
    "fibre_angle", "fibre_angle_deformed", "chain_extension", "chains",
)  # fmt: skip
"""What `output.fields` may name (`results.fields`); "chains" are the lines of fields_chains.vtkhdf."""


def _fields(value: Any) -> Any:
    if isinstance(value, bool):
        return value
    if not isinstance(value, (list, tuple)) or not all(isinstance(name, str) for name in value):
        raise fault("must be true, false or a list of names of fields")
    for name in value:
        if name not in FIELDS_BY_NAME:
            raise fault(f"no such field; allowed are {', '.join(map(repr, FIELDS_BY_NAME))}", value=name)
    return tuple(value)


def _columns(value: Any) -> Any:
    if not isinstance(value, (list, tuple)) or not all(isinstance(name, str) for name in value):
        raise fault("must be a list of names of columns")
    return tuple(dict.fromkeys(value))


def _times(value: Any) -> Any:
    if not isinstance(value, (list, tuple)) or not all(is_number(time) and time > 0 for time in value):
        raise fault("must be a list of times above 0")
    times = tuple(map(float, value))
    if any(later <= time for time, later in zip(times, times[1:], strict=False)):
        raise fault("must increase from time to time")
    return times


class Output(Table):
    """What a run writes beside its history table."""

    fields: Annotated[bool | tuple[str, ...], checked(_fields)] = Field(
        default=True,
        description="Fields to write for ParaView: true for all, false for none, or names (docs/commands.md), 'chains' "
        "for the chain lines. What no name asks for is not computed.",
        json_schema_extra={"allowed": "true, false or a list of names of fields"},
    )
    columns: Annotated[tuple[str, ...], checked(_columns)] = Field(
        default=(),
        description="Columns of the history: 'pass_residual' and 'negative_eigenvalues' come beside those that it "
        "has without being asked; where some of these are named, only they are measured, with time and loads "
        "(docs/commands.md).",
        json_schema_extra={"allowed": "a list of names of columns"},
    )
    every: int = Field(default=1, ge=1, description="Write the fields of every n-th step; the last one always.")
    times: Annotated[tuple[float, ...], checked(_times)] = Field(
        default=(),
        description="Times up to time.end that have a row and whose fields are written beside those of every n-th "
        "step: multiples of time.step; with time.tolerance a step ends there.",
        json_schema_extra={"allowed": "a list of increasing times above 0"},
    )
    checkpoint: int | None = Field(
        default=None,
        ge=0,
        description="Steps between two checkpoints, from which a run can be resumed; 0: only at the end. Without it "
        "they are chosen by time: at most 10 minutes are lost, and they cost below 5 % of the run. There is always one "
        "at the end, however the run ends.",
        json_schema_extra={"allowed": "a whole number at least 0"},
    )
