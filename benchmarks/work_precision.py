#!/usr/bin/env python3
"""Error against time of the processor for every setting of the artery, one factor at a time, and the front of all.

    ./with-fenicsx benchmarks/work_precision.py [--folder DIR] [--budget SECONDS] [--only PART...] [--report]

Parts: `artery`, the settings of `remodel-fenicsx trade` and the profiles on the paper's artery with isotropic cells,
for the printed coupling and the consistent variant, against the one-dimensional solver of
tests/reference with steps of 1/8 and 1/16 (1/2 and 1/4 for the law tensor), extrapolated; `paper`, the paper's own mesh
there; `whole`, the whole tube in three dimensions, up to 20 minutes a run. An hour or more of one core, most of it the
whole tube. Then makes tables and picture of docs/speed_and_accuracy.md, and tables.md beside what is recorded; --only
makes no page, --report makes it from what is there. What is recorded is used again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from benchmarks.precision import whole
from benchmarks.precision.kept import EVERY_TANGENT, Array, Found, Kept
from docs.making.pages import DOCS, FIGURES, between_marks, filled, lines, made_with, markdown
from remodel_fenicsx.body.shape import profile_weights
from remodel_fenicsx.scene.presets import PROFILES
from remodel_fenicsx.scene.scene import Scene, preset_scene
from remodel_fenicsx.studies import trade as rungs
from remodel_fenicsx.studies.page import COLOURS, STYLE, Page
from remodel_fenicsx.studies.trade import pareto
from tests.reference.radial import solve_radial

PICTURE = "speed_and_accuracy"
PAGE = DOCS / "speed_and_accuracy.md"
HEAD = ["seconds", "degrees", "largest", "radii, %", "method", "setting"]
PARTS = ("artery", "paper", "whole")
COARSE = (8.0, 4.0)  # tolerances, degrees
RADIAL = {"model.kinematics": "radial"}
TIMES = [5.0, 25.0, 45.0, 65.0, 85.0, 105.0, 125.0, 145.0, 150.0]
REFERENCE = {"explicit": (150, 1 / 8, 1 / 16), "tensor": (60, 1 / 2, 1 / 4)}  # elements and steps, by law


@dataclass(frozen=True)
class Method:
    """A way of marching: its preset, coupling and the law of the reference."""

    words: str
    preset: str
    coupling: str
    law: str


METHODS = {
    "printed": Method("printed: explicit law, staggered", "kuhl-holzapfel-2007", "staggered", "explicit"),
    "consistent": Method("law tensor, extrapolated", "consistent", "extrapolated", "tensor"),
}


@dataclass(frozen=True)
class Point:
    """A setting with its true errors."""

    method: str
    name: str
    words: str
    found: Found

    @property
    def is_whole(self) -> bool:
        """Whether it is the whole tube in three dimensions."""
        return self.name.startswith(("full", "whole"))


def scene(method: Method) -> Scene:
    """The artery of isotropic cells."""
    changes = {"cells.initial": "isotropic", "remodeling.coupling": method.coupling}
    return preset_scene(method.preset, "tube").with_values(EVERY_TANGENT | changes)


def settings(method: Method) -> list[rungs.Setting]:
    """Those of the ladder, and the profiles."""
    base = scene(method)
    profiles = [
        rungs.Setting(profile.values, base.with_values({**profile.values, **RADIAL}), (1,), name)
        for name, profile in PROFILES.items()
    ]
    return [*coarse(base), *(one for one in rungs.ladder(base) if not one.profile), *profiles]


def coarse(base: Scene) -> list[rungs.Setting]:
    """Below what a study asks for: steps as long as the compared times allow, on the coarsest elements."""
    every = [{**RADIAL, "time.tolerance": tolerance} for tolerance in COARSE]
    return [rungs.Setting(values, base.with_values(values), (1,)) for values in every]


def reference(law: str, kept: Kept) -> tuple[Array, Array]:
    """Angles and radii of the reference at the compared times, with what is left of steps extrapolated."""
    name = f"reference-{law}"
    if name not in kept:
        elements, *steps = REFERENCE[law]
        (angles, radii), (finer_angles, finer_radii) = (_reference(law, step, int(elements)) for step in steps)
        kept.keep(name, {"angles": 2 * finer_angles - angles, "radii": 2 * finer_radii - radii})
    return kept[name]["angles"], kept[name]["radii"]


def _reference(law: str, step: float, elements: int) -> tuple[Array, Array]:
    history = solve_radial(step=step, elements=elements, law=law)
    hats = profile_weights((history.points - 1.0) / 2.0) * history.areas[:, None]
    rows = [round(time / step) - 1 for time in TIMES]
    dimensions = history.dimensions[rows]
    angles = np.degrees(np.arctan2(dimensions[..., 1], dimensions[..., 0])) @ hats / hats.sum(axis=0)
    return angles, np.stack([history.inner_radii[rows], history.outer_radii[rows]], axis=1)


def run(kept: Kept, parts: Sequence[str], budget: float) -> None:
    """What is asked for and not kept yet."""
    if "artery" in parts:
        run_artery(kept, budget, paper=False)
    if "paper" in parts:
        run_artery(kept, 0.0, paper=True)
    if "whole" in parts:
        for name, method in METHODS.items():
            for setting in whole.settings(name, scene(method)):
                kept.measure(f"{name}-{setting.name}", setting.scene, TIMES)


def run_artery(kept: Kept, budget: float, paper: bool) -> None:
    """All settings of a few expected seconds and the profiles, or the paper's own."""
    for name, method in METHODS.items():
        for setting in sorted(settings(method), key=lambda setting: not setting.name.startswith("profile")):
            own = paper and name == "printed" and setting.mesh[0] == "full"
            asked = own or (setting.name.startswith("profile") and not paper)
            if setting.expected_seconds < budget or asked:
                kept.measure(f"{name}-{setting.name}", setting.scene, TIMES)


def points(kept: Kept) -> Iterator[Point]:
    """All that is kept."""
    for name, method in METHODS.items():
        exact = reference(method.law, kept)
        for setting in [*settings(method), *whole.settings(name, scene(method))]:
            if (file := f"{name}-{setting.name}") in kept:
                yield Point(name, setting.name, words_of(setting), kept.found(file, *exact))


def words_of(setting: rungs.Setting) -> str:
    """What a row calls it."""
    if setting.profile:
        return setting.name
    kinematics, refinement, degree = setting.mesh
    every = ", every tangent factorised" if setting.name.startswith("full") else whole.other_words(setting.name)
    return f"{kinematics} refinement {refinement} degree {degree} {setting.steps_in_words}{every}"


def report(kept: Kept) -> None:
    """Write the page, its appendix and its picture."""
    found = sorted(points(kept), key=lambda point: point.found.seconds)
    whole_tube = [point for point in found if point.is_whole]
    made = fill(f"Made with {made_with()}.", 100)
    parts = {"rows": rows_of(found), "whole": rows_of(whole_tube), "made": made}
    text = filled(Path(__file__).with_suffix(".template.md"), parts)
    (kept.folder / "tables.md").write_text(text, encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    for name, made in {"paper": paper_rows(found), "front": best(found), "whole": best(whole_tube)}.items():
        text = between_marks(text, name, made)
    PAGE.write_text(text, encoding="utf-8")
    _draw(found)


def rows_of(found: Sequence[Point]) -> str:
    """Settings, the cheapest first; those on their front stand out."""
    return lines(_row(point, on) for point, on in zip(found, _front(found), strict=True))


def best(found: Sequence[Point]) -> str:
    """Those on the front."""
    on = [point for point, is_best in zip(found, _front(found), strict=True) if is_best]
    return markdown(HEAD, (_row(point, False) for point in on))


def _row(p: Point, is_best: bool) -> list[str]:
    seconds = f"{p.found.seconds:.2g}" if p.found.seconds < 99.5 else f"{p.found.seconds:.0f}"
    errors = (f"{value:.2g}" for value in (p.found.typical, p.found.anywhere, p.found.percent))
    return [f"**{seconds}**" if is_best else seconds, *errors, METHODS[p.method].words, p.words]


def paper_rows(found: Sequence[Point]) -> str:
    """The paper's own setting beside the wall alone on the same elements."""
    printed = {point.name: point.found for point in found if point.method == "printed"}
    whole, wall = printed["full-1-degree-1-step-1"], printed["radial-1-degree-1-step-1"]
    own = [
        "the whole tube, every tangent factorised",
        f"{whole.seconds:.3g}",
        f"{whole.typical:.2g}",
        f"{whole.anywhere:.2g}",
    ]
    alone = ["the wall alone on the same elements", f"{wall.seconds:.1g}", f"{wall.typical:.2g}", ""]
    return markdown(["the printed method", "seconds", "degrees", "largest"], [own, alone])


def _front(found: Sequence[Point]) -> list[bool]:
    return pareto([p.found.seconds for p in found], [p.found.typical for p in found])


def _draw(found: Sequence[Point]) -> None:
    title = "The artery: error against time of the processor"
    page = Page(FIGURES, PICTURE, title, "Filled: the front of all. Squares: the whole tube in three dimensions.")
    front = _front(found)
    with rc_context(STYLE):
        figure = Figure(figsize=(6.6, 4.4), layout="constrained")
        axes = figure.subplots()
        mine = [p for p in found if p.is_whole]
        best = [(p.found.seconds, p.found.typical) for p, on in zip(mine, _front(mine), strict=True) if on]
        axes.plot(*zip(*best, strict=True), "-", color="0.7", linewidth=0.8, zorder=0, label="front of the whole tube")
        for (name, method), colour in zip(METHODS.items(), COLOURS, strict=False):
            axes.plot([], [], "o", color=colour, label=method.words)
            for point, on in zip(found, front, strict=True):
                if point.method == name:
                    marker = "D" if point.name.startswith("profile") else "s" if point.is_whole else "o"
                    at, face = (point.found.seconds, point.found.typical), colour if on else "white"
                    axes.plot(*at, marker, color=colour, markerfacecolor=face)
                    if marker == "D" or point.name.startswith("full"):
                        text = point.name.removeprefix("profile-") if marker == "D" else "the paper's mesh and step"
                        side = {"xytext": (5, 3 if marker == "D" else -3)}
                        axes.annotate(text, at, textcoords="offset points", fontsize=6.5, color="0.3", **side)
        axes.set(xscale="log", yscale="log", xlabel="seconds of the processor")
        axes.set(ylabel="error of the fibre angle, degrees")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
        axes.legend()
        page.save_figure(figure, made_with())


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
    kept = Kept(options.folder)
    if not options.report:
        run(kept, options.only, options.budget)
    if options.report or options.only is PARTS:  # the page needs all parts
        report(kept)


if __name__ == "__main__":
    main()
