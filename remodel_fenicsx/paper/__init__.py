"""The paper's figures from this package's own runs: `remodel-fenicsx figures [NAME...]`.

`FIGURES` names them; `draw` runs what is missing and draws. Each figure is a PNG with its data as CSV beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib
from mpi4py import MPI

from remodel_fenicsx.paper import bodies, curves, structures
from remodel_fenicsx.paper.captions import CAPTIONS
from remodel_fenicsx.paper.runs import KAPPAS, LOAD_CASES, load_case_name, obtain, scenes
from remodel_fenicsx.results.recording import Recording
from remodel_fenicsx.studies.page import FORMATS, STYLE, FigureError, Page, check_folder
from remodel_fenicsx.system.children import cores
from remodel_fenicsx.system.terminal import Line

__all__ = ["DEFAULT_FOLDER", "DEFAULT_RUNS", "FIGURES", "FigureError", "draw"]

DEFAULT_FOLDER, DEFAULT_RUNS = Path("figures"), Path("results/figures-cache")


@dataclass(frozen=True)
class FigureSpec:
    """The names of the runs that a figure needs, and how it is drawn from them."""

    runs: tuple[str, ...]
    draw: Callable[[dict[str, Recording], Page], None]


FIGURES: dict[str, FigureSpec] = {
    "fig1": FigureSpec((), curves.draw_chain_force),
    "fig5": FigureSpec(tuple(f"cube-{kappa:g}" for kappa in KAPPAS), curves.draw_alignment),
    "fig6": FigureSpec(("tendon",), structures.draw_tendon),
    "fig7": FigureSpec(("artery",), structures.draw_artery),
    "fig8": FigureSpec(("artery",), structures.draw_layers),
    "fig9": FigureSpec(tuple(load_case_name(*case) for case in LOAD_CASES), structures.draw_load_cases),
    "fig10": FigureSpec(("artery", "artery-pk2"), partial(curves.draw_drivers, other="pk2")),
    "fig11": FigureSpec(("artery", "artery-finger"), partial(curves.draw_drivers, other="finger")),
    "rate": FigureSpec(("artery", "artery-rate"), curves.draw_rate),
    "energy": FigureSpec(("cube-0.025", "tendon", "artery"), curves.draw_energy),
}


def draw(
    names: Sequence[str] = (),
    folder: Path = DEFAULT_FOLDER,
    runs: Path = DEFAULT_RUNS,
    jobs: int | None = None,
    formats: Sequence[str] = ("png",),
    stamp: bool = False,
) -> list[Path]:
    """Draw figures from recorded runs, after running what is not recorded or no longer valid.

    Parameters
    ----------
    names
        Keys of `FIGURES`; none: all.
    folder
        For NAME.png (or .pdf, .svg) and NAME*.csv. Only files that this function wrote are ever overwritten.
    runs
        Recorded runs.
    jobs
        Runs at a time; default: as many as there are cores.
    formats
        Of the pictures: some of "png", "pdf", "svg".
    stamp
        Whether each picture shows at its foot what it was made with; it stands in the file in any case.

    Returns
    -------
    The files written.

    Raises
    ------
    FigureError
        One line and the exit code of the command: bad input 2, a run that failed, no 3D drawing 5.
    Interrupted
        If a signal asked for the end, SIGUSR1 after the steps under way; the same call goes on from there.
    OSError
        If something cannot be written.
    """
    if MPI.COMM_WORLD.size > 1:
        raise FigureError("figures: uses all cores by itself (--jobs); start it without mpirun", 2)
    for name in names:
        if name not in FIGURES:
            raise FigureError(f"figures {name}: no such figure; allowed are {', '.join(FIGURES)}", 2)
    for ending in formats:
        if ending not in FORMATS:
            raise FigureError(f"--format {ending}: no such format; allowed are {', '.join(FORMATS)}", 2)
    if jobs is not None and jobs < 1:
        raise FigureError(f"--jobs {jobs}: must be at least 1", 2)
    if runs.exists() and not runs.is_dir():
        raise FigureError(f"--runs {runs}: is a file; allowed is a folder", 2)
    chosen = [name for name in FIGURES if not names or name in names]
    check_folder(folder, chosen, formats)
    known = scenes()
    needed = dict.fromkeys(run for name in chosen for run in FIGURES[name].runs)
    recorded = obtain([known[run] for run in needed], runs, jobs or cores())
    recordings = {name: Recording(path) for name, path in recorded.items()}
    progress, written = Line("figures"), []
    for number, name in enumerate(chosen, start=1):
        progress.show(f"drawing {name} ({number}/{len(chosen)})", at_once=True)
        title, caption = CAPTIONS[name]
        page = Page(folder, name, title, caption, bodies.scale_colours(), tuple(dict.fromkeys(formats)), stamp)
        with matplotlib.rc_context(STYLE):
            FIGURES[name].draw(recordings, page)
        written += page.written
    progress.end()
    return written
