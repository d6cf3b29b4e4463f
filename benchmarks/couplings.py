#!/usr/bin/env python3
"""Which law and coupling gives most for its CPU time: error against time.

    ./with-fenicsx benchmarks/couplings.py              # minutes on an idle core
    ./with-fenicsx benchmarks/couplings.py --page       # only the page, from what has been measured

Table and picture of docs/time_integration.md.

Error: one layer of the artery's elements along z to t = 40, with steps from 5 to 5/8; each law against its own limit.
"""

from __future__ import annotations

import argparse
import time as clock
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI

from docs.making.pages import (
    DOCS,
    FIGURES,
    between_marks,
    by_column,
    markdown,
    panel_letters,
    read_table,
)
from remodel_fenicsx import read_scene
from remodel_fenicsx.body.tube import Tube, whole_tube
from remodel_fenicsx.studies.study import COLOURS, STYLE, Page
from tests.runs import made

PAGE = DOCS / "time_integration.md"
ARTERY = Path(__file__).parents[1] / "demos" / "artery.toml"
STEPS = (5.0, 2.5, 1.25, 0.625)
TUBE = Tube(inner_radius=1.0, outer_radius=3.0, length=0.5)
FINEST = 0.15625  # of the limits, which are extrapolated from it and from twice as long steps
PRINTED = {"remodeling.law": "explicit", "remodeling.frame": "material"}
CONSISTENT = {
    "remodeling.law": "tensor",
    "remodeling.frame": "material",
    "material.repulsion": "log",
}


class Scheme(NamedTuple):
    """A law with its coupling, the coupling that its limit is computed with, its order, and its colour."""

    label: str
    values: dict[str, Any]
    coupling: str
    limit: tuple[str, int]
    colour: str


SCHEMES = {
    "printed-staggered": Scheme(
        "eq. (11), staggered", PRINTED, "staggered", ("staggered", 1), COLOURS[0]
    ),
    "printed-relaxed": Scheme(
        "eq. (11), relaxed", PRINTED, "relaxed", ("staggered", 1), COLOURS[4]
    ),
    "tensor-staggered": Scheme(
        "tensor, staggered", CONSISTENT, "staggered", ("extrapolated", 2), COLOURS[1]
    ),
    "tensor-extrapolated": Scheme(
        "tensor, extrapolated", CONSISTENT, "extrapolated", ("extrapolated", 2), COLOURS[2]
    ),
}
CAPTION = (
    "Error against CPU time",
    "Error of A at t = 40 (root mean square over all points, over r0^2) against CPU time, each law against its "
    "own limit; points: steps of 5, 2.5, 1.25 and 0.625. (a) Isotropic cells, (b) random cells.",
)
Columns = dict[str, np.ndarray]


# ---------------------------------------------------------------- error
def layer(
    scheme: Scheme, cells: str, step: float, coupling: str
) -> tuple[np.ndarray, np.ndarray, float]:
    """A and u at the end, and CPU time of the steps."""
    changes = {
        "geometry.length": 0.5,
        "cells.initial": cells,
        "output.fields": False,
        "remodeling.coupling": coupling,
    }
    scene = read_scene(ARTERY, ["time.end=40.0", f"time.step={step}"]).with_values(
        scheme.values | changes
    )
    domain = whole_tube(TUBE, (12, 8, 1), "hexahedron", 1, MPI.COMM_SELF)
    with made(scene, domain) as simulation:
        start = clock.process_time()
        for _ in simulation.steps():
            pass
        spent = clock.process_time() - start
        return simulation.cells.structure_tensor(), simulation.unknown.x.array.copy(), spent


def errors() -> Iterator[dict[str, Any]]:
    """A row for each scheme, kind of cells and step."""
    limits: dict[Any, list[np.ndarray]] = {}
    for cells in ("isotropic", "random"):
        for name, scheme in SCHEMES.items():
            printed_random = cells == "random" and scheme.values is PRINTED
            if printed_random and name != "printed-staggered":
                continue  # no limit (docs/time_integration.md)
            key = cells, str(scheme.values)
            if key not in limits:
                coupling, order = scheme.limit
                fine, coarse = (
                    layer(scheme, cells, step, coupling)[:2] for step in (FINEST, 2 * FINEST)
                )
                # Without a limit: the finest steps.
                share = 0.0 if printed_random else 1 / (2**order - 1)
                limits[key] = [f + share * (f - c) for f, c in zip(fine, coarse, strict=True)]
            for step in STEPS:
                tensor, unknown, spent = layer(scheme, cells, step, scheme.coupling)
                apart = np.linalg.norm(tensor - limits[key][0], axis=(-1, -2))
                moved = np.linalg.norm(unknown - limits[key][1]) / np.linalg.norm(limits[key][1])
                yield {
                    "cells": cells, "scheme": name, "step": step, "error_A": float(np.sqrt(np.mean(apart**2))),
                    "error_u": float(moved), "seconds": spent,
                }  # fmt: skip


# ---------------------------------------------------------------- the page
def draw(table: Columns) -> Figure:
    """Error of A against CPU time."""
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    both = figure.subplots(1, 2, sharey=True, sharex=True)
    for axes, cells in zip(both, ("isotropic", "random"), strict=True):
        for marker, (name, scheme) in zip("os^D", SCHEMES.items(), strict=True):
            rows = (table["cells"] == cells) & (table["scheme"] == name)
            axes.loglog(
                table["seconds"][rows],
                table["error_A"][rows],
                marker,
                ms=4,
                color=scheme.colour,
                label=scheme.label,
            )
        axes.set(xlabel="CPU time, s", title=f"{cells} cells", xticks=(0.1, 0.2, 0.5))
        axes.xaxis.set_major_formatter("{x:g}")
    both[0].set_ylabel("error of $A$ at $t$ = 40")
    both[0].legend(loc="lower left", fontsize=7)
    panel_letters(*both)
    return figure


def order(table: Columns, cells: str, name: str, column: str) -> str:
    """Of the last halving of the step; none where there is no error to speak of."""
    values = table[column][(table["cells"] == cells) & (table["scheme"] == name)]
    return "no error" if values[-2] < 1e-8 else f"{np.log2(values[-2] / values[-1]):.2f}"


def rows_of(table: Columns) -> Iterator[list[str]]:
    """A row of the page for each scheme and kind of cells."""
    for name, scheme in SCHEMES.items():
        for cells in ("isotropic", "random"):
            rows = (table["cells"] == cells) & (table["scheme"] == name)
            if rows.any():
                at_one = rows & (table["step"] == 1.25)
                A, u, spent = (
                    table[key][at_one].item() for key in ("error_A", "error_u", "seconds")
                )
                orders = (order(table, cells, name, key) for key in ("error_A", "error_u"))
                yield [scheme.label, cells, f"{A:.1e}", f"{u:.1e}", *orders, f"{spent:.1f}"]


def page() -> str:
    """docs/time_integration.md with its table made anew."""
    head = ["law, coupling", "cells", "error of A", "of u", "order in A", "in u", "seconds"]
    errors_table = markdown(head, rows_of(read_table(FIGURES / "couplings.csv")))
    return between_marks(PAGE.read_text(encoding="utf-8"), "errors of couplings", errors_table)


def main() -> None:
    """Measure, draw, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--page", action="store_true", help="measure nothing")
    options = parser.parse_args()
    source, of_page = "benchmarks/couplings.py", Page(FIGURES, "couplings", *CAPTION)
    if not options.page:
        of_page.save_table(by_column(errors()), [source])
    with matplotlib.rc_context(STYLE):
        of_page.save_figure(draw(read_table(FIGURES / "couplings.csv")), source)
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
