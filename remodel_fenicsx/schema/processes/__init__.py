"""Tables of the processes that remodel in addition to the cells, a module each.

A process is its module here, with its table as `TABLE`, and its class in `evolution`. No other
module names it: without these two files it is gone.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Collection, Iterator, Mapping
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

from remodel_fenicsx.schema.tables import Faults, Table

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from remodel_fenicsx.model.energy import Tissue


class ProcessTable(Table):
    """Table of a process. A subclass overrides what the process needs from a scene.

    Attributes
    ----------
    name
        Name of the table in `[remodeling]`, and of the module.
    process
        Dotted name of the class of the `Remodels`.
    columns
        Columns on request: name, unit, meaning, and a function of the `Remodels`.
    start_key
        Key of the time at which the process starts.
    is_on
        Whether the scene has the process.
    growth_key
        Key with which the volume of the tissue changes; empty if it is constant.
    rate
        Rate of the process, 1/time; 0 if it has none.
    stops
        Times that steps must hit.
    starts_at_equilibrium
        Whether the process starts from a homeostatic state on the load path.
    absent
        Fields and columns that the process does not have, each with the reason.
    """

    name: ClassVar[str]
    process: ClassVar[str]
    columns: ClassVar[tuple[tuple[str, str, str, Callable[..., float]], ...]] = ()
    start_key: ClassVar[str] = ""
    is_on: ClassVar[bool] = False
    growth_key: ClassVar[str] = ""
    rate: ClassVar[float] = 0.0
    stops: ClassVar[Collection[float]] = ()
    starts_at_equilibrium: ClassVar[bool] = False
    absent: ClassVar[Mapping[str, str]] = MappingProxyType({})

    def faults_in(self, region: str, tissue: Tissue) -> Faults:
        """Yield what does not fit the tissue of a region, whose keys have this prefix."""
        yield from ()

    def initial_problem(self, changed: Mapping[str, NDArray[np.float64]]) -> str:
        """Return why the process cannot continue fields of an earlier run, as text."""
        return ""

    def warnings(self, tissue: Tissue) -> Iterator[str]:
        """Yield warnings on values that are allowed but implausible for a tissue."""
        yield from ()

    def step_warning(self, step: float) -> str:
        """Return a warning on a constant step size, as text."""
        return ""

    def summary(self) -> str:
        """Describe the process in a few words."""
        return ""


def tables() -> dict[str, type[ProcessTable]]:
    """Return the table of each process that has a module here, by name."""
    modules = (import_module(f"{__name__}.{one.name}") for one in pkgutil.iter_modules(__path__))
    return {module.TABLE.name: module.TABLE for module in modules}
