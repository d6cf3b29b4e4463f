#!/usr/bin/env python3
"""Error against CPU time for every setting of the artery, one factor at a time, and the front of all.

    ./with-fenicsx benchmarks/work_precision.py [--folder DIR] [--budget SECONDS] [--only PART...] [--report]

Parts: `artery`, the settings of `remodel-fenicsx trade` and the profiles on the paper's artery with isotropic cells,
for the printed coupling and the consistent variant, against the one-dimensional solver of
tests/reference with steps of 1/8 and 1/16 (1/2 and 1/4 for the law tensor), extrapolated; `paper`, the paper's own mesh
there; `whole`, the whole tube in three dimensions, up to 20 minutes a run. An hour or more of one core, most of it the
whole tube. Then makes tables and picture of docs/reliability.md, and tables.md beside what is recorded; --only
makes no page, --report makes it from what is there. What is recorded is used again.
"""

from __future__ import annotations

import math
import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from docs.making.pages import DOCS, FIGURES, between_marks, filled, lines, made_with, markdown
from remodel_fenicsx.body.shape import PROFILE, profile_weights
from remodel_fenicsx.scene.presets import PROFILES
from remodel_fenicsx.scene.scene import Scene, preset_scene
from remodel_fenicsx.studies.study import COLOURS, STYLE, Page
from remodel_fenicsx.studies.trade import Setting, as_run, ladder, pareto, nanrms
from tests.reference.radial import solve_radial
from tests.runs import rows_of

SECONDS_PER_POINT = 3e-5  # CPU time of a step, rough

Array = NDArray[np.float64]
Run = Mapping[str, Array]

PICTURE = "speed_and_accuracy"
PAGE = DOCS / "reliability.md"
HEAD = ["seconds", "degrees", "largest", "radii, %", "method", "setting"]
PARTS = ("artery", "paper", "whole")
COARSE = (8.0, 4.0)  # tolerances, degrees, below what a study asks for
RADIAL = {"model.kinematics": "radial"}
TIMES = [5.0, 25.0, 45.0, 65.0, 85.0, 105.0, 125.0, 145.0, 150.0]
REFERENCE = {
    "explicit": (150, 1 / 8, 1 / 16),
    "tensor": (60, 1 / 2, 1 / 4),
}  # elements and steps, by law
# how the tables of docs/reliability.md were measured: the presets named this up to 0.2.0
EVERY_TANGENT = {"solver.method": "direct", "solver.predictor": "with-tolerance"}
# the whole tube is solved as a user would
SOLVED = {"model.kinematics": "full", "solver.method": "auto", "solver.predictor": "autoregressive"}
SELECTIVE = {"mesh.formulation": "selective-integration"}


@dataclass(frozen=True)
class Method:
    """A way of marching: its preset, coupling, the law of the reference, and steps of the whole tube."""

    words: str
    preset: str
    coupling: str
    law: str
    steps: Mapping[tuple[int, int], tuple[float, ...]]  # by refinement and degree


METHODS = {
    "printed": Method(
        "printed: explicit law, staggered", "kuhl-holzapfel-2007", "staggered", "explicit",
        {(1, 1): (5.0, 2.5, 1.0), (1, 2): (5.0, 2.5, 1.0, 0.5, 0.25), (2, 1): (1.0,)},
    ),
    "consistent": Method(
        "law tensor, extrapolated", "consistent", "extrapolated", "tensor",
        {(1, 1): (5.0, 1.0), (1, 2): (5.0, 1.0, 0.25, 0.125)},
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Point:
    """A setting with its true errors.

    Attributes
    ----------
    seconds
        CPU time.
    typical, anywhere
        Error of the fibre angle, degrees: root mean square over places and times, and the largest.
    percent
        Largest relative error of the lengths.
    """

    method: str
    name: str
    seconds: float
    typical: float
    anywhere: float
    percent: float

    @property
    def is_whole(self) -> bool:
        """Whether it is the whole tube in three dimensions."""
        return self.name.startswith(("full", "whole"))


class Kept:
    """A folder with a file for each run."""

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def __contains__(self, name: str) -> bool:
        return (self.folder / f"{name}.npz").exists()

    def __getitem__(self, name: str) -> Run:
        with np.load(self.folder / f"{name}.npz") as found:
            return dict(found)

    def keep(self, name: str, run: Run) -> None:
        """A file."""
        np.savez(self.folder / f"{name}.npz", **run)  # type: ignore[arg-type]
        print(name, float(run.get("seconds", np.nan)), flush=True)

    def measure(self, name: str, setting: Setting) -> None:
        """Angles and radii at the compared times, and CPU time, of a run that is not kept yet."""
        if name in self:
            return
        rows = rows_of(as_run(setting).with_values({"output.times": TIMES}))
        asked = [next(row for row in rows if math.isclose(row["time"], time)) for time in TIMES]
        angles, lengths = (
            [[row[n] for n in names] for row in asked] for names in (PROFILE, LENGTHS)
        )
        seconds = np.array(sum(row["cpu_seconds"] for row in rows))
        self.keep(
            name, {"angles": np.array(angles), "lengths": np.array(lengths), "seconds": seconds}
        )


LENGTHS = ("inner_radius", "outer_radius")


def scene(method: Method) -> Scene:
    """The artery of isotropic cells."""
    changes = {"cells.initial": "isotropic", "remodeling.coupling": method.coupling}
    return preset_scene(method.preset, "tube").with_values(EVERY_TANGENT | changes)


def settings(method: Method) -> list[Setting]:
    """The profiles, those of the ladder, and coarser ones."""
    base = scene(method)
    found = [
        Setting(f"profile-{name}", base.with_values({**profile.values, **RADIAL}))
        for name, profile in PROFILES.items()
    ]
    for tolerance in COARSE:
        coarse = base.with_values({**RADIAL, "time.tolerance": tolerance})
        found.append(Setting(f"radial-1-degree-1-tolerance-{tolerance:g}", coarse))
    return found + [one for one in ladder(base) if not one.name.startswith("profile")]


def whole(method: Method) -> list[Setting]:
    """The whole tube from coarse to fine: the price where no part stands for the body."""
    steps = [(*mesh, "step", step, {}) for mesh, every in method.steps.items() for step in every]
    steps += [
        (1, 1, "tolerance", 1.0, {}),
        (1, 2, "tolerance", 0.5, {}),
        (1, 1, "step", 1.0, SELECTIVE),
    ]
    found = []
    for refinement, degree, kind, value, other in steps:
        values = (
            SOLVED
            | {"mesh.refinement": refinement, "mesh.degree": degree, f"time.{kind}": value}
            | other
        )
        name = f"whole-{refinement}-degree-{degree}-{kind}-{value:g}{'-selective-integration' if other else ''}"
        found.append(Setting(name, scene(method).with_values(values)))
    return sorted(found, key=lambda setting: setting.cost)


def reference(law: str, kept: Kept) -> tuple[Array, Array]:
    """Angles and radii of the reference at the compared times, with what is left of steps extrapolated."""
    name = f"reference-{law}"
    if name not in kept:
        elements, *steps = REFERENCE[law]
        (angles, radii), (finer_angles, finer_radii) = (
            _reference(law, step, int(elements)) for step in steps
        )
        kept.keep(name, {"angles": 2 * finer_angles - angles, "radii": 2 * finer_radii - radii})
    return kept[name]["angles"], kept[name]["radii"]


def _reference(law: str, step: float, elements: int) -> tuple[Array, Array]:
    history = solve_radial(step=step, elements=elements, law=law)
    hats = profile_weights((history.points - 1.0) / 2.0) * history.areas[:, None]
    rows = [round(time / step) - 1 for time in TIMES]
    dimensions = history.dimensions[rows]
    angles = (
        np.degrees(np.arctan2(dimensions[..., 1], dimensions[..., 0])) @ hats / hats.sum(axis=0)
    )
    return angles, np.stack([history.inner_radii[rows], history.outer_radii[rows]], axis=1)


def run(kept: Kept, parts: Sequence[str], budget: float) -> None:
    """What is asked for and not kept yet: of the artery profiles and settings of a few expected seconds."""
    for name, method in METHODS.items():
        for setting in settings(method):
            is_paper = name == "printed" and setting.name.startswith("full")
            is_asked = (
                setting.name.startswith("profile") or SECONDS_PER_POINT * setting.cost < budget
            )
            if ("artery" in parts and is_asked) or ("paper" in parts and is_paper):
                kept.measure(f"{name}-{setting.name}", setting)
        for setting in whole(method) if "whole" in parts else ():
            kept.measure(f"{name}-{setting.name}", setting)


def points(kept: Kept) -> Iterator[Point]:
    """All that is kept, against the reference."""
    for name, method in METHODS.items():
        angles, lengths = reference(method.law, kept)
        for setting in [*settings(method), *whole(method)]:
            if (file := f"{name}-{setting.name}") in kept:
                run = kept[file]
                apart, percent = run["angles"] - angles, 100 * np.max(
                    np.abs(run["lengths"] / lengths - 1)
                )
                numbers = run["seconds"], nanrms(apart), np.abs(apart).max(), percent
                yield Point(name, setting.name, *map(float, numbers))


def report(kept: Kept) -> None:
    """Write the page, its appendix and its picture."""
    found = sorted(points(kept), key=lambda point: point.seconds)
    whole_tube = [point for point in found if point.is_whole]
    made = fill(f"Made with {made_with()}.", 100)
    parts = {"rows": table_rows(found), "whole": table_rows(whole_tube), "made": made}
    text = filled(Path(__file__).with_suffix(".template.md"), parts)
    (kept.folder / "tables.md").write_text(text, encoding="utf-8")
    PAGE.write_text(
        between_marks(PAGE.read_text(encoding="utf-8"), "front", best(found)), encoding="utf-8"
    )
    _draw(found)


def table_rows(found: Sequence[Point]) -> str:
    """Settings, the cheapest first; those on their front stand out."""
    return lines(_row(point, on) for point, on in zip(found, _front(found), strict=True))


def best(found: Sequence[Point]) -> str:
    """Those on the front whose error is at most half of that of the row above."""
    chosen: list[Point] = []
    for point, is_best in zip(found, _front(found), strict=True):
        if is_best and (not chosen or 2 * point.typical <= chosen[-1].typical):
            chosen.append(point)
    return markdown(HEAD, (_row(point, False) for point in chosen))


def _row(p: Point, is_best: bool) -> list[str]:
    seconds = f"{p.seconds:.2g}" if p.seconds < 99.5 else f"{p.seconds:.0f}"
    errors = (f"{value:.2g}" for value in (p.typical, p.anywhere, p.percent))
    words = p.name if p.name.startswith("profile") else p.name.replace("-", " ")
    return [f"**{seconds}**" if is_best else seconds, *errors, METHODS[p.method].words, words]


def _front(found: Sequence[Point]) -> list[bool]:
    return pareto([p.seconds for p in found], [p.typical for p in found])


MARKS = (
    ("D", "white", "profile, one radius of the wall"),
    ("s", "white", "the whole tube in three dimensions"),
    ("o", "0.3", "filled: no setting is faster and better"),
)


def _draw(found: Sequence[Point]) -> None:
    page = Page(
        FIGURES,
        PICTURE,
        "The artery: error against CPU time",
        "Filled: the front of all. Squares: the whole tube in three dimensions.",
    )
    with rc_context(STYLE):
        figure = Figure(figsize=(6.6, 4.4), layout="constrained")
        axes = figure.subplots()
        colours = dict(zip(METHODS, COLOURS, strict=False))
        for name, colour in colours.items():
            axes.plot([], [], "o", color=colour, label=METHODS[name].words)
        for marker, face, words in MARKS:
            axes.plot([], [], marker, color="0.3", mfc=face, label=words)
        for point, on in zip(found, _front(found), strict=True):
            is_profile = point.name.startswith("profile")
            colour, marker = colours[point.method], "D" if is_profile else "os"[point.is_whole]
            at = point.seconds, point.typical
            axes.plot(*at, marker, color=colour, mfc=colour if on else "white")
            if is_profile or point.name.startswith("full"):
                text = (
                    point.name.removeprefix("profile-")
                    if is_profile
                    else "the paper's mesh and step"
                )
                axes.annotate(
                    text, at, (6, 4), textcoords="offset points", fontsize=6.5, color="0.3"
                )
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="CPU time, s",
            ylabel="error of the fibre angle, degrees",
        )
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
        axes.legend(fontsize=7)
        page.save_figure(figure, made_with())


def main() -> None:
    """Run what is missing, and report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=Path("results/work-precision"))
    parser.add_argument("--budget", type=float, default=5.0, help="longest expected run, seconds")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=PARTS,
        default=PARTS,
        help="parts to run, without the page; default: all",
    )
    parser.add_argument("--report", action="store_true", help="make the page from what is there")
    options = parser.parse_args()
    kept = Kept(options.folder)
    if not options.report:
        run(kept, options.only, options.budget)
    if options.report or options.only is PARTS:  # the page needs all parts
        report(kept)


if __name__ == "__main__":
    main()
