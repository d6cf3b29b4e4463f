"""Names of version 0.4.0 are read for one release, with a warning."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

import pytest

from remodel_fenicsx import Simulation, extend, preset_scene
from remodel_fenicsx._renamed import OLD_NAMES
from remodel_fenicsx.extend import (
    CHAINS,
    LAWS,
    WATCHERS,
    Law,
    Parameter,
    Traits,
    WarnsOnce,
    WatcherKind,
    ranked,
)

CUBE = preset_scene("kuhl-holzapfel-2007", "cube").with_values(
    {"model.kinematics": "point", "time.end": 2.0}
)


def test_a_script_with_old_names_runs() -> None:
    """It overrides a method, passes arguments and reads attributes, each under its old name."""

    with patch.dict(WATCHERS), pytest.warns(DeprecationWarning) as warned:

        class Stretched(WarnsOnce):
            name = "stretched"

            def look(self, step: Any) -> str:
                return "the cube is long" if step.row["mean_stretch"] > 1.05 else ""

        WATCHERS["stretched"] = WatcherKind(Stretched.of)
        simulation = Simulation(CUBE)
        assert [step.moment for step in simulation.steps()] == ["time 1", "time 2"]
        assert simulation.watchers[-1].said
        assert list(simulation.state.others) == []
        simulation.close()
    assert {str(one.message) for one in warned} == {
        "WarnsOnce: look is now check",
        "WarnsOnce: of is now for_scene",
        "WarnsOnce: said is now is_reported",
        "Step: moment is now label",
        "State: others is now other_cases",
    }


def test_arguments_and_module_names_are_read() -> None:
    with pytest.warns(DeprecationWarning, match="is now"):
        assert Parameter(0.5, "A number.", above=0.0).exclusive_minimum == 0.0
        assert Traits(order=2, accumulates=True, longest=0.5).longest == 0.5
        assert Law(LAWS["none"].update, asks_kappa=True).stops_at_zero_kappa
        assert ranked(lambda *values: values[0], of_absolute_time=True).depends_on_absolute_time
        assert CHAINS["wormlike"].of({}) is CHAINS["wormlike"]
        assert extend.EveryTangent is extend.FullNewton


def test_each_new_name_is_there() -> None:
    """Of every public class in the table."""
    simulation = Simulation(CUBE)
    owners: dict[str, Any] = {
        "State": simulation.state,
        "Quadrature": simulation.quadrature,
        "Staggered": simulation.stepper.coupling,
        "Tissue": simulation.tissue,
        "CellField": simulation.cells,
        "Loading": simulation.loading,
        "Kinematics": simulation.state.kinematics,
        "Scene": CUBE,
        "Shape": CUBE.geometry,
        "Material": CUBE.material,
    }
    owners |= {
        name: getattr(extend, name)
        for name in OLD_NAMES
        if hasattr(extend, name) and name not in owners
    }
    for name in owners.keys() & OLD_NAMES.keys() - {"ranked"}:
        for new in OLD_NAMES[name].values():
            fields = getattr(owners[name], "__annotations__", {}) | getattr(
                owners[name], "__dataclass_fields__", {}
            )
            assert hasattr(owners[name], new) or new in fields, (name, new)
    simulation.close()
