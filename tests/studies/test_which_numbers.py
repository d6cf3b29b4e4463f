"""The script of demos/which_numbers.py: numbers of papers, closed forms, and this model's own sheet."""

from __future__ import annotations

import runpy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Scene
from tests.runs import rows_of
from tests.tables import rows as table
from tests.values import ramp_to

SCRIPT = runpy.run_path(str(Path(__file__).parents[2] / "demos" / "which_numbers.py"))
ABSURD = "--k1 996.6 --k2 524.6 --kappa 0.226 --c 7.64 --angle 49.98 --up-to 1.3"
PAPER = "--k1 2.4 --k2 0.84 --kappa 0.2 --c 3.0 --angle 40 --up-to 1.3"


def printed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], str]:
    """Its tables, and the misfit."""
    SCRIPT["main"](arguments)
    tables, _, misfit = capsys.readouterr().out.partition("\nmisfit")
    return tomllib.loads(tables), misfit


def test_the_stress_of_papers_is_the_slope_of_their_energy() -> None:
    """Of two families, each with its own I, by differences; kappa (I1 - 3) + (1 - 3 kappa)(I - 1)."""
    k1, k2, kappa, c, angle = 2.4, 0.84, 0.2, 3.0, np.radians(40)
    families = [np.array([np.cos(turn), np.sin(turn), 0.0]) for turn in (angle, -angle)]

    def energy(stretches: np.ndarray) -> float:
        squared = stretches**2
        strains = [
            kappa * (squared.sum() - 3) + (1 - 3 * kappa) * (squared @ a**2 - 1) for a in families
        ]
        return c / 2 * (squared.sum() - 3) + sum(
            k1 / (2 * k2) * (np.exp(k2 * E**2) - 1) for E in strains
        )

    cells = kappa + (1 - 3 * kappa) * families[0] ** 2
    at = np.array([1.2, 1.1, 1 / 1.32])
    slopes = [(energy(at + h) - energy(at - h)) / 2e-6 for h in 1e-6 * np.eye(3)]
    np.testing.assert_allclose(
        SCRIPT["of_papers"](k1, k2, cells, kappa, c)(at), at * slopes, rtol=1e-7
    )


def test_the_sheet_of_its_numbers_has_the_stresses_of_the_paper(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Equibiaxial and uniaxial, as `remodel-fenicsx run` has them: within the misfit that it prints."""
    tables, misfit = printed(PAPER.split(), capsys)
    share = float(misfit.split("largest stress: ")[1].split(" %")[0]) / 100
    assert 0.001 < share < 0.03
    cells = np.array(
        [0.2 + 0.4 * np.cos(np.radians(40)) ** 2, 0.2 + 0.4 * np.sin(np.radians(40)) ** 2, 0.2]
    )
    np.testing.assert_allclose(tables["cells"]["initial"], np.sqrt(cells), rtol=1e-6)
    tables["material"]["lame_lambda"] *= 100  # incompressible, as the paper's
    stress = SCRIPT["of_papers"](2.4, 0.84, cells, 0.2, 3.0)
    for across in (True, False):
        pulled = {"value": 0.3, "ramp": ramp_to(6.0)}
        loads = {"elongation_x": pulled} | ({"elongation_y": pulled} if across else {})
        sheet = {
            "geometry": {"shape": "sheet"},
            "loads": loads,
            "time": {"end": 6.0},
            "remodeling": {"law": "none"},
        }
        rows = rows_of(Scene(**sheet, **tables))
        wanted = [SCRIPT["nominal"](stress, 1 + row["elongation_x"], 1 + row["elongation_x"] if across else None)
                  for row in rows]  # fmt: skip
        found = [[row["nominal_stress_x"], row["nominal_stress_y"]] for row in rows]
        np.testing.assert_allclose(found, wanted, atol=4 * share * np.max(wanted))


def test_a_table_of_this_model_gives_its_numbers_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Equibiaxial rows and, in another file, uniaxial ones; the matrix too."""
    cells = np.full(3, 1 / 3)
    stress = SCRIPT["of_chains"](4.0, 1.5, cells, 12.0)
    for across in (True, False):
        lines = ["stretch_x,nominal_stress_x" + (",stretch_y,nominal_stress_y" if across else "")]
        for x in np.linspace(1.02, 1.3, 6):
            P = SCRIPT["nominal"](stress, x, 1.1 if across else None)
            lines.append(f"{x},{P[0]}" + (f",1.1,{P[1]}" if across else ""))
        (tmp_path / "test.csv").write_text("\n".join(lines))
        tables, misfit = printed(["--table", str(tmp_path / "test.csv"), "--unit", "Pa"], capsys)
        assert tables["material"]["lame_mu"] == pytest.approx(12.0, rel=1e-3)
        assert tables["material"]["contour_length"] == pytest.approx(1.5, rel=1e-3)
        own = Scene(
            geometry={"shape": "cube"}, time={"end": 1.0}, material=tables["material"]
        ).material
        assert own.network_modulus == pytest.approx(4.0, rel=2e-3) and own.stress_unit == "Pa"
        assert "along x" in misfit and ("along y" in misfit) is across


@pytest.mark.parametrize(("words", "line"), table(__file__, "refused_numbers.txt"))
def test_what_is_refused(
    words: str,
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.csv").write_text("stretch_x,force\n1.1,2.0\n")
    Path("low.csv").write_text("stretch_x,nominal_stress_x\n1.1,2.0\n0.0,0.0\n")
    stretches = np.linspace(1.02, 1.3, 10)
    for name, stresses, shown in (
        ("percent", stretches, 100 * stretches), ("strains", stretches, stretches - 1),
        ("line", stretches - stretches**-2, stretches), ("toe", (stretches - 1) ** 3, stretches),
        ("steep", np.expm1(90 * (stretches - 1)), stretches),
    ):  # fmt: skip
        rows = "".join(f"{x},{stress}\n" for x, stress in zip(shown, stresses, strict=True))
        Path(f"{name}.csv").write_text(f"stretch_x,nominal_stress_x\n{rows}")
    Path("half.csv").write_text("stretch_x\n1.1\n1.2\n")
    with pytest.raises(SystemExit) as left:
        SCRIPT["main"](words.replace("PAPER", PAPER).replace("ABSURD", ABSURD).split())
    said = capsys.readouterr().err
    assert left.value.code == 2 and f"error: {line}" in said and said.count("\n") == 1


def test_the_largest_stretch_that_it_names_is_taken(capsys: pytest.CaptureFixture[str]) -> None:
    """Its stresses are at most six decades over those at 1.01; what is assumed is said, and the bulk is stiff."""
    tables, _ = printed([*ABSURD.split()[:-1], "1.139"], capsys)
    found, cells = tables["material"], SCRIPT["np"].square(tables["cells"]["initial"])
    stress = SCRIPT["of_papers"](996.6, 524.6, cells, 0.226, 7.64)
    high, small = (np.max(SCRIPT["nominal"](stress, x, x)) for x in (1.139, 1.01))
    assert 1e5 < high / small < 1e6 and found["lame_lambda"] > 100 * found["lame_mu"]
    SCRIPT["main"](PAPER.split())
    said = capsys.readouterr().out
    assert said.startswith(
        "# Assumed: cells of dispersion kappa = 0.2, families at +-40 degrees to x; a volume that"
    )
