"""`remodel-fenicsx stability SCENE`: the factors by which the passes of a run multiply a small change of the cells."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI

from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.results.run_folder import RunFolder, chosen_folder, locked
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.simulation import Simulation
from remodel_fenicsx.studies.page import COLOURS, Answer, aligned
from remodel_fenicsx.system.interrupts import PAUSE, StopRequest, end_all_ranks_on_exception
from remodel_fenicsx.system.terminal import Progress, hold_log, open_log
from remodel_fenicsx.watch.amplification import SHARE_NAMES, AmplificationWatcher, PassMode

log = logging.getLogger(__name__)

GROWS = 1.001  # factor: changes that no pass touches, where tension is missing, keep their size to what was iterated
LONG_SCALE = -12.0  # lowest factor that is drawn on a linear scale
Table = dict[str, list[float]]


def stability(
    scene: Scene,
    folder: Path | str | None = None,
    number: int = 10,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    quiet: bool = True,
) -> tuple[Path, Analysis]:
    """Run a scene and analyse the stability of its passes on the way."""
    if not LAWS[scene.remodeling.law].remodels:
        raise SceneError(f"remodeling.law = {scene.remodeling.law!r}: nothing remodels, so there is no pass to analyse")
    if scene.cases[1:]:
        raise SceneError("cases: the analysis takes one load case; leave out [[cases]]")
    if scene.time.tolerance is not None and not scene.time.is_equilibrium:
        raise SceneError(f"time.tolerance = {scene.time.tolerance:g}: the analysis needs equal steps; leave it out")
    end_all_ranks_on_exception()
    with hold_log(comm.rank, quiet=quiet) as held:
        simulation = Simulation(scene, comm)
    scene = simulation.scene  # with the kinematics that was chosen
    place = chosen_folder(folder, f"{scene.name}-stability", comm)
    steps, share = scene.time.number_of_steps, simulation.stepper.remodeling.share
    chosen = {round(steps * (index + 1) / number) for index in range(number)}
    watcher = AmplificationWatcher(simulation.stepper, lambda step: step.number in chosen)

    with ExitStack() as stack:
        stop = stack.enter_context(StopRequest())
        simulation.state.stop_signal = lambda: stop.number or (PAUSE if stop.pause else 0)
        stack.enter_context(locked(place, comm, new=True))
        record = stack.enter_context(RunFolder(place, scene.to_toml("as analysed: all values"), comm.rank))
        stack.enter_context(open_log(place / "run.log", comm.rank, quiet=quiet, held=held))
        kinematics = scene.model.kinematics
        log.info("analysing %s at %d of %d steps, kinematics %r", scene.name, len(chosen), steps, kinematics)
        for unseen in unseen_by(scene):
            log.info("%s", unseen)
        progress = stack.enter_context(Progress(steps, f"{scene.name} stability", -1 if quiet else comm.rank))
        try:
            for step in simulation.steps([watcher, record]):
                progress.step(step.number, step.time, "", step.work.newton_iterations, None)
                if step.number in chosen:
                    found = _factor(watcher.found[-1].reversing)
                    log.info("time %g: a pass multiplies the worst small change by %.3g", step.time, found)
        finally:
            if comm.rank == 0 and watcher.found:  # of a run that ends early too
                Analysis(scene, as_table(watcher, share), share).write(place)
        simulation.close()
    return place, Analysis(scene, as_table(watcher, share), share)


def unseen_by(scene: Scene) -> list[str]:
    """What an analysis on the scene's kinematics does not see, in a sentence; nothing where it sees all."""
    name = scene.model.kinematics
    if not KINEMATICS[name].reduced:
        return []
    return [
        f"kinematics {name!r} sees changes that keep its symmetry only: passes of the whole body may multiply others "
        "by more, and the body may buckle; model.kinematics = 'full' sees all"
    ]


def as_table(watcher: AmplificationWatcher, share: float) -> Table:
    """Columns of stability.csv, one row per time that was analysed; NaN where a mode was not found."""
    table: Table = {"time": [found.time for found in watcher.found]}
    reversing = [found.reversing for found in watcher.found]
    factors = np.array([_factor(mode) for mode in reversing])
    table["factor"] = list(factors)
    table["factor_of_coupling"] = list(1 - share * (1 - factors))
    table["stable_share"] = list(np.minimum(1.0, 2 / (1 - np.minimum(factors, 0.0))))
    for index, name in enumerate("xyz"):
        table[name] = [np.nan if mode is None else mode.place[index] for mode in reversing]
    table["volume_share"] = [np.nan if mode is None else mode.volume_share for mode in reversing]
    for name in SHARE_NAMES:
        table[name] = [np.nan if mode is None else mode.shares[name] for mode in reversing]
    table["growing_factor"] = [_factor(found.growing) for found in watcher.found]
    return table


def _factor(mode: PassMode | None) -> float:
    return np.nan if mode is None else mode.factor


# ---------------------------------------------------------------- the answer
@dataclass(frozen=True)
class Analysis(Answer):
    """Factors of the passes, by column of stability.csv; the coupling makes a share of each pass."""

    scene: Scene
    columns: Table
    share: float

    name = "stability"
    caption = "Factor by which one pass multiplies the worst small change of the cells; below -1 it swings and grows."

    @property
    def title(self) -> str:
        """Of the picture."""
        how = self.scene.remodeling
        return f"{self.scene.name}: driver {how.driver}, frame {how.frame}, coupling {how.coupling}"

    def table(self) -> Table:
        """A row for each time."""
        return self.columns

    def lines(self) -> list[str]:
        """A row for each time."""
        return aligned({name: v for name, v in self.columns.items() if name != "growing_factor"}, 8, 3)

    def verdict(self) -> str:
        """Whether passes with the scene's coupling make small changes smaller; and what the analysis does not see."""
        unseen = "".join(f" But {words}." for words in unseen_by(self.scene))
        return verdict(self.columns) + unseen

    def figure(self) -> Figure:
        """Factors over time."""
        figure = Figure(figsize=(5.2, 3.4), layout="constrained")
        axes, table = figure.add_subplot(), self.columns
        axes.axhspan(-1, 1, color=COLOURS[2], alpha=0.12, linewidth=0, label="stable: from −1 to 1")
        axes.plot(table["time"], table["factor"], "o-", markersize=4, color=COLOURS[1], label="whole pass")
        if self.share != 1.0:
            words = f"the share {self.share:g} of it that is made"
            axes.plot(table["time"], table["factor_of_coupling"], "s-", markersize=4, color=COLOURS[0], label=words)
        lowest = np.nanmin([*table["factor"], -1.6])
        if lowest < LONG_SCALE:
            axes.set_yscale("symlog", linthresh=2, linscale=1.0)
            ticks = [1, 0, -1, -2, *(t for t in (-5, -10, -20, -50, -100, -200, -500, -1000) if t > 1.3 * lowest)]
            axes.set_yticks(ticks, [f"{tick:d}".replace("-", "−") for tick in ticks])
            axes.set_yticks([], minor=True)
        axes.set(ylim=(1.3 * lowest, 1.2), xlabel="time")
        axes.set(ylabel="factor of one pass on the\nworst small change of the cells")
        axes.set_xlim(left=0)
        figure.legend(loc="outside lower center", ncols=2)
        return figure


def verdict(table: Table) -> str:
    """The answer in a sentence: whether passes with the scene's coupling make small changes smaller."""
    times, factors, growing = (np.array(table[name]) for name in ("time", "factor_of_coupling", "growing_factor"))
    unknown = ~np.isfinite(table["factor"])
    swings, grows = factors < -1, growing > GROWS
    if swings.any():
        worst, share = int(np.nanargmin(factors)), np.nanmin(table["stable_share"])
        return (
            f"Unstable: passes over-correct at {swings.sum()} of {len(times)} times, first at {times[swings][0]:g}; "
            f"the worst multiplies a small change by {factors[worst]:.3g} at time {times[worst]:g}. The coupling "
            f"'relaxed' with a relaxation_factor below {share:.2g} does not."
        )
    if grows.any():
        worst = int(np.nanargmax(growing))
        return (
            f"Unstable: at {grows.sum()} of {len(times)} times a small change of the cells grows from pass to pass "
            f"without swinging, first at {times[grows][0]:g}; by {growing[worst]:.3g} at time {times[worst]:g}."
        )
    if unknown.any():
        return f"Not known: at {unknown.sum()} of {len(times)} times no mode was found (run.log); stable at all others."
    return (
        f"Stable: at all {len(times)} times a pass makes small changes of the cells smaller, or keeps them as they are."
    )
