"""Numbers of a scene from measurements: recovered from own rows, blind directions named, bad data refused."""

from __future__ import annotations

import csv
import re
import shlex
import shutil
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Scene, SceneError, Simulation, cli, preset_scene, read_scene
from remodel_fenicsx.schema.settings import STRESS_UNITS
from remodel_fenicsx.simulation import reset_simulation
from remodel_fenicsx.studies.fit import Problem, data_warnings, fit, minimised, read_measurements
from tests.conftest import Refused, forked_children, warnings_of
from tests.runs import last_row, rows_of
from tests.tables import of_csv, rows
from tests.values import ramp_to, ramped

ROOT, FITS = Path(__file__).parents[2], Path(__file__).with_name("fits")
TRUTH = {"material.lame_mu": 3.0, "material.chain_density": 2e21, "remodeling.kappa": 0.05}
PRESSURES = [0.2, 0.4, 0.6, 0.8, 1.0, 1.2]

PER_MMHG = (
    STRESS_UNITS[preset_scene("kuhl-holzapfel-2007", "tube").material.stress_unit] / 133.322387415
)


def tube(**changes: Any) -> Scene:
    """A thin tube of isotropic cells on one radius, with the true numbers."""
    values = {
        "cells.initial": "isotropic", "model.kinematics": "radial", "geometry.outer_radius": 1.3, "mesh.degree": 2,
        "loads.pressure.value": 1.2, "remodeling.law": "tensor", "time.end": 40.0, "time.step": 5.0,
        "geometry.length_unit": "mm", "material.repulsion": "log",
    }  # fmt: skip
    return preset_scene("kuhl-holzapfel-2007", "tube").with_values(values | TRUTH | changes)


def inflated() -> list[dict[str, float]]:
    """Virgin tissue under rising pressure at once with the whole elongation."""
    ramp = [[0.0, 0.0], *([number + 1.0, p / 1.2] for number, p in enumerate(PRESSURES))]
    changes = {
        "remodeling.law": "none",
        "time.end": 6.0,
        "time.step": 1.0,
        "loads.pressure.ramp": ramp,
    }
    return rows_of(tube(**changes, **{"loads.elongation.ramp": ramp_to(1.0)}))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scene, tables of the model's own rows, and what is to be fitted, from starts that are off by a third."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "scene.toml").write_text(tube().to_toml())
    virgin = [
        [p * PER_MMHG, row["outer_radius"]] for p, row in zip(PRESSURES, inflated(), strict=True)
    ]
    kept = [row for row in rows_of(tube()) if row["time"] in (10.0, 20.0, 30.0, 40.0)]
    names = ["time", "fibre_angle_outer", "inner_radius"]
    tables = {"virgin": [["pressure", "outer_radius"], *virgin]}
    tables["history"] = [names, *([row[name] for name in names] for row in kept)]
    for name, table in tables.items():
        (folder / f"{name}.csv").write_text(
            "".join(",".join(map(str, row)) + "\n" for row in table)
        )
    (folder / "data.toml").write_text(DATA)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """The same, for a test to change."""
    return Path(shutil.copytree(made, tmp_path, dirs_exist_ok=True))


def written(
    folder: Path,
    starts: Mapping[str, float | str],
    file: str,
    sd: str,
    state: str = "state = 'virgin'",
) -> Path:
    """A DATA.toml of one table."""
    unknowns = "\n".join(f'"{key}" = {{ start = {start} }}' for key, start in starts.items())
    text = f"[unknowns]\n{unknowns}\n[[measured]]\nfile = '{file}'\n{state}\nsd = {{ {sd} }}\n"
    (folder / "data.toml").write_text(text)
    return folder / "data.toml"


DATA = (FITS / "three.toml").read_text()


@pytest.fixture(autouse=True)
def parts_are_forks() -> Iterator[None]:
    """Of all fits here."""
    with forked_children():
        yield


def test_the_numbers_that_made_the_data_are_found(
    folder: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    """From most starts; the tables, the picture and a scene that runs are there."""
    out = folder / "out"
    words = ["fit", str(folder / "scene.toml"), str(folder / "data.toml"), "-o", str(out)]
    words += ["--starts", "3", "-q", "--no-likelihood-profiles"]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    assert "2 of 3 starts end in this minimum" in said
    table = of_csv(out / "fit.csv")
    assert [row["key"] for row in table] == list(TRUTH)
    for row in table:
        assert float(row["value"]) == pytest.approx(TRUTH[row["key"]], rel=1e-3)
        assert float(row["lower"]) < float(row["value"]) < float(row["upper"])
    fitted = read_scene(out / "scene.toml")
    assert fitted.material.lame_mu == pytest.approx(3.0, rel=1e-3) and fitted.time.end == 40.0
    assert (out / "fit.png").stat().st_size > 10_000
    (folder / "data.toml").write_text(DATA.replace("outer_radius = 0.01", "outer_radius = 0.02"))
    assert "holds a fit of another scene, data or version" in refused(*words)
    (folder / "own").mkdir()
    (folder / "own" / "notes.txt").write_text("mine")
    refused(*words[:4], folder / "own", "-q")  # nothing of the user's is written over


def test_a_fit_goes_on_where_it_was_killed(folder: Path) -> None:
    """With the same evaluations, each made once, and the same numbers; a line that was cut off is made again."""
    scene, data = read_scene(folder / "scene.toml"), folder / "data.toml"
    data.write_text(PAIR)
    fit(scene, data, folder / "whole", starts=1, profiles=False)
    lines = (folder / "whole" / "evaluations.jsonl").read_text().splitlines(keepends=True)
    (folder / "cut").mkdir()
    (folder / "cut" / "evaluations.jsonl").write_text("".join(lines[:-4]) + '{"at": [1.0, ')
    fit(scene, data, folder / "cut", starts=1, profiles=False)
    again = (folder / "cut" / "evaluations.jsonl").read_text().splitlines(keepends=True)
    assert len(lines) > 10 and sorted(again) == sorted(lines)
    assert (folder / "cut" / "fit.csv").read_text() == (folder / "whole" / "fit.csv").read_text()


def test_profiles_of_what_goes_together(folder: Path) -> None:
    """Stiffness and locking of the chains, of an inflation: at the band's ends the sum of squares is 3.84 higher."""
    (folder / "data.toml").write_text(
        PAIR.replace("0.01", "0.04")
    )  # wide bands, far from a straight line
    _, found = fit(
        read_scene(folder / "scene.toml"), folder / "data.toml", folder / "out", starts=1
    )
    assert set(found.profiles) == {"material.chain_density", "material.contour_length"}
    lower, upper = found.profiles["material.contour_length"]
    assert lower < found.values[1] < upper
    problem = Problem(
        read_scene(folder / "scene.toml"), *read_measurements(folder / "data.toml", found.scene)
    )
    held = np.log([found.values[0], upper])
    again = minimised(problem, held, held=1)
    least = float(np.sum(problem.residuals(np.log(found.values)) ** 2))
    assert 2 * again.cost - least == pytest.approx(3.84, rel=0.03)
    (panel,) = found.figure().axes[:1]
    assert panel.get_xlabel() == "pressure, mmHg" and panel.get_ylabel() == "outer radius, mm"
    np.testing.assert_allclose(panel.lines[0].get_xdata(), np.multiply(PRESSURES, PER_MMHG))
    wide = replace(
        found, covariance=1e6 * found.covariance, profiles={}
    )  # as of what the data hardly change: no overflow
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert wide.open == ["both", "both"]
        np.testing.assert_allclose(wide.band, found.problem.bounds.T)
    row = of_csv(folder / "out" / "fit.csv")[1]
    assert row["method"] == "profile" and float(row["upper"]) == pytest.approx(upper, rel=1e-6)


PAIR = (FITS / "pair.toml").read_text()


def test_the_picture_has_panels_for_each_protocol(tmp_path: Path) -> None:
    """Three in a file, one of them unloaded slowly: each stress over its own axis, points and model in their order."""
    scene = read_scene(ROOT / "demos" / "sheet.toml").with_values({"material.chain_density": 0.0})
    protocols = [[(0.1, 0.1), (0.2, 0.2)], [(0.0, 0.0), (0.1, 0.05), (0.2, 0.1)],
                 [(0.02, 0.04), (0.05, 0.1), (0.03, 0.06), (0.01, 0.02)]]  # fmt: skip
    strains = np.concatenate(protocols)
    lines = [f"{1 + x},{1 + y},{60 * x},{50 * y}\n" for x, y in strains]
    (tmp_path / "d.csv").write_text(
        "stretch_x,stretch_y,nominal_stress_x,nominal_stress_y\n" + "".join(lines)
    )
    sd = "nominal_stress_x = 1.0, nominal_stress_y = 1.0"
    found = fit(
        scene, written(tmp_path, {"material.lame_mu": 10.0}, "d.csv", sd), tmp_path / "o", starts=1
    )[1]
    panels = [panel for panel in found.figure().axes if panel.axison]
    assert [panel.get_title() for panel in panels[::2]] == [
        f"d.csv (virgin), protocol {n}" for n in (1, 2, 3)
    ]
    for axis, name in enumerate(("nominal_stress_x", "nominal_stress_y")):
        points, model = ([panel.lines[n] for panel in panels[axis::2]] for n in (0, 1))
        assert [len(line.get_xdata()) for line in points] == [
            len(protocol) for protocol in protocols
        ]
        for shown in (points, model):
            np.testing.assert_allclose(
                np.concatenate([line.get_xdata() for line in shown]), strains[:, axis], atol=1e-12
            )
        y = [np.concatenate([line.get_ydata() for line in shown]) for shown in (points, model)]
        np.testing.assert_allclose(
            y, [(60, 50)[axis] * strains[:, axis], found.modelled[0][name]], atol=1e-9
        )


def test_bands_end_at_bounds_and_know_what_limits_them(tmp_path: Path) -> None:
    """A curve that the matrix cannot follow: its band is one, whatever deviation is claimed; a bound says which end."""
    scene = read_scene(ROOT / "demos" / "sheet.toml").with_values({"material.chain_density": 0.0})
    (tmp_path / "d.csv").write_text("elongation_x,nominal_stress_x\n0.05,1.0\n0.1,4.0\n0.2,30.0\n")
    found = {}
    for name, sd, upper in (
        ("a", 0.5, 1e3),
        ("b", 0.05, 1e3),
        ("noise", 50.0, 1e3),
        ("bound", 0.5, 30.0),
    ):
        data = written(
            tmp_path,
            {"material.lame_mu": f"10.0, upper = {upper}"},
            "d.csv",
            f"nominal_stress_x = {sd}",
        )
        found[name] = fit(scene, data, tmp_path / name, starts=1)[1]
    for name, one in found.items():
        assert one.limited_by == ("noise" if name == "noise" else "model")
        assert ("The model, not the noise, limits the accuracy" in one.in_words()) is (
            name != "noise"
        )
    np.testing.assert_allclose(found["a"].band, found["b"].band, rtol=1e-3)
    assert (
        found["a"].open == [""] and found["a"].band[0] < found["a"].logarithms < found["a"].band[1]
    )
    assert found["bound"].open == ["upper"] and found["bound"].values == pytest.approx([30.0])


def test_an_interval_leaves_a_bound_near_which_the_unknown_has_no_effect(tmp_path: Path) -> None:
    """Few chains are the best for no stress; the other end is where the sum of squares says."""
    (tmp_path / "d.csv").write_text("elongation_x,nominal_stress_x\n0.05,0\n0.1,0\n0.2,0\n")
    unknown = {"material.initial_stiffness": "1.0, lower = 1e-4, upper = 1e4"}
    data = written(tmp_path, unknown, "d.csv", "nominal_stress_x = 5.0")
    scene = read_scene(ROOT / "demos" / "sheet.toml")
    found = fit(scene, data, tmp_path / "found", starts=1, profiles=True)[1]
    assert found.open == ["lower"] and found.misfit < 1.5
    least, there = (
        np.sum(found.problem.residuals(logarithms) ** 2)
        for logarithms in (found.logarithms, found.band[1])
    )
    assert there - least == pytest.approx(3.8415, rel=0.05)


def test_what_changes_nothing_is_named(folder: Path) -> None:
    """A rate of remodeling in a test of virgin tissue."""
    text = PAIR.replace(
        '"material.contour_length" = { start = 2.125 }', '"remodeling.kappa" = { start = 0.05 }'
    )
    (folder / "data.toml").write_text(text)
    with pytest.raises(
        SceneError, match="remodeling.kappa changes nothing that is measured; fix it"
    ):
        fit(read_scene(folder / "scene.toml"), folder / "data.toml", folder / "out")


EVERY = (FITS / "every.toml").read_text()


def of_every_state(folder: Path, scene: Scene, more: str = "") -> Problem:
    """A number of each kind, and one more, from the first rows of the tables of each state."""
    for name, count in (("virgin", 3), ("history", 2)):
        table = folder / f"{name}.csv"
        table.write_text("".join(table.read_text().splitlines(keepends=True)[: 1 + count]))
    (folder / "after.csv").write_text(
        "pressure,inner_radius,reduced_axial_force\n0.6,1.2,0.5\n1.2,1.3,0.1\n"
    )
    (folder / "every.toml").write_text(EVERY.replace("[unknowns]\n", f"[unknowns]\n{more}\n"))
    return Problem(scene, *read_measurements(folder / "every.toml", scene))


def test_derivatives_are_those_of_the_model(folder: Path) -> None:
    """Taylor remainders fall by four where the step is halved."""
    problem = of_every_state(folder, tube())
    x = np.log([unknown.start for unknown in problem.unknowns.values()])
    found, way = problem.jacobian(x, central=True), np.random.default_rng(2).normal(size=len(x)) / 3
    present = problem.residuals(x)
    sizes = (0.02, 0.01, 0.005)
    remainders = [
        np.linalg.norm(problem.residuals(x + h * way) - present - h * found @ way) for h in sizes
    ]
    ratios = np.divide(remainders[:-1], remainders[1:])
    assert np.abs(ratios - 4.0).max() < 0.1, ratios


@pytest.mark.parametrize(
    ("changes", "more"),
    [
        (
            {"natural.opening_angle": 60.0, "remodeling.coupling": "extrapolated"},
            '"natural.opening_angle" = { start = 60.0 }',
        ),
        (
            {
                "regions": {
                    "inside": {"outer_radius": 1.1, "material": {"lame_mu": 2.0}},
                    "outside": {},
                }
            },
            '"regions.inside.material.lame_mu" = { start = 2.0 }',
        ),
        ({"time.tolerance": 4.0, "solver.maximum_halvings": 2}, ""),
        ({}, '"geometry.outer_radius" = { start = 1.3 }'),
    ],
    ids=["closing", "regions", "chosen steps", "geometry"],
)
def test_a_simulation_that_stays_says_what_a_new_one_does(
    folder: Path, changes: dict[str, Any], more: str
) -> None:
    """With other numbers in between, and after a run that has failed."""
    problem = of_every_state(folder, tube(**changes), more)
    x = np.log([unknown.start for unknown in problem.unknowns.values()])
    for far in (0.1, 4.0):
        problem.residuals(x + far)
    for found, fresh in zip(
        problem.predictions(x + 0.02, problem.kept), problem.predictions(x + 0.02), strict=True
    ):
        for name in fresh:
            np.testing.assert_allclose(found[name], fresh[name], rtol=1e-9)


def test_a_passive_test_of_remodeled_tissue(folder: Path) -> None:
    """Cells of t = 40 that stay: at the loads of the run's own end it has the radii of the run's own next row."""
    end = tube(**{"time.end": 45.0})
    expected = rows_of(end)[-1]
    (folder / "after.csv").write_text(
        "pressure,outer_radius,inner_radius\n0.6,1.4,1.2\n1.2,1.4,1.2\n"
    )
    sd, state = "outer_radius = 0.01, inner_radius = 0.01", "state = 'after'\ntime = 40.0"
    data = written(folder, {"material.lame_mu": 3.0}, "after.csv", sd, state)
    problem = Problem(end, *read_measurements(data, end))
    found = problem.predictions(np.log([3.0]))[0]
    assert found["outer_radius"][-1] == pytest.approx(expected["outer_radius"], rel=1e-8)
    assert found["inner_radius"][-1] == pytest.approx(expected["inner_radius"], rel=1e-8)
    virgin = inflated()[-1]
    assert (
        abs(found["inner_radius"][-1] - virgin["inner_radius"]) > 1e-3
    )  # and not those of virgin tissue


def test_what_the_data_cannot_tell_apart_is_named(folder: Path) -> None:
    """Only n / A_p is in the energy; without a force all moduli go with the scale of the pressure."""
    scene = read_scene(folder / "scene.toml")
    virgin = '[[measured]]\nfile = "virgin.csv"\nsd = { outer_radius = 0.01 }\nunits = { pressure = "mmHg" }\n'
    path = folder / "blind.toml"
    path.write_text(
        '[unknowns]\n"material.chain_density" = { start = 1e21 }\n"material.persistence_length" = { start = 1.82 }\n'
        + virgin
    )
    with pytest.raises(
        SceneError,
        match=r"identifiable: scaling material.chain_density by s\^.0.71 and material.persistence_l",
    ):
        fit(scene, path, folder / "blind")
    moduli = "".join(
        f'"material.{name}" = {{ start = {getattr(scene.material, name)} }}\n' for name in MODULI
    )
    path.write_text(f'[unknowns]\n{moduli}{virgin}scale = {{ pressure = "unknown" }}\n')
    with pytest.raises(SceneError, match=r"lame_mu.*chain_density.*scale.pressure are not id"):
        fit(scene, path, folder / "blind")
    assert not (folder / "blind").exists()


MODULI = ("lame_lambda", "lame_mu", "chain_density")


@pytest.mark.parametrize(("old", "new", "named"), rows(str(FITS / "x"), "refused.txt"))
def test_bad_data_is_one_line(
    folder: Path, old: str, new: str, named: str, refused: Refused
) -> None:
    """Exit code 2, before any solve, and nothing is written."""
    (folder / "bad.csv").write_text("pressure,outer_radius\n1,1.3\n2,nan\n")
    (folder / "short.csv").write_text("pressure,outer_radius\n1\n")
    (folder / "twice.csv").write_text("pressure,outer_radius,Outer_Radius\n1,1.3,1.4\n")
    (folder / "other.csv").write_text("pressure,diameter\n1,1.3\n2,1.4\n")
    assert old in DATA, old
    (folder / "data.toml").write_text(DATA.replace(old, new, 1))
    assert named in refused(
        "fit", folder / "scene.toml", folder / "data.toml", "-o", folder / "out", "-q"
    )
    assert not (folder / "out").exists()


def test_the_page_leads_from_a_curve_to_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """docs/fit.md: its files and commands and its fit as they stand; the numbers are the page's."""
    monkeypatch.chdir(tmp_path)
    page = files_of_the_page(tmp_path)
    (block,) = re.findall(r"^```sh\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (line,) = (line for line in block.splitlines() if " fit " in line)
    assert (
        cli.main(
            [
                *shlex.split(line.removeprefix("./with-fenicsx remodel-fenicsx ")),
                "-q",
                "--starts",
                "1",
            ]
        )
        == 0
    )
    assert not re.search("does not follow|without load|mmHg in", Path("found/fit.log").read_text())
    table = {row["key"]: row for row in of_csv(Path("found/fit.csv"))}
    said = re.findall(r"^\| `(\w+)` \| ([\d.]+).* \| ([\d.]+) to ([\d.]+) \|$", page, re.MULTILINE)
    assert len(said) == 3
    for key, value, low, high in said:
        found = table[f"material.{key}"]
        for name, number in (("value", value), ("lower", low), ("upper", high)):
            assert float(found[name]) == pytest.approx(float(number), rel=1e-2), key
    assert len(table) == 3


def stretched(network: dict[str, float]) -> Scene:
    """A strip of tissue whose chains lie along a force."""
    return Scene(
        name="strip",
        geometry={"shape": "cube"},
        model={"kinematics": "point"},
        material={
            "stress_unit": "Pa",
            "lame_lambda": 2e4,
            "lame_mu": 200.0,
            "initial_stiffness": 200.0,
            **network,
        },
        cells={"initial": "aligned"},
        loads=ramped(10.0, force=4184.0),
        remodeling={"law": "none"},
        time={"end": 10.0},
    )


@pytest.mark.parametrize(("key", "start"), [("locking_stretch", 1.4), ("contour_length", 1.4)])
def test_a_fit_stays_in_the_range_of_a_key(key: str, start: float, tmp_path: Path) -> None:
    """From some starts a trial has chains that are shorter than their ends are apart; the end is not at an edge."""
    shutil.copy(FITS / "curve.csv", tmp_path)
    keys = {
        "material.lame_mu": 200.0,
        "material.initial_stiffness": 200.0,
        f"material.{key}": start,
    }
    data = written(tmp_path, keys, "curve.csv", "mean_stretch = 0.005")
    found = fit(stretched({key: start}), data, tmp_path / "out", profiles=False)[1]
    assert found.misfit < 1.3 and found.values[2] == pytest.approx(1.224, rel=2e-3)


def test_bounds_are_those_of_the_key(folder: Path, refused: Refused) -> None:
    """A step before an open end; radii that are fitted together may pass each other's start; what is typed is refused.

    At a bound the difference of two runs is taken on its inner side.
    """
    scene, path, kappa = (
        read_scene(folder / "scene.toml"),
        folder / "data.toml",
        '"remodeling.kappa" = { start = 0.035 }',
    )

    def unknowns(*lines: str) -> list[Any]:
        path.write_text(DATA.replace(kappa, "\n".join(lines)))
        return [*read_measurements(path, scene)[0].values()]

    inner, outer = (
        '"geometry.inner_radius" = { start = 1.0 }',
        '"geometry.outer_radius" = { start = 1.3 }',
    )
    one = unknowns(inner)[-1]
    assert one.lower == 1e-3 and 1.298 < one.upper < 1.3
    problem = Problem(scene, *read_measurements(path, scene))
    x = np.log([*(unknown.start for unknown in problem.unknowns.values())][:-1] + [one.upper])
    assert (
        np.abs(problem.jacobian(x, central=True)[:, -1]).max() < 1e5
    ), "no row is that of a state without equilibrium"
    low, high = unknowns(inner, outer)[-2:]
    assert low.upper > 1.3 and high.lower < 1.0
    assert unknowns(kappa.replace(" }", ", lower = 0.01, upper = 0.04 }"))[-1].upper == 0.04
    stretch = '"material.locking_stretch" = { start = 2.0 }'
    assert 1.0 < unknowns(stretch)[-1].lower < 1.001
    path.write_text(DATA.replace(kappa, stretch.replace(" }", ", lower = 0.9 }")))
    said = refused("fit", folder / "scene.toml", path, "-o", folder / "out", "-q")
    assert "material.locking_stretch = 0.9: " in said and not (folder / "out").exists()


def files_of_the_page(folder: Path) -> str:
    """The section of docs/fit.md on a measured curve; its files are written into a folder."""
    page = (ROOT / "docs" / "fit.md").read_text(encoding="utf-8")
    page = page[page.index("## A measured pressure-radius curve") : page.index("## The two files")]
    for name, text in re.findall(
        r"^```(?:text|toml)\n# (\S+)\n(.*?)^```", page, re.MULTILINE | re.DOTALL
    ):
        (folder / name).write_text(text)
    return page


@pytest.mark.parametrize("guess", [4.0, 200.0])
@pytest.mark.parametrize(
    ("old", "new", "factor", "said"),
    [
        ("mm", "mm", 1, ""),
        ("mm", "mm", 2, "radius: 7.752 at .* is 2.08 times .* 3.7.* without load; are they diameters?"),
        ('radius = "mm', 'radius = "cm', 1, "radius: 38.76 at .* is 10.4 times .* 3.7.* another unit"),
        ("mmHg", "kPa", 1, "pressure: 450 mmHg in .* See units"),
        ("mmHg", "Pa", 1, "pressure: 0.45 mmHg in .* See units"),
        ("0.03", "2e-5", 1, "radius: sd = 2e-05, far below its range 2.68; is it"),
    ],
)  # fmt: skip
def test_a_fit_warns_of_another_unit_whatever_the_guess(
    old: str, new: str, factor: int, said: str, guess: float,
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """The tissue of the guess may be soft or stiff; in the end the model does not follow the data."""
    files_of_the_page(tmp_path)
    scene, data, curve = (tmp_path / name for name in ("inflated.toml", "curve.toml", "curve.csv"))
    scene.write_text(re.sub(r'"\d+ kPa', f'"{guess} kPa', scene.read_text()))
    table = data.read_text().partition("[[measured]]")[2].replace(old, new)
    unknown = f'"material.lame_mu" = {{ start = {guess} }}'
    data.write_text(f"[unknowns]\n{unknown}\n[[measured]]{table}")
    rows = [
        f"{pressure},{factor * float(radius)}"
        for pressure, radius in (line.split(",") for line in curve.read_text().split()[1::5])
    ]
    curve.write_text("\n".join(["pressure,outer_radius", *rows]))
    words = f"fit {scene} {data} --starts 1 --no-likelihood-profiles -q -o {tmp_path}/out"
    assert cli.main(words.split()) == 0
    lines = re.findall(r".*curve\.csv.*", capsys.readouterr().err)
    assert len(lines) == 1 + bool(said)
    assert re.search(f"{said}.* does not follow", " ".join(lines))


@pytest.mark.parametrize(
    ("name", "factor", "said"),
    [
        ("outer_radius", 2.0, "are they diameters?"),
        ("outer_radius", 1e-3, "geometry.length_unit?"),
        ("inner_radius", 10.0, "geometry.length_unit?"),
        ("fibre_angle_outer", np.pi / 180, "radians? Angles must be in degrees"),
        ("outer_radius", 1.1, ""),
    ],
)
def test_numbers_of_another_kind_are_doubted(
    name: str, factor: float, said: str, folder: Path
) -> None:
    """Judged against the model at the start."""
    path = folder / ("virgin.csv" if name == "outer_radius" else "history.csv")
    table = list(csv.reader(path.read_text().splitlines()))
    column = table[0].index(name)
    for row in table[1:]:
        row[column] = str(factor * float(row[column]))
    path.write_text("\n".join(map(",".join, table)))
    scene = read_scene(folder / "scene.toml")
    problem = Problem(scene, *read_measurements(folder / "data.toml", scene))
    at_start = problem.predictions(np.log([unknown.start for unknown in problem.unknowns.values()]))
    found = [*data_warnings(problem.tables, at_start, scene)]
    assert len(found) == bool(said) and all(
        f"{path.name}, {name}: " in line and said in line for line in found
    )


@pytest.mark.parametrize(
    ("column", "numbers", "said"),
    [
        ("elongation_x", (-2, -30), "reaches 30: percent?"),
        ("elongation_x", (0.9993, 1.3), "reaches 1.3: a stretch?"),
        ("stretch_x", (0.02, 0.3), "begins at 0.02: strains?"),
        ("stretch_x", (102, 130), "reaches 130: percent?"),
        ("elongation_x", (-0.3, 0.7), ""),
    ],
)
def test_loads_of_another_kind_are_doubted(
    column: str,
    numbers: tuple[float, float],
    said: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Before any solve, which may fail because of them."""
    (tmp_path / "d.csv").write_text(
        f"{column},nominal_stress_x\n{numbers[0]},1.0\n{numbers[1]},2.0\n"
    )
    data = written(tmp_path, {"material.lame_mu": 3.0}, "d.csv", "nominal_stress_x = 0.1")
    read_measurements(data, read_scene(ROOT / "demos" / "sheet.toml"))
    found = warnings_of(caplog)
    assert len(found) == bool(said) and all(
        line.startswith(f"d.csv, {column}: {said}") for line in found
    )


def test_virgin_tissue_whose_collagen_will_be_turned_over(tmp_path: Path) -> None:
    """It is as without turnover; what a scene records beside does not matter. A test after turnover is refused."""
    scene = read_scene(ROOT / "demos" / "turnover.toml").with_values(
        {"output.fields": ["content", "fibre_angle"]}
    )
    (tmp_path / "d.csv").write_text("pressure,outer_radius\n0.6,1.35\n1.2,1.5\n")
    data = written(tmp_path, {"material.lame_mu": 3.0}, "d.csv", "outer_radius = 0.1")
    found, other = (
        Problem(each, *read_measurements(data, each)).residuals(np.log([3.0]))
        for each in (scene, tube_without_turnover(scene))
    )
    np.testing.assert_allclose(found, other, rtol=1e-9)
    assert np.abs(found).max() < 100, "it has an equilibrium"
    written(
        tmp_path,
        {"material.lame_mu": 3.0},
        "d.csv",
        "outer_radius = 0.1",
        "state = 'after'\ntime = 4.0",
    )
    with pytest.raises(
        SceneError, match="state = 'after': takes cells alone, not what remodeling.turnover"
    ):
        read_measurements(data, scene)


def tube_without_turnover(scene: Scene) -> Scene:
    """The same tissue, whose collagen stays."""
    return scene.with_values(
        {
            "remodeling.turnover": {},
            "output.columns": [],
            "output.fields": True,
            "time.end": 40.0,
            "time.step": 4.0,
        }
    )


STRETCHED = {"material.elastin.prestretch": [1.0, 1.2]}


@pytest.mark.parametrize(
    ("before", "after", "stays"),
    [
        ({"remodeling.turnover": {"time": 40.0, "volume": 0.0}}, {"material.lame_mu": 4.0}, True),
        (STRETCHED, {"material.elastin.prestretch.1": 1.3}, True),
        ({}, STRETCHED, False),
        (STRETCHED, {"material.elastin.prestretch.1": 1.0}, False),
    ],
)
def test_a_simulation_stays_where_it_can_take_the_numbers(
    before: dict[str, Any], after: dict[str, Any], stays: bool
) -> None:
    """It then has the rows of one that is built with them."""
    scene = preset_scene("consistent", "tube").with_values(
        {"cells.initial": "isotropic", "model.kinematics": "radial", "time.end": 2.0} | before
    )
    simulation, changed = Simulation(scene), scene.with_values(after)
    assert reset_simulation(simulation, simulation.state.snapshot(), changed) == stays
    *_, step = simulation.steps()
    assert not stays or step.row["inner_radius"] == pytest.approx(last_row(changed)["inner_radius"])
