"""The page of a run as a file: what is in it agrees with what was recorded, how large it is, what it says of a run."""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
import re
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from remodel_fenicsx import Recording, cli, run as run_scene
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx import report as page
from remodel_fenicsx.report import ANGLE_STEPS, NO_ANGLE, REPORT, ReportedRun, write_report
from remodel_fenicsx.results.recording import kept_times
from remodel_fenicsx.results.vtkhdf import TransientGrid
from remodel_fenicsx.scene.scene import preset_scene
from tests.conftest import Refused
from tests.forks import forked
from tests.report.conftest import DEMOS, Recorded
from tests.values import ramp_to

ASSETS = page.ASSETS
HOSTILE = "</script><img src=x onerror=alert(1)>"


class Decoded:
    """The data of a page, read as a browser does."""

    def __init__(self, text: str):
        self.text = text
        self.data = json.loads(self.script("page-data"))
        block = gzip.decompress(base64.b64decode(self.script("page-arrays")))
        self.arrays: dict[str, np.ndarray] = {}
        for name, entry in self.data["arrays"].items():
            values = np.frombuffer(
                block, entry["type"], int(np.prod(entry["shape"])), entry["start"]
            )
            values = values.reshape(entry["shape"])
            if entry["differences"]:
                values = np.cumsum(
                    values, axis=0, dtype=values.dtype
                )  # modulo the range of the type
            self.arrays[name] = values
        self.view: dict[str, Any] = self.data["parts"].get("view", {})

    @classmethod
    def from_run(cls, folder: Path) -> Decoded:
        return cls((folder / REPORT).read_text(encoding="utf-8"))

    def script(self, name: str) -> str:
        found = re.search(
            rf'<script type="[a-z/]+" id="{name}">(.*?)</script>', self.text, re.DOTALL
        )
        assert found is not None
        return found[1]

    @property
    def position(self) -> np.ndarray:
        return (
            np.array(self.view["origin"])
            + self.view["position_step"] * self.arrays["view.position"]
        )

    @property
    def angle(self) -> np.ndarray:
        steps = self.arrays["view.angle"].astype(float)
        return np.where(steps == NO_ANGLE, np.nan, (steps + 0.5) * 90 / ANGLE_STEPS)


# ---------------------------------------------------------------- the data
@pytest.mark.parametrize("kinematics", ["radial", "sector"])
def test_stresses_through_the_wall_are_those_of_the_columns(
    kinematics: str, tmp_path: Path
) -> None:
    """Two layers mid-wall, at each time; the mean over the wall as it is now is Laplace's."""
    names = [f"{name}_stress_middle" for name in ("hoop", "axial", "radial")]
    changes = {
        "cells.initial": "isotropic", "model.kinematics": kinematics, "time.end": 3.0, "loads.pressure.value": 2.0,
        "loads.pressure.ramp": ramp_to(3.0), "output.columns": [*names, "inner_radius", "outer_radius"],
    }  # fmt: skip
    folder = run_scene(
        preset_scene("kuhl-holzapfel-2007", "tube").with_values(changes), tmp_path / "run"
    )
    parts, history = Decoded.from_run(folder).data["parts"], Recording(folder).history
    found = parts["stress"]
    assert "content" not in parts
    layers = np.array(found["layers"])
    assert (
        layers.shape == (4, 8, 3) and found["through"] == "through the wall (0 inside, 1 outside)"
    )
    for component, name in enumerate(("hoop", "axial", "radial")):
        middle = np.average(
            layers[:, 3:5, component], axis=1, weights=[1.875, 2.125]
        )  # by their radii
        column = history[f"{name}_stress_middle"]
        np.testing.assert_allclose(middle, column, rtol=0.02, atol=0.001 * layers.max())
    inner, outer = (history[f"{face}_radius"][-1] for face in ("inner", "outer"))
    assert found["level"][-1] == pytest.approx(2.0 * inner / (outer - inner), rel=1e-6)


def test_content_and_growth_through_the_wall(tmp_path: Path) -> None:
    """The mean over the layers by volume is the column's."""
    changes = {
        "cells.initial": "isotropic", "model.kinematics": "radial", "loads.pressure.value": 4.8, "time.end": 20.0,
        "remodeling.turnover": {"time": 5.0, "volume": 0.5}, "time.step": 2.0, "output.columns": ["content", "growth"],
    }  # fmt: skip
    folder = run_scene(preset_scene("consistent", "tube").with_values(changes), tmp_path / "run")
    found, history = Decoded.from_run(folder).data["parts"]["content"], Recording(folder).history
    areas, layers = np.diff(np.linspace(1.0, 3.0, len(found["depth"]) + 1) ** 2), np.array(
        found["layers"]
    )
    assert found["names"] == ["content", "growth"] and history["growth"][-1] < 0.98
    for number, name in enumerate(found["names"]):
        means = np.average(layers[:, :, number], axis=1, weights=areas)
        np.testing.assert_allclose(means, history[name], rtol=1e-5)


@pytest.mark.parametrize("name", ["artery", "tendon", "cube", "tetrahedra", "quadratic"])
def test_the_page_holds_what_was_recorded(recorded: Recorded, name: str) -> None:
    """Places to half a step, angles to half a level, r/L to half of a 255th, chains by their direction."""
    run, found = Recording(recorded(name)), Decoded.from_run(recorded(name))
    times = found.view["times"]
    np.testing.assert_array_equal(times, run.times)
    corners = run.elements[:, : {10: 4, 27: 8}.get(run.elements.shape[1], run.elements.shape[1])]
    used = np.unique(corners)
    np.testing.assert_array_equal(used[found.arrays["view.elements"]], corners)
    shown_chains = []
    for index, t in enumerate(times):
        fields = run.fields(t)
        places = (run.points + fields["displacement"])[used]
        assert np.abs(found.position[index] - places).max() <= 0.51 * found.view["position_step"]
        assert (
            np.nanmax(np.abs(found.angle[index] - fields["fibre_angle_deformed"]))
            < 0.51 * 90 / ANGLE_STEPS
        )
        stored = found.arrays["view.extension"][index] / 255
        assert np.abs(stored - fields["chain_extension"]).max() < 0.51 / 255 and stored.max() <= 1
        axes = np.stack([fields[f"axis_{k}"] for k in (1, 2, 3)], axis=1)
        deformed = axes @ np.swapaxes(fields["deformation_gradient"].reshape(-1, 3, 3), 1, 2)
        edges = fields["cell_dimensions"][:, :, None] * deformed
        kept = found.view["edge_step"] * found.arrays["view.edges"][index].reshape(-1, 3, 3)
        shown_chains.append(worst_direction(edges.sum(axis=1), kept.sum(axis=1)))
    assert found.view["position_step"] <= 1.001 * np.ptp(found.position, axis=(0, 1)).max() / 65535
    assert max(shown_chains) < 2.0


def worst_direction(first: np.ndarray, second: np.ndarray) -> float:
    """Largest angle in degrees between two vectors of a row."""
    lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return float(
        np.degrees(np.arccos(np.clip(np.sum(first * second, axis=1) / lengths, -1, 1))).max()
    )


def test_regions_are_shown_by_name(recorded: Recorded) -> None:
    """A curve for each beside those of the body, where each lies in the profile, and what differs in words."""
    found = Decoded.from_run(recorded("layers"))
    regions = found.data["parts"]["angles"]["regions"]
    assert regions == [
        {"name": "media", "from": 0.0, "to": 0.5},
        {"name": "adventitia", "from": 0.5, "to": 1.0},
    ]
    drawn = found.data["parts"]["curves"]["curves"]
    curves = {curve["title"]: [one["name"] for one in curve["series"]] for curve in drawn}
    places = ("inner", "middle", "outer", "media", "adventitia")
    assert curves["Fibre angle"] == [f"fibre angle {place}" for place in places]
    assert curves["Largest r/L"] == ["largest r/L media", "largest r/L adventitia", "largest r/L"]
    for words in (
        "<th>Regions media remodeling</th><td>kappa 0.05",
        "<th>Regions adventitia",
        "initial (0.5, 0.85, 0.165",
    ):
        assert words in found.text
    assert Decoded.from_run(recorded("artery")).data["parts"]["angles"]["regions"] == []


def test_what_was_run_has_all_that_makes_the_result(recorded: Recorded) -> None:
    """Where it is free of stress, the loaded body that was given, turnover and ramps; nothing that is not there."""
    text = html.unescape(Decoded.from_run(recorded("unloaded")).text)
    expected = [
        "opening angle 60", "; under the loads: radii 1, 1.3, length 2",
        "time 40, deposition stretch 1.1, gain 1", "value 1.2, ramp ((0, 0), (24, 1))",
    ]  # fmt: skip
    assert not [words for words in expected if words not in text]
    radial = html.unescape(Decoded.from_run(recorded("radial")).text)
    said = re.sub("<.*?>", " ", radial[radial.index("What was run"):radial.index("Warnings (")])  # fmt: skip
    expected = [
        "cells.initial = isotropic for random",
        "time.end = 3 for 150",
        "model.kinematics = radial for full",
        "Changed by --set",
    ]
    assert not [words for words in [*expected, "ends free", "law explicit"] if words not in said]
    assert not [words for words in ("Output", "Solver", "turnover") if words in said]
    assert "fibre angle inner (reference)" in radial and "outer radius (reference)" not in radial


def test_tetrahedra_have_as_many_layers_as_lie_behind_one_another(recorded: Recorded) -> None:
    """And not one for each place that the middle of one of the six kinds has."""
    found = Decoded.from_run(recorded("three tetrahedra"))
    depth = found.data["parts"]["angles"]["depth"]
    np.testing.assert_allclose(depth, (np.arange(3) + 0.5) / 3, atol=1e-6)
    shares = np.bincount(found.arrays["view.layer"], weights=found.arrays["view.volume"])
    np.testing.assert_allclose(shares, 1 / 3, rtol=1e-5)


def test_volumes_and_layers_are_those_of_the_body(recorded: Recorded) -> None:
    for name, layers in (("artery", 8), ("tendon", 10), ("cube", 1)):
        found = Decoded.from_run(recorded(name))
        volume, layer = found.arrays["view.volume"], found.arrays["view.layer"]
        assert volume.sum() == pytest.approx(1.0, rel=1e-5) and set(layer) == set(range(layers))
        depth = found.data["parts"]["angles"]["depth"]
        np.testing.assert_allclose(
            depth, (np.arange(layers) + 0.5) / layers, atol=0.03
        )  # edges are chords
    # rings of equal thickness: their volumes grow like their radii
    found = Decoded.from_run(recorded("artery"))
    shares = np.bincount(found.arrays["view.layer"], weights=found.arrays["view.volume"])
    radii = 1.0 + 2.0 * (np.arange(8) + 0.5) / 8
    np.testing.assert_allclose(shares, radii / radii.sum(), rtol=1e-4)


@pytest.mark.parametrize("name", ["radial", "axisymmetric", "sector", "point"])
def test_reductions_are_shown_as_whole_bodies(recorded: Recorded, name: str) -> None:
    """Their surfaces have the radii, lengths and stretches of the history; chains stay at their angle."""
    run, found = Recording(recorded(name)), Decoded.from_run(recorded(name))
    assert (
        KINEMATICS[run.scene.model.kinematics].reduced and "shown as the whole body" in found.text
    )
    start, end = found.position[0], found.position[-1]
    history = run.history
    length = np.ptp(end[:, 2]) / np.ptp(start[:, 2])
    if name == "point":
        assert length == pytest.approx(history["mean_stretch"][-1], rel=1e-4)
        return
    assert length == pytest.approx(1 + history["axial_elongation"][-1], rel=1e-4)
    radii = np.linalg.norm(end[:, :2], axis=1)
    assert radii.min() == pytest.approx(history["inner_radius"][-1], rel=1e-3)
    assert radii.max() == pytest.approx(history["outer_radius"][-1], rel=1e-3)
    # the same angle all around: the turned chains of a layer make it with their own tangents
    edges = found.view["edge_step"] * found.arrays["view.edges"][-1].reshape(-1, 3, 3)
    centres = end[found.arrays["view.elements"]].mean(axis=1)
    around = np.stack([-centres[:, 1], centres[:, 0], 0 * centres[:, 0]], axis=1)
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    parts = (edges @ around[..., None])[..., 0], edges[..., 2]
    tangential, axial = (np.linalg.norm(part, axis=1) for part in parts)
    np.testing.assert_allclose(np.degrees(np.arctan2(axial, tangential)), found.angle[-1], atol=1.5)


# ---------------------------------------------------------------- size and time
def test_an_artery_costs_little(recorded: Recorded, tmp_path: Path) -> None:
    """Under 2 s of the processor, and fewer times where the page would be too large, the first and the last kept."""
    folder = recorded("artery")
    begun = time.process_time()
    write_report(folder, tmp_path / "all.html")
    assert time.process_time() - begun < 2.0
    whole = (tmp_path / "all.html").stat().st_size / 1e6
    assert whole < 1.2
    for size, number in ((whole / 10, 8), (0.0, 2)):
        few = Decoded(page.page_of(Recording(folder), size))
        kept = few.view["times"]
        assert kept[0] == 0.0 and kept[-1] == 10.0 and 2 <= len(kept) <= max(2, number)
        assert "recorded times are stored" in few.text


def test_kept_times_are_spread_evenly() -> None:
    times = np.arange(101.0)
    np.testing.assert_array_equal(kept_times(times, 21), times[::5])
    for most in (101, 500):
        np.testing.assert_array_equal(kept_times(times, most), times)


# ---------------------------------------------------------------- how a run went
STARTED = "2026-01-02 03:04:05,678 INFO scene two on 2 ranks, results in x\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run of two elements and three of its ten steps."""
    scene = preset_scene("kuhl-holzapfel-2007", "tendon").with_values(
        {"name": "two", "time.end": 10.0}
    )
    points = np.array(
        [[x, y, z] for z in (0, 1, 2) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=float
    )
    (tmp_path / "scene.toml").write_text(
        scene.to_toml(f"as run\nremodel_fenicsx 9.8.7\nsystem {HOSTILE}")
    )
    (tmp_path / "history.csv").write_text(
        "time,force,mean_stretch,odd\n0,0,1,\n1,25,1.1,\n2,50,1.2,\n"
    )
    (tmp_path / "run.log").write_text(STARTED)
    with TransientGrid(
        tmp_path / "fields.vtkhdf", points, np.array([np.arange(8), np.arange(4, 12)]), 12
    ) as grid:
        for t in (0.0, 1.0, 2.0):
            grid.append(
                t, {"displacement": 0.1 * t * points}, {"fibre_angle_deformed": [10 * t, np.nan]}
            )
    return tmp_path


@pytest.mark.parametrize(("lines", "rows", "state", "words"), [
    ("", "", "stopped", "at t = 2 of 10: it was killed, and logged no reason"),
    ("INFO failed: time 3: limit point. a lower load", "", "failed", "time 3: limit point. a lower load"),
    ("INFO ended: SIGTERM", "", "stopped", "at t = 2 of 10: SIGTERM"),
    ("INFO finished", "10,250,1.5,\n", "finished", ""),
])  # fmt: skip
def test_the_state_of_a_run_is_said(
    folder: Path, lines: str, rows: str, state: str, words: str
) -> None:
    with (folder / "run.log").open("a") as log:
        log.write(f"2026-01-02 03:05:05,678 {lines}\n" if lines else "")
    with (folder / "history.csv").open("a") as history:
        history.write(rows)
    assert ReportedRun(Recording(folder)).state == (state, words)
    text = write_report(folder).read_text()
    assert ", 2 ranks" in text and "2026-01-02 03:04:05" in text
    assert f'<span class="badge {state}">{state}</span>' in text and html.escape(words) in text


def test_a_run_that_goes_on_is_said_to(folder: Path) -> None:
    from remodel_fenicsx.results.recording import RunLock

    with RunLock(folder):
        assert ReportedRun(Recording(folder)).state == ("running", "step 2 of 10, at t = 2 of 10")


def test_warnings_come_once_with_their_number(folder: Path) -> None:
    with (folder / "run.log").open("a") as log:
        log.write(
            "2026-01-02 03:04:06,000 WARNING before all\n2026-01-02 03:04:06,000 INFO time 1, force 25\n"
        )
        log.write(
            "2026-01-02 03:04:07,000 WARNING locks at 3 points\n2026-01-02 03:04:07,000 INFO time 2, force 50\n"
        )
        log.write(
            "2026-01-02 03:04:08,000 WARNING locks at 12 points\n2026-01-02 03:04:08,000 WARNING two\nlines\n"
        )
    found = ReportedRun(Recording(folder)).warnings
    assert found == {"before all": 1, "locks at 3 points": 2, "two\nlines": 1}
    text = write_report(folder).read_text()
    assert (
        "<h2>Warnings (4)</h2>" in text and 'locks at 3 points <span class="note">(2 times)' in text
    )


def test_text_of_others_is_text(folder: Path) -> None:
    with (folder / "run.log").open("a") as log:
        log.write(
            f"2026-01-02 03:04:06,000 WARNING {HOSTILE}\n2026-01-02 03:04:06,000 INFO failed: {HOSTILE}\n"
        )
    with (folder / "scene.toml").open("a") as scene:
        scene.write(f"# {HOSTILE} <!--\n")
    history = (folder / "history.csv").read_text()
    (folder / "history.csv").write_text(history.replace("odd", HOSTILE).replace("1,\n", "1,7\n"))
    text = write_report(folder).read_text()
    assert "<img" not in text and "<!--" not in text and text.count(html.escape(HOSTILE)) >= 4
    assert text.count("</script>") == 4


def test_values_that_are_missing_are_left_out(folder: Path) -> None:
    """A column without a number, elements without an angle, fields that were not recorded."""
    found = Decoded(write_report(folder).read_text())
    names = [
        series["name"]
        for curve in found.data["parts"]["curves"]["curves"]
        for series in curve["series"]
    ]
    assert sorted(names) == ["force", "mean stretch"]
    assert np.isnan(found.angle[:, 1]).all() and "view.edges" not in found.arrays


def test_the_policy_names_what_is_in_the_page(folder: Path) -> None:
    """Nothing from anywhere; scripts and style by their own hashes."""
    text = write_report(folder).read_text()
    found = re.search(r'Content-Security-Policy" content="([^"]+)"', text)
    assert found is not None
    rules = dict(rule.strip().split(" ", 1) for rule in found[1].split(";"))
    assert rules["default-src"] == rules["connect-src"] == "'none'"
    for kind, pattern in (
        ("script-src", r"<script>(.*?)</script>"),
        ("style-src", r"<style>(.*?)</style>"),
    ):
        hashes = [
            hashlib.sha256(part.encode()).digest() for part in re.findall(pattern, text, re.DOTALL)
        ]
        assert rules[kind].split() == [
            f"'sha256-{base64.b64encode(one).decode()}'" for one in hashes
        ]


# ---------------------------------------------------------------- the command, and the end of a run
def test_only_its_own_page_is_made_anew(folder: Path, refused: Refused) -> None:
    assert cli.main(["report", str(folder)]) == 0 and cli.main(["report", str(folder)]) == 0
    (folder / REPORT).write_text("mine")
    for words in ((), ("-o", folder / REPORT)):
        refused("report", folder, *words)
    assert (folder / REPORT).read_text() == "mine"
    assert cli.main(["report", str(folder), "-o", str(folder / "new.html")]) == 0
    assert cli.main(["report", str(folder), "-o", str(folder / "no" / "folder.html")]) == 5


@pytest.mark.parametrize("words", [["--no-report"], ["--set", "output.report=false"]])
def test_a_run_leaves_none_where_none_is_wanted(tmp_path: Path, words: list[str]) -> None:
    command = [
        "run",
        DEMOS / "cube.toml",
        "--set",
        "time.end=1",
        "--set",
        "output.fields=false",
        *words,
    ]
    assert forked("remodel-fenicsx", *command, "-o", tmp_path / "run").returncode == 0
    assert (tmp_path / "run" / "history.csv").exists() and not (tmp_path / "run" / REPORT).exists()


def test_a_report_that_fails_is_one_warning(tmp_path: Path) -> None:
    """And never the run's exit code."""
    program = (
        "import sys; from remodel_fenicsx import cli; from remodel_fenicsx import report as page\n"
        "def fail(*_): raise ValueError('no\\nroom')\n"
        "page.page_of = fail; sys.exit(cli.main(sys.argv[1:]))"
    )
    command = [
        "run",
        str(DEMOS / "cube.toml"),
        "--set",
        "time.end=1",
        "-o",
        str(tmp_path / "run"),
        "-q",
    ]
    done = forked("python", program, *command)
    assert done.returncode == 0 and done.stderr == "WARNING: no report.html: no room\n"
    assert ReportedRun(Recording(tmp_path / "run")).warnings == {"no report.html: no room": 1}


# ---------------------------------------------------------------- what is in it of others
def test_the_bundle_is_the_one_that_is_named() -> None:
    vendor = tomllib.loads((ASSETS / "VENDOR.toml").read_text())
    for name, digest in vendor["sha256"].items():
        assert hashlib.sha256((ASSETS / name).read_bytes()).hexdigest() == digest
    for package in vendor["package"]:
        assert "Permission is hereby granted" in (ASSETS / package["licence_file"]).read_text()
        assert package["licence"] == "MIT"
