"""`remodel-fenicsx stability SCENE`: the factors by which the passes of a run multiply a small change of the cells."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpi4py import MPI

from remodel_fenicsx.evolution.amplification import SHARE_NAMES, AmplificationWatcher, Mode
from remodel_fenicsx.paper.output import COLOURS, STYLE, Page
from remodel_fenicsx.results.run_folder import RunFolder, chosen_folder
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.system.environment import versions
from remodel_fenicsx.system.interrupts import StopRequest, end_all_ranks_on_exception
from remodel_fenicsx.system.terminal import Progress, open_log
from remodel_fenicsx.tissue.laws import LAWS

log = logging.getLogger(__name__)

NAME = "stability"
LONG_SCALE = -12.0  # lowest factor that is drawn on a linear scale
Table = dict[str, list[float]]


def stability(
    scene: Scene,
    folder: Path | str | None = None,
    number: int = 10,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    quiet: bool = True,
) -> tuple[Path, Table]:
    """Run a scene and analyse the stability of its passes on the way.

    Parameters
    ----------
    scene
        The validated scene.
    folder
        New or empty folder; default: results/NAME-stability, numbered when taken.
    number
        How many times of the run are analysed, spread evenly, the last one among them.
    comm
        MPI communicator.
    quiet
        No progress on the terminal.

    Returns
    -------
    The folder with stability.csv, stability.png, history.csv, scene.toml and run.log; and the columns of stability.csv.

    Raises
    ------
    SceneError
        If nothing remodels.
    FolderTaken, StepFailure, Interrupted, OSError
        As `running.run` does.
    """
    if not LAWS[scene.remodeling.law].remodels:
        raise SceneError(f"remodeling.law = {scene.remodeling.law!r}: nothing remodels, so there is no pass to analyse")
    if scene.time.tolerance is not None and not scene.time.is_equilibrium:
        raise SceneError(f"time.tolerance = {scene.time.tolerance:g}: the analysis is one of equal steps; leave it out")
    end_all_ranks_on_exception()
    simulation = Simulation(scene, comm)
    scene = simulation.scene  # with the kinematics that was chosen
    place = chosen_folder(folder, f"{scene.name}-{NAME}", comm)
    steps, share = scene.time.number_of_steps, simulation.stepper.coupling.share
    chosen = {round(steps * (index + 1) / number) for index in range(number)}
    analysis = AmplificationWatcher(simulation.stepper, lambda step: step.number in chosen)
    with ExitStack() as stack:
        stop = stack.enter_context(StopRequest())
        simulation.stepper.stop_signal = lambda: stop.number
        record = stack.enter_context(RunFolder(place, scene.to_toml("as analysed: all values"), comm.rank))
        stack.enter_context(open_log(place / "run.log", comm.rank, quiet=quiet))
        progress = stack.enter_context(Progress(steps, f"{scene.name} {NAME}", -1 if quiet else comm.rank))
        try:
            for step in simulation.steps([analysis, record]):
                progress.step(step.number, step.time, "", step.work.newton_iterations, None)
        finally:
            if comm.rank == 0 and analysis.found:  # of a run that ends early too
                draw(as_table(analysis, share), place, scene, share)
        simulation.close()
    return place, as_table(analysis, share)


def as_table(analysis: AmplificationWatcher, share: float) -> Table:
    """Columns of stability.csv, one row per time that was analysed; NaN where a mode was not found."""
    table: Table = {"time": [found.time for found in analysis.found]}
    reversing = [found.reversing for found in analysis.found]
    factors = np.array([_factor(mode) for mode in reversing])
    table["factor"] = list(factors)
    table["factor_of_coupling"] = list(1 - share * (1 - factors))
    table["stable_share"] = list(np.minimum(1.0, 2 / (1 - np.minimum(factors, 0.0))))
    for index, name in enumerate("xyz"):
        table[name] = [np.nan if mode is None else mode.place[index] for mode in reversing]
    table["volume_share"] = [np.nan if mode is None else mode.volume_share for mode in reversing]
    for name in SHARE_NAMES:
        table[name] = [np.nan if mode is None else mode.shares[name] for mode in reversing]
    table["growing_factor"] = [_factor(found.growing) for found in analysis.found]
    return table


def _factor(mode: Mode | None) -> float:
    return np.nan if mode is None else mode.factor


def in_words(table: Table) -> str:
    """The table for a terminal."""
    names = ("time", "factor", "factor_of_coupling", "stable_share", "x", "y", "z", "volume_share", *SHARE_NAMES)
    lines = [" ".join(f"{name:>{max(8, len(name))}}" for name in names)]
    for row in range(len(table["time"])):
        lines.append(" ".join(f"{table[name][row]:{max(8, len(name))}.3g}" for name in names))
    return "\n".join(lines)


def draw(table: Table, folder: Path, scene: Scene, share: float) -> None:
    """Write stability.csv and stability.png."""
    remodeling = scene.remodeling
    title = f"{scene.name}: driver {remodeling.driver}, frame {remodeling.frame}, coupling {remodeling.coupling}"
    caption = "Factor by which one pass multiplies the worst small change of the cells; below -1 it swings and grows."
    page = Page(folder, NAME, title, caption)
    made_with = ", ".join(f"{name} {version}" for name, version in versions().items() if name != "BLAS")
    page.save_table(table, [title, made_with])
    with rc_context(STYLE):
        figure = Figure(figsize=(5.2, 3.4), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        axes.axhspan(-1, 1, color=COLOURS[2], alpha=0.12, linewidth=0)
        axes.annotate("stable", (0.99, -1), xycoords=("axes fraction", "data"), xytext=(0, 3), ha="right", va="bottom",
                      textcoords="offset points", color=COLOURS[2])  # fmt: skip
        axes.plot(table["time"], table["factor"], "o-", markersize=4, color=COLOURS[1], label="whole pass")
        if share != 1.0:
            label = f"the share {share:g} of it that is made"
            axes.plot(table["time"], table["factor_of_coupling"], "s-", markersize=4, color=COLOURS[0], label=label)
        lowest = np.nanmin([*table["factor"], -1.6])
        if lowest < LONG_SCALE:
            axes.set_yscale("symlog", linthresh=2, linscale=1.0)
            ticks = [1, 0, -1, -2, *(t for t in (-5, -10, -20, -50, -100, -200, -500, -1000) if t > 1.3 * lowest)]
            axes.set_yticks(ticks, [f"{tick:d}".replace("-", "−") for tick in ticks])
            axes.set_yticks([], minor=True)
        axes.set_ylim(1.3 * lowest, 1.2)
        axes.set_xlim(left=0)
        axes.set_xlabel("time")
        axes.set_ylabel("factor of a pass, most negative")
        axes.set_title(title)
        figure.legend(loc="outside lower center", ncols=2)
        page.save_figure(figure, made_with)
