"""Tables of measurements as instruments write them: columns, units, rows, protocols, fractions as unknowns."""

from __future__ import annotations

from pathlib import Path
from runpy import run_path

import numpy as np
import pytest

from remodel_fenicsx import Scene, SceneError, cli, read_scene
from remodel_fenicsx.studies.fit import Measured, fit, read_measurements
from tests.conftest import forked_children, warnings_of
from tests.tables import of_csv, rows as table_rows, unescaped

DEMO = Path(__file__).parents[2] / "demos" / "biaxial"
HEAD = "Tester\nTime,Test,Cycle,X,Fx,Ty\n(s),,,(mm),(N),(N/m)\n"
LEVELS = np.array([0.0, 0.5, 1.0])
KEYS = """
columns = { protocol = "Test", elongation_x = "X", nominal_stress_x = "Fx", nominal_stress_y = "Ty" }
units = { elongation_x = "mm", nominal_stress_x = "N", nominal_stress_y = "N/m" }
length = "10 mm"
area = "5 mm^2"
thickness = "0.5 mm"
sd = { nominal_stress_x = 100.0, nominal_stress_y = 100.0 }
"""


@pytest.fixture
def sheet() -> Scene:
    """The demo's sheet, in kPa and mm."""
    return read_scene(DEMO / "scene.toml")


def instrument(folder: Path, softer: float = 1.0, peaks: tuple[float, ...] = (1.0, 2.0)) -> None:
    """Two named protocols of two cycles up to `peaks` mm, forces of 3 N/mm; unloading is softer."""
    lines = []
    for name in ("first", "second"):
        for cycle, peak in enumerate(peaks, start=1):
            for level, factor in [(x, 1.0) for x in LEVELS] + [(x, softer) for x in LEVELS[1::-1]]:
                moved = peak * level
                lines.append(f"0,{name},{cycle},{moved},{3 * factor * moved},{40 * moved}")
    (folder / "d.csv").write_text(HEAD + "\n".join(lines) + "\n")


def read(folder: Path, scene: Scene, keys: str) -> list[Measured]:
    text = '[unknowns]\n"material.lame_mu" = { start = 10.0 }\n[[measured]]\nfile = "d.csv"\n'
    (folder / "d.toml").write_text(text + keys)
    return read_measurements(folder / "d.toml", scene)[1]


@pytest.mark.parametrize(
    ("rows", "moved"),
    [
        ("'all'", 2 * [0.0, 0.5, 1.0, 0.5, 0.0, 0.0, 1.0, 2.0, 1.0, 0.0]),
        ("'last loading'", 2 * [0.0, 1.0, 2.0]),
        ("{ Cycle = 1, Test = ['second', 'third'] }", [0.0, 0.5, 1.0, 0.5, 0.0]),
    ],
)
def test_rows_in_the_units_of_the_scene(
    rows: str, moved: list[float], sheet: Scene, tmp_path: Path
) -> None:
    """mm over a length, N over an area, N/m over a thickness, by hand; kPa and mm."""
    instrument(tmp_path)
    (table,) = read(tmp_path, sheet, KEYS + f"rows = {rows}\n")
    np.testing.assert_allclose(table.columns["elongation_x"], np.divide(moved, 10.0), atol=1e-12)
    np.testing.assert_allclose(table.columns["nominal_stress_x"], np.multiply(moved, 600.0))
    np.testing.assert_allclose(table.columns["nominal_stress_y"], np.multiply(moved, 80.0))
    assert len(table.protocols) == (1 if "Cycle" in rows else 2)


@pytest.mark.parametrize("peaks", [(2.0, 2.0), (0.3, 2.0), (2.0, 1.2)])
def test_all_loadings_of_cycles_that_differ(
    peaks: tuple[float, float], sheet: Scene, tmp_path: Path
) -> None:
    """A cycle below half of the largest belongs to the next; noise of 5 % makes no cycle."""
    instrument(tmp_path, peaks=peaks)
    (table,) = read(tmp_path, sheet, KEYS + "rows = 'loading'\n")
    strain = table.columns["elongation_x"][table.protocols[2]]
    assert strain.max() == pytest.approx(max(peaks) / 10)
    assert strain[-1] == pytest.approx(peaks[-1] / 10)


@pytest.mark.parametrize(("softer", "said"), [(1.0, False), (0.98, False), (0.4, True)])
def test_hysteresis_above_the_standard_deviation_is_said(
    softer: float, said: bool, sheet: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Of the last cycle: at half of its load 360 kPa less, on the mean of three rows 1.2 times 100."""
    instrument(tmp_path, softer)
    read(tmp_path, sheet, KEYS)
    found = warnings_of(caplog)
    assert len(found) == said
    assert not said or "d.csv, nominal_stress_x: loading and unloading differ by 1.2 " in found[0]


def test_strains_of_another_kind_are_prescribed_strains(sheet: Scene, tmp_path: Path) -> None:
    """Green strain E = e + e^2 / 2, and stretches in percent; with an sd it is a measured column."""
    strain = np.array([0.1, 0.2])
    data = np.transpose([strain + strain**2 / 2, 100 * (1 + strain), [1.0, 2.0]])
    names = "green_strain_x,stretch_y,second_piola_kirchhoff_stress_x"
    np.savetxt(tmp_path / "d.csv", data, delimiter=",", header=names, comments="")
    sd, percent = "second_piola_kirchhoff_stress_x = 1.0", "units = { stretch_y = '%' }\n"
    (table,) = read(tmp_path, sheet, f"{percent}sd = {{ {sd} }}\n")
    assert {*table.loads} == {"elongation_x", "elongation_y"}
    for load in table.loads:
        np.testing.assert_allclose(table.columns[load], strain, atol=1e-12)
    (table,) = read(tmp_path, sheet, f"{percent}sd = {{ {sd}, green_strain_x = 0.1 }}\n")
    assert table.loads == ("elongation_y",)


@pytest.mark.parametrize(("old", "new", "said"), table_rows(__file__, "refused_tables.txt"))
def test_what_a_table_cannot_have_is_refused_by_its_key(
    old: str, new: str, said: str, sheet: Scene, tmp_path: Path
) -> None:
    instrument(tmp_path)
    assert old in KEYS
    with pytest.raises(SceneError, match=said) as error:
        read(tmp_path, sheet, KEYS.replace(old, unescaped(new), 1))
    assert "max_chain_extension" not in str(error.value)


def test_the_file_of_an_instrument_is_fitted_and_predicts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Fractions too, with a known stiffness; from two protocols the third is predicted."""
    truth: dict[str, float] = run_path(str(DEMO / "instrument.py"))["TRUTH"]
    words = ["fit", str(DEMO / "scene.toml"), str(tmp_path / "instrument.toml"), "-q"]
    text = (DEMO / "instrument.toml").read_text()
    text = text.replace('"material.initial_stiffness" = { start = 40.0 }', "")
    words += ["--set", f"material.initial_stiffness={truth.pop('material.initial_stiffness')}"]
    (tmp_path / "instrument.csv").write_bytes((DEMO / "instrument.csv").read_bytes())
    (tmp_path / "instrument.toml").write_text(f"{text}protocols = [1, 2]\n")
    with forked_children():
        words += ["--starts", "1", "--no-likelihood-profiles", "-o", str(tmp_path / "out")]
        assert cli.main(words) == 0
    table = {row["key"]: row for row in of_csv(tmp_path / "out" / "fit.csv")}
    assert {*table} == {*truth}
    for key, row in table.items():
        assert float(row["value"]) == pytest.approx(truth[key], rel=0.5), key
    said = capsys.readouterr().out
    (line,) = (line for line in said.splitlines() if "protocol 3, predicted: R²" in line)
    assert float(line.split("R² ")[1].split()[0]) > 0.98


def test_the_truth_lies_within_the_intervals_of_fractions_near_their_bound(tmp_path: Path) -> None:
    """The fitted fractions have a sum of 1, which no point of a profile may exceed."""
    demo = run_path(str(DEMO / "instrument.py"))
    truth = {"material.initial_stiffness": 60.0, "cells.fraction_x": 0.6, "cells.fraction_y": 0.395}
    scene = read_scene(DEMO / "scene.toml").with_values(demo["TRUTH"] | truth)
    strains, forces = demo["PROTOCOLS"].values(), demo["forces"]
    stress = 50.0 * np.concatenate([forces(scene, one)[1::2] for one in strains])  # kPa of N
    noise = np.random.default_rng(4).normal(0.0, 0.3, stress.T.shape).T
    levels = np.concatenate([np.outer(demo["LEVELS"][1::2], one) for one in strains])
    names = "elongation_x,elongation_y,nominal_stress_x,nominal_stress_y"
    data = np.hstack([levels, stress + noise])
    np.savetxt(tmp_path / "d.csv", data, delimiter=",", header=names, comments="")
    starts = zip(truth, (40.0, 0.4, 0.4))
    unknowns = "".join(f'"{key}" = {{ start = {start} }}\n' for key, start in starts)
    table = (
        "[[measured]]\nfile = 'd.csv'\nsd = { nominal_stress_x = 0.3, nominal_stress_y = 0.3 }\n"
    )
    (tmp_path / "data.toml").write_text(f"[unknowns]\n{unknowns}{table}")
    with forked_children():
        _, found = fit(scene, tmp_path / "data.toml", tmp_path / "out", starts=1)
    assert found.values[1:].sum() == pytest.approx(1.0, abs=1e-3) and found.values[1:].sum() <= 1.0
    for row in of_csv(tmp_path / "out" / "fit.csv"):
        assert row["method"] == "profile"
        assert float(row["lower"]) < truth[row["key"]] < float(row["upper"]), row
