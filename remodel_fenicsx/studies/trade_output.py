"""The table of a trade: on a terminal, as CSV, as a picture, and a scene for each row."""

from __future__ import annotations

from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from remodel_fenicsx.paper.output import COLOURS, STYLE, Page
from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.studies.estimates import Row, Trade
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.regular_files import make_own_folder, write_whole

ROWS = "rows"  # folder of the scenes
APART = 0.9  # ratio of two errors whose points both have a name


def in_words(found: Trade) -> str:
    """The table for a terminal."""
    head = f"{'':2}{'seconds':>9} {'degrees':>9} {'length %':>9}  setting"
    lines = [head]
    for row in found.rows:
        setting = row.result.setting
        doubt = f"  ({row.doubt})" if row.doubt else ""
        lines.append(
            f"{'* ' if row.best else '  '}{row.result.seconds:9.3g} {row.angle_error:9.2g} "
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
        "seconds": [row.result.seconds for row in rows],
        "angle_error": [row.angle_error for row in rows],
        "length_error": [row.length_error for row in rows],
        "noise": [row.result.noise for row in rows],
        "best": [int(row.best) for row in rows],
        "doubt": [row.doubt for row in rows],
    }
    page.save_table(table, [title, *found.notes, made_with])
    make_own_folder(folder / ROWS)
    for row in rows:
        setting = row.result.setting
        doubt = f" ({row.doubt})" if row.doubt else ""
        header = (
            f"{scene.name}: {row.angle_error:.2g} degrees and {100 * row.length_error:.2g} % off for "
            f"{row.result.seconds:.2g} s, as estimated by remodel-fenicsx trade{doubt}"
        )
        write_whole(folder / ROWS / f"{setting.name}.toml", setting.scene.to_toml(header).encode())
    _draw(page, rows, made_with)


def _draw(page: Page, rows: list[Row], made_with: str) -> None:
    shown = [row for row in rows if row.angle_error > 0]
    kinds = dict(zip(dict.fromkeys(row.result.setting.mesh[0] for row in shown), COLOURS, strict=False))
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.2), layout="constrained")
        axes = figure.subplots()
        for row in shown:
            colour = kinds[row.result.setting.mesh[0]]
            filled = colour if row.best else "white"
            axes.plot(row.result.seconds, row.angle_error, "o", color=colour, markerfacecolor=filled)
        for kind, colour in kinds.items():
            axes.plot([], [], "o", color=colour, label=kind)
        front = [row for row in shown if row.best]
        axes.plot([r.result.seconds for r in front], [r.angle_error for r in front], color="0.6", zorder=0, lw=0.8)
        for row in _named(front):
            _, refinement, degree = row.result.setting.mesh
            time = row.result.setting.scene.time
            step = f"step {time.step:g}" if time.tolerance is None else f"tolerance {time.tolerance:g}"
            text, at = f"mesh {refinement}, degree {degree}, {step}", (row.result.seconds, row.angle_error)
            axes.annotate(text, at, xytext=(5, 3), textcoords="offset points", fontsize=6.5, color="0.3")
        axes.set(xscale="log", yscale="log")
        axes.set(xlabel="seconds of the processor", ylabel="error of the fibre angle, degrees")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
        if kinds:
            axes.legend()
        page.save_figure(figure, made_with)


def _named(front: list[Row]) -> list[Row]:
    """Those whose names do not lie on each other."""
    named: list[Row] = []
    for row in front:
        if not named or row.angle_error < APART * named[-1].angle_error:
            named.append(row)
    return named
