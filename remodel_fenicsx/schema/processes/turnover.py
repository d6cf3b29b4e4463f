"""Table of turnover: removal and deposition of collagen, and growth by deposited collagen."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from operator import methodcaller
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, GetPydanticSchema

from remodel_fenicsx.model.axes import GROWTH
from remodel_fenicsx.model.energy import TURNED_OVER, Tissue
from remodel_fenicsx.model.laws import TURNOVER_RATES, TurnoverRule
from remodel_fenicsx.model.tensors import Array
from remodel_fenicsx.schema.processes import ProcessTable
from remodel_fenicsx.schema.tables import Faults, OneOf, format_value, with_key

EQUILIBRIUM = "equilibrium"
# Value of k a below which a wall with turnover takes more than about 5 T for a factor of e.
SLOW_REST = 3.0
POWER, COLLAGEN = "turnover_power", "collagen_share"  # columns

_Start: Any = Annotated[
    Annotated[float, Field(ge=0)] | Literal["equilibrium", "rest"],  # "rest": until version 0.4.0
    AfterValidator(lambda start: EQUILIBRIUM if start == "rest" else start),
]
_WithStart: Any = with_key(
    "from",
    Annotated[Any, GetPydanticSchema(lambda _, handler: handler(_Start))],
    default=0.0,
    json_schema_extra={"allowed": "a finite number of at least 0, or 'equilibrium'"},
    description="Time from which turnover adds volume; a step ends there. 0: always. "
    "'equilibrium', with time.end = 'equilibrium': from the steady state under the loads before "
    "their last change. The older name 'rest' means the same.",
)


class Turnover(_WithStart, ProcessTable):  # type: ignore[misc]
    """Removal and deposition of collagen, if `time` is set (docs/turnover.md).

    For the law `tensor`.
    """

    name = "turnover"
    process = "remodel_fenicsx.evolution.turnover:TurnoverPass"
    columns = (
        (
            "content",
            "",
            "amount of collagen over its initial value, volume mean; with remodeling.turnover",
            methodcaller("mean", "content"),
        ),
        (
            "natural_length",
            "",
            "natural length of collagen over its initial value, volume mean; with "
            "remodeling.turnover",
            methodcaller("mean", "natural_length"),
        ),
        (
            GROWTH,
            "",
            "stress-free volume of the tissue over its initial value; mean over the initial volume",
            methodcaller("mean_volume_ratio"),
        ),
        (
            COLLAGEN,
            "",
            "volume fraction of collagen in the tissue, mean over the initial volume",
            methodcaller("collagen_share"),
        ),
        (
            POWER,
            "stress length^3 / time",
            "power that turnover releases at the row's F, without growth",
            methodcaller("power"),
        ),
    )
    start_key = "from"

    time: float | None = Field(default=None, gt=0)
    """Turnover time T of collagen. Without it there is no turnover."""
    deposition_stretch: float = Field(default=1.1, gt=1)
    """Deposition stretch lambda_h of new chains, over r0."""
    gain: float = Field(default=1.0, ge=0)
    """Gain k: how fast the amount of collagen follows the stress of the chains. With 0 the amount
    is constant."""
    rates: Annotated[str, OneOf(TURNOVER_RATES)] = "cauchy"
    """Stimulus of amount and natural length. 'cauchy': the stress of a chain. 'tension': its force,
    as in version 0.3.0."""
    volume: float = Field(default=0.3, ge=0, le=1)
    """Volume fraction phi of collagen in the wall at the start, or at `from`. Deposited collagen
    adds volume unless this is 0."""
    growth: Literal["normal"] = "normal"
    """Direction of growth. 'normal': across the wall."""

    @property
    def is_on(self) -> bool:  # type: ignore[override]
        return self.time is not None

    @property
    def growth_key(self) -> str:  # type: ignore[override]
        return "volume" if self.is_on and self.volume > 0 else ""

    @property
    def rate(self) -> float:  # type: ignore[override]
        return 1 / self.time if self.time else 0.0

    @property
    def starts_at_equilibrium(self) -> bool:  # type: ignore[override]
        return self.start == math.inf

    @property
    def start(self) -> float:
        """Time from which turnover adds volume; infinite if that is an equilibrium."""
        start = getattr(self, "from")
        return math.inf if start == EQUILIBRIUM else float(start)

    @property
    def stops(self) -> set[float]:  # type: ignore[override]
        return {self.start} - {0.0, math.inf}

    @property
    def rule(self) -> TurnoverRule:
        """Turnover rule as a function of arrays."""
        assert self.time is not None
        return TurnoverRule(
            self.time, self.deposition_stretch, self.gain, TURNOVER_RATES[self.rates]
        )

    def _faults(self) -> Faults:
        if self.time is None and self != Turnover.model_construct():
            yield "missing; turnover needs its time", "time", None

    @property
    def absent(self) -> dict[str, str]:  # type: ignore[override]
        changes = "it changes only with remodeling.turnover, which is not set"
        grows = "tissue grows only with a remodeling.turnover.volume above 0"
        reasons = {} if self.is_on else dict.fromkeys((*TURNED_OVER, POWER), changes)
        return reasons if self.growth_key else reasons | dict.fromkeys((GROWTH, COLLAGEN), grows)

    def faults_in(self, region: str, tissue: Tissue) -> Faults:
        if tissue.chain is None:
            rule = f"needs chains: {region}material.chain_density above 0"
            yield rule, "remodeling.turnover", None
            return
        longest = tissue.contour_length / tissue.end_to_end_length
        if tissue.chain.locks and self.deposition_stretch >= longest:
            most = f"{region}contour_length / end_to_end_length = {format_value(longest)}"
            rule = f"must be smaller than {most}"
            yield rule, "remodeling.turnover.deposition_stretch", self.deposition_stretch

    def initial_problem(self, changed: Mapping[str, Array]) -> str:
        names = [name for name in TURNED_OVER if name in changed]
        if names and not self.is_on:
            return f"has {' and '.join(names)}, which needs remodeling.turnover"
        if GROWTH not in changed:
            return ""
        smallest, earlier = changed[GROWTH].min(), f"has {GROWTH} of an earlier run"
        if self.start:
            return f"{earlier}; remodeling.turnover.from must be 0 with it"
        if smallest <= 1.0 - self.volume:
            volume = f"remodeling.turnover.volume must be above {1.0 - smallest:.3g} with it"
            return f"{earlier}, minimum {smallest:.3g}; {volume}"
        return ""

    def warnings(self, tissue: Tissue) -> Iterator[str]:
        power, slowly = self.rule.gain_and_recovery_time(tissue)
        says = f"remodeling.turnover.gain = {self.gain:g}"
        if power <= 2:
            least = 2 * self.gain / power if self.gain else math.inf
            yield (
                f"{says}: no stable homeostasis with this deposition_stretch; "
                f"must exceed {least:.3g}"
            )
        elif power < SLOW_REST:
            words = "if collagen alone carries the loads, shorter with a matrix"
            yield f"{says}: reaches equilibrium slowly, time constant {slowly:.3g} {words}"

    def step_warning(self, step: float) -> str:
        if step * self.rate <= 1:
            return ""
        return (
            f"time.step = {step:g} exceeds remodeling.turnover.time = {self.time:g}: content and "
            "natural length overshoot in each step; reduce time.step or set time.tolerance"
        )

    def summary(self) -> str:
        return f"turnover with rates = {self.rates!r} and volume = {self.volume:g}"


TABLE = Turnover
