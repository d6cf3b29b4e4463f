"""The history file by itself: rows that read back, and what a full disk leaves."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from remodel_fenicsx.body.shape import COLUMNS
from remodel_fenicsx.evolution.stepper import Step
from remodel_fenicsx.results.run_folder import History
from remodel_fenicsx.results.recording import read_history
from remodel_fenicsx.solver.continuation import Work
from remodel_fenicsx.solver.equilibrium import Extension


def test_rows_read_back_as_the_same_numbers(tmp_path: Path) -> None:
    history = History(tmp_path / "history.csv")
    rows = [{"time": 0.1 * k, "energy": np.float64(k) / 3, "substeps": k} for k in range(1, 4)]
    for number, row in enumerate(rows, start=1):
        history.append(row)
        assert len(read_history(tmp_path)["time"]) == number  # on disk without a close
    history.close()
    columns = read_history(tmp_path)
    assert list(columns) == ["time", "energy", "substeps"]
    for name, values in columns.items():
        assert values.tolist() == [float(row[name]) for row in rows]


def test_a_row_with_other_columns_is_refused(tmp_path: Path) -> None:
    history = History(tmp_path / "history.csv")
    history.append({"time": 1.0})
    with pytest.raises(ValueError, match="radius"):
        history.append({"time": 2.0, "radius": 1.0})
    history.append({"time": 3.0})
    history.close()
    assert read_history(tmp_path)["time"].tolist() == [1.0, 3.0]


def test_a_row_holds_each_number_under_its_own_name() -> None:
    step = Step(3.0, 3, {"force": 2.0}, Extension(0.9, 0.8, (0.0, 0.0, 0.0)), Work(5, 6, substeps=7), 11.0, 12.0)
    equilibrium = SimpleNamespace(stored_energy=lambda: 10.0)
    measurement = SimpleNamespace(step=step, equilibrium=equilibrium)
    row = {name: column.value(measurement) for name, column in COLUMNS.items()}
    assert row == {
        "max_chain_extension": 0.9, "min_jacobian": 0.8, "stored_energy": 10.0, "remodeling_power": 11.0,
        "newton_iterations": 5, "linear_iterations": 6, "substeps": 7, "seconds": 12.0,
    }  # fmt: skip
    assert {name for name, column in COLUMNS.items() if column.after_pass} == {"remodeling_power", "seconds"}
