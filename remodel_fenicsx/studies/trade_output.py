"""The table of a trade: on a terminal, as CSV, as a picture, and a scene for each row."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from remodel_fenicsx.studies.page import COLOURS, STYLE, Page
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.studies.estimates import Row, Trade
from remodel_fenicsx.studies.ladder import compared_lengths
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.regular_files import make_own_folder, write_whole

ROWS = "rows"  # folder of the scenes
SIZE = 8.0  # of a point with a number in it
APART = 0.05  # of the axes: such points that are closer would cover each other


def in_words(found: Trade) -> str:
    """The table for a terminal."""
    lengths = compared_lengths(found.rows[0].result.setting.scene)[0]
    lines = [f"{'':2}{'seconds':>9} {'degrees':>9} {lengths + ' %':>9}  setting"]
    for row in found.rows:
        setting = row.result.setting
        doubt = f"  ({row.doubt})" if row.doubt else ""
        lines.append(
            f"{'* ' if row.on_front else '  '}{row.result.seconds:9.3g} {row.angle_error:9.2g} "
            f"{100 * row.length_error:9.2g}  {setting.in_words()}{doubt}"
        )
    lines.append("*: no other one is as good for less. Errors are estimates; degrees: fibre angle, root mean square.")
    lines += found.notes
    if found.left_out:
        lines.append(f"left out, over the budget: {', '.join(found.left_out)}")
    return "\n".join(lines)


def write(found: Trade, folder: Path, scene: Scene) -> None:
    """Write trade.csv, trade.png and a scene of each row."""
    title = f"{scene.name}: error and cost of its settings"
    made_with = ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")
    page = Page(folder, "trade", title, "Estimated errors; filled: no other setting is as good for less.")
    rows = found.rows
    table: dict[str, list[str] | list[float] | list[int]] = {
        "setting": [row.result.setting.name for row in rows],
        "scene": [_scene_file(row) for row in rows],
        "error_degrees": [row.angle_error for row in rows],
        f"error_{compared_lengths(scene)[0]}": [row.length_error for row in rows],
        "cpu_seconds": [row.result.seconds for row in rows],
        "on_front": [int(row.on_front) for row in rows],
        "trusted": [int(not row.doubt) for row in rows],
        "doubt": [row.doubt for row in rows],
        "noise": [row.result.noise for row in rows],
    }
    page.save_table(table, [title, *found.notes, made_with])
    make_own_folder(folder / ROWS)
    for row in rows:
        doubt = f" ({row.doubt})" if row.doubt else ""
        header = (
            f"{scene.name}: {row.angle_error:.2g} degrees and {100 * row.length_error:.2g} % off for "
            f"{row.result.seconds:.2g} s, as estimated by remodel-fenicsx trade{doubt}"
        )
        write_whole(folder / _scene_file(row), row.result.setting.scene.to_toml(header).encode())
    with rc_context(STYLE):
        page.save_figure(picture(rows), made_with)


def _scene_file(row: Row) -> str:
    return f"{ROWS}/{row.result.setting.name}.toml"


def picture(rows: list[Row]) -> Figure:
    """Cost against error; points of the front have numbers, and beside the axes stands what they are.

    Of points that would cover each other the cheapest has one.
    """
    shown = [row for row in rows if row.angle_error > 0]
    kinds = dict(zip(dict.fromkeys(row.result.setting.way for row in shown), COLOURS, strict=False))
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.set(xscale="log", yscale="log", xlabel="seconds of the processor", ylabel="error of the fibre angle, degrees")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    front = [row for row in shown if row.on_front]
    axes.plot(*_places(front), color="0.6", zorder=0, lw=0.8)
    for way, colour in kinds.items():
        same = [row for row in shown if row.result.setting.way == way]
        axes.plot(*_places(same), "o", color=colour, markerfacecolor="white", markersize=4, label=", ".join(way))
    names = []
    for row in front:
        axes.plot(row.result.seconds, row.angle_error, "o", color=kinds[row.result.setting.way], markersize=4)
    for number, row in enumerate(_apart(front, shown), start=1):
        colour, at = kinds[row.result.setting.way], (row.result.seconds, row.angle_error)
        axes.plot(*at, "o", color=colour, markersize=SIZE)
        axes.annotate(str(number), at, ha="center", va="center_baseline", fontsize=6, color="white")
        names.append(f"{number}  {_words(row)}")
    names += [f"no error: {_words(row)}" for row in rows if row.on_front and row not in front]
    axes.margins(0.06)  # a point of the front is half as wide
    if kinds:
        figure.legend(loc="outside upper left", ncols=3)
        nothing = [Line2D([], [], linestyle="")] * len(names)
        place: dict[str, Any] = {"loc": "outside right center", "title": "the front", "title_fontsize": 7.5}
        figure.legend(nothing, names, handlelength=0, fontsize=6.5, **place)
    return figure


def _apart(front: list[Row], shown: list[Row]) -> list[Row]:
    """Those of the front whose points do not cover each other."""
    spread = np.maximum(np.ptp(np.log(_places(shown)), axis=1), 1e-9) if shown else np.ones(2)
    found: list[Row] = []
    for row in front:
        ways = [np.ptp(np.log(_places([row, other])), axis=1) / spread for other in found]
        if all(np.hypot(*way) > APART for way in ways):
            found.append(row)
    return found


def _words(row: Row) -> str:
    return " ".join(row.result.setting.in_words().split())


def _places(rows: list[Row]) -> tuple[list[float], list[float]]:
    return [row.result.seconds for row in rows], [row.angle_error for row in rows]
