#!/usr/bin/env python3
"""Error against time of the processor for every setting of the artery, one factor at a time, and the front of all.

    ./with-fenicsx benchmarks/work_precision.py [--folder DIR] [--budget SECONDS] [--only PART...] [--report]

Parts: `artery`, the settings of `remodel-fenicsx trade` and the profiles on the paper's artery with isotropic cells,
for the printed coupling, the implicit one and the consistent variant, against the one-dimensional solver of
tests/reference with steps of 1/8 and 1/16 (1/2 and 1/4 for the law tensor), extrapolated; `end`, chosen steps against
equal ones there, in turns; `paper`, the paper's own mesh there, at its points too; `whole`, the whole tube in three
dimensions, up to 20 minutes a run; `hold`, chosen steps against equal ones to t = 1000; `tendon`, the paper's with
random cells. An hour or more of one core, most of it the whole tube. Then makes docs/speed_and_accuracy.md, its
appendix and picture; --only makes no page, --report makes it from what is there. What is recorded is used again.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from mpi4py import MPI
from numpy.typing import NDArray

from benchmarks.precision import chosen, places, tendon, whole
from remodel_fenicsx.body.shape import PROFILE, profile_weights
from remodel_fenicsx.scene.presets import PROFILES
from remodel_fenicsx.scene.scene import Scene, preset_scene
from remodel_fenicsx.schema.times import same_time
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page
from remodel_fenicsx.studies import trade as rungs
from remodel_fenicsx.studies.trade import pareto, typical
from remodel_fenicsx.system.environment import versions
from tests.reference.radial import solve_radial

DOCS = Path(__file__).parents[1] / "docs"
PICTURE = "speed_and_accuracy"
PAGES = {"work_precision": "speed_and_accuracy", "work_precision_appendix": "appendix_speed_and_accuracy"}  # templates
PARTS = ("artery", "end", "paper", "whole", "hold", "tendon")
COARSE = (8.0, 4.0)  # tolerances, degrees
TIMES = chosen.TO_THE_END
REFERENCE = {"explicit": (150, 1 / 8, 1 / 16), "tensor": (60, 1 / 2, 1 / 4)}  # elements and steps, by law
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Method:
    """A way of marching: its preset, coupling and the law of the reference."""

    words: str
    preset: str
    coupling: str
    law: str


METHODS = {
    "printed": Method("printed: explicit law, staggered", "kuhl-holzapfel-2007", "staggered", "explicit"),
    "implicit": Method("explicit law, implicit coupling", "kuhl-holzapfel-2007", "implicit", "explicit"),
    "consistent": Method("law tensor, extrapolated", "consistent", "extrapolated", "tensor"),
}


@dataclass(frozen=True)
class Point:
    """A setting with its true errors."""

    method: str
    name: str
    words: str
    seconds: float
    degrees: float
    largest: float
    percent: float
    iterations: int

    @property
    def is_whole(self) -> bool:
        """Whether it is the whole tube in three dimensions."""
        return self.name.startswith(("full", "whole"))


def scene(method: Method) -> Scene:
    """The artery of isotropic cells."""
    changes = {"cells.initial": "isotropic", "remodeling.coupling": method.coupling}
    return preset_scene(method.preset, "tube").with_values(whole.EVERY_TANGENT | changes)


def settings(method: Method) -> list[rungs.Setting]:
    """Those of the ladder, and the profiles."""
    base = scene(method)
    profiles = [
        whole.Named(profile.values, base.with_values(profile.values), (1,), title=f"profile-{name}")
        for name, profile in PROFILES.items()
    ]
    resolved = [
        whole.Named(one.changes, one.scene.with_values({"model.kinematics": "radial"}), (1,), title=one.name)
        for one in profiles
    ]
    same = [one for one in rungs.ladder(base) if not one.profile and rungs.COUPLING not in one.changes]
    every = [*coarse(base), *same, *resolved]
    exact = method.coupling == "implicit" and method.law == "explicit"  # no error in time: short steps buy nothing
    return [one for one in every if one.step is None or one.step >= base.time.step or not exact]


def coarse(base: Scene) -> list[whole.Named]:
    """Below what a study asks for: steps as long as the compared times allow, on the coarsest elements."""
    found = []
    for tolerance in COARSE:
        values = {"model.kinematics": "radial", "time.tolerance": tolerance}
        name = f"radial-1-degree-1-tolerance-{tolerance:g}"
        found.append(whole.Named(values, base.with_values(values), (1,), title=name))
    return found


def reference(law: str, folder: Path) -> tuple[Array, Array]:
    """Angles and radii of the reference at the compared times, with what is left of steps extrapolated."""
    kept = folder / f"reference-{law}.npz"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        elements, *steps = REFERENCE[law]
        (angles, radii), (finer_angles, finer_radii) = (_reference(law, step, int(elements)) for step in steps)
        np.savez(kept, angles=2 * finer_angles - angles, radii=2 * finer_radii - radii)
    with np.load(kept) as found:
        return found["angles"], found["radii"]


def _reference(law: str, step: float, elements: int) -> tuple[Array, Array]:
    history = solve_radial(step=step, elements=elements, law=law)
    hats = profile_weights((history.points - 1.0) / 2.0) * history.areas[:, None]
    rows = [round(time / step) - 1 for time in TIMES]
    dimensions = history.dimensions[rows]
    angles = np.degrees(np.arctan2(dimensions[..., 1], dimensions[..., 0])) @ hats / hats.sum(axis=0)
    return angles, np.stack([history.inner_radii[rows], history.outer_radii[rows]], axis=1)


def run(folder: Path, parts: Sequence[str], budget: float) -> None:
    """What is asked for and not kept yet."""
    if "artery" in parts:
        run_artery(folder, budget, paper=False)
    for part in ("end", "hold"):
        if part in parts:
            chosen.run(folder, measured, part)
    if "paper" in parts:
        places.run(scene(METHODS["printed"]), folder)
        run_artery(folder, 0.0, paper=True)
    if "whole" in parts:
        for name, method in METHODS.items():
            for setting in whole.settings(name, scene(method)):
                run_one(folder, name, setting)
    if "tendon" in parts:
        tendon.run(folder, measured)


def run_artery(folder: Path, budget: float, paper: bool) -> None:
    """All settings of a few expected seconds and the profiles, or the paper's own."""
    for name, method in METHODS.items():
        for setting in sorted(settings(method), key=lambda setting: not setting.name.startswith("profile")):
            own = paper and name == "printed" and setting.mesh[0] == "full"
            asked = own or (setting.name.startswith("profile") and not paper)
            if setting.expected_seconds < budget or asked:
                run_one(folder, name, setting)


def run_one(folder: Path, method: str, setting: rungs.Setting) -> None:
    """If it is not kept yet."""
    if not _kept(folder, method, setting).exists():
        found = measured(setting.scene, TIMES)
        np.savez(_kept(folder, method, setting), **found)
        print(f"{method:12} {setting.in_words()}: {float(found['seconds']):.2g} s", flush=True)


def measured(scene: Scene, times: list[float]) -> dict[str, Array]:
    """Angles and lengths at the compared times, seconds of the processor, rows and Newton iterations of a run."""
    setting = rungs.Setting({}, scene, (1,))
    compared = rungs.as_run(setting, 1, times)
    columns = [*compared.output.columns, "newton_iterations"]
    simulation = Simulation(compared.with_values({"output.columns": columns}), MPI.COMM_SELF)
    rows = [step.row for step in simulation.steps()]
    simulation.close()
    asked = [next(row for row in rows if same_time(row["time"], time)) for time in times]
    lengths = [name for name in ("inner_radius", "outer_radius", "mean_stretch") if name in rows[0]]
    return {
        "angles": np.array([[row[name] for name in PROFILE] for row in asked]),
        "lengths": np.array([[row[name] for name in lengths] for row in asked]),
        "seconds": np.array(sum(row["processor_seconds"] for row in rows)),
        "rows": np.array(len(rows)),
        "iterations": np.array(sum(row["newton_iterations"] for row in rows)),
    }


def _kept(folder: Path, method: str, setting: rungs.Setting) -> Path:
    return folder / f"{method}-{setting.name}.npz"


def points(folder: Path) -> list[Point]:
    """All that is kept."""
    found = []
    for name, method in METHODS.items():
        angles, radii = reference(method.law, folder)
        for setting in [*settings(method), *whole.settings(name, scene(method))]:
            if not _kept(folder, name, setting).exists():
                continue
            with np.load(_kept(folder, name, setting)) as kept:
                error, largest = typical(kept["angles"] - angles), float(np.max(np.abs(kept["angles"] - angles)))
                off = 100 * float(np.max(np.abs(kept["lengths"] / radii - 1)))
                words = setting.name if setting.name.startswith("profile") else " ".join(setting.in_words().split())
                words += (
                    ", every tangent factorised" if setting.name.startswith("full") else whole.other_words(setting.name)
                )
                numbers = float(kept["seconds"]), error, largest, off, int(kept["iterations"])
                found.append(Point(name, setting.name, words, *numbers))
    return found


def report(folder: Path) -> None:
    """Write the page, its appendix and its picture."""
    found = sorted(points(folder), key=lambda point: point.seconds)
    best = {id(p) for p, on in zip(found, _front(found), strict=True) if on}
    rows = [_row(p, id(p) in best) for p in found]
    made = ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")
    parts = {"rows": "\n".join(rows), "whole": whole_rows(found), "hold": chosen.hold_rows(folder),
             "end": chosen.end_rows(folder), "tendon": tendon.rows(folder), "made": fill(f"Made with {made}.", 100),
             "paper": paper_rows(found), "places": places.words(folder)}  # fmt: skip
    for template, page in PAGES.items():
        text = Path(__file__).with_name(f"{template}.template.md").read_text(encoding="utf-8")
        for name, words in parts.items():
            text = text.replace(f"{{{name}}}", words)
        (DOCS / f"{page}.md").write_text(text, encoding="utf-8")
    _draw(found, made)


def _row(p: Point, is_best: bool) -> str:
    mark = "**" if is_best else ""
    numbers = f"{p.degrees:.2g} | {p.largest:.2g} | {p.percent:.2g}"
    seconds = f"{p.seconds:.2g}" if p.seconds < 99.5 else f"{p.seconds:.0f}"
    return f"| {mark}{seconds}{mark} | {numbers} | {METHODS[p.method].words} | {p.words} |"


def whole_rows(found: Sequence[Point]) -> str:
    """The whole tube in three dimensions, with a front of its own."""
    mine = [p for p in found if p.is_whole]
    return "\n".join(_row(p, on) for p, on in zip(mine, _front(mine), strict=True))


def paper_rows(found: Sequence[Point]) -> str:
    """The paper's own setting beside the wall alone on the same elements."""
    printed = {point.name: point for point in found if point.method == "printed"}
    whole, wall = printed["full-1-degree-1-step-1"], printed["radial-1-degree-1-step-1"]
    own = f"| the whole tube | {whole.seconds:.3g} | {whole.degrees:.2g} | {whole.largest:.2g} |"
    return f"{own}\n| the wall alone on the same elements | {wall.seconds:.1g} | {wall.degrees:.2g} | |"


def _front(found: Sequence[Point]) -> list[bool]:
    return pareto([p.seconds for p in found], [p.degrees for p in found])


def _draw(found: Sequence[Point], made: str) -> None:
    page = Page(
        DOCS / "figures",
        PICTURE,
        "The artery: error against time of the processor",
        "Filled: the front of all. Squares: the whole tube in three dimensions.",
    )
    front = _front(found)
    with rc_context(STYLE):
        figure = Figure(figsize=(6.6, 4.4), layout="constrained")
        axes = figure.subplots()
        mine = [p for p in found if p.is_whole]
        best = [(p.seconds, p.degrees) for p, on in zip(mine, _front(mine), strict=True) if on]
        axes.plot(*zip(*best, strict=True), "-", color="0.7", linewidth=0.8, zorder=0, label="front of the whole tube")
        for (name, method), colour in zip(METHODS.items(), COLOURS, strict=False):
            axes.plot([], [], "o", color=colour, label=method.words)
            for point, on in zip(found, front, strict=True):
                if point.method == name:
                    marker = "D" if point.name.startswith("profile") else "s" if point.is_whole else "o"
                    face = colour if on else "white"
                    axes.plot(point.seconds, point.degrees, marker, color=colour, markerfacecolor=face)
                    if marker == "D" or point.name.startswith("full"):
                        text = point.name.removeprefix("profile-") if marker == "D" else "the paper's mesh and step"
                        side = {"xytext": (5, 3 if marker == "D" else -3)}
                        at = (point.seconds, point.degrees)
                        axes.annotate(text, at, textcoords="offset points", fontsize=6.5, color="0.3", **side)
        axes.set(xscale="log", yscale="log", xlabel="seconds of the processor")
        axes.set(ylabel="error of the fibre angle, degrees")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
        axes.legend()
        page.save_figure(figure, made)


def main() -> None:
    """Run what is missing, and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("results/work-precision"))
    parser.add_argument("--budget", type=float, default=5.0, help="longest expected run, seconds")
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=PARTS, help="parts to run, without the page; default: all"
    )
    parser.add_argument("--report", action="store_true", help="make the page from what is there")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    if not options.report:
        run(options.folder, options.only, options.budget)
    if options.report or options.only is PARTS:  # the page needs all parts
        report(options.folder)


if __name__ == "__main__":
    main()
