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

from remodel_fenicsx.paper import curves, structures
from remodel_fenicsx.paper.runs import KAPPAS, LOAD_CASES, load_case_name, obtain, scenes
from remodel_fenicsx.pictures import bodies
from remodel_fenicsx.results.recording import RecordedRun
from remodel_fenicsx.studies.page import FORMATS, STYLE, FigureError, Page, check_folder
from remodel_fenicsx.system.children import cores
from remodel_fenicsx.system.terminal import Line

__all__ = ["DEFAULT_FOLDER", "DEFAULT_RUNS", "FIGURES", "FigureError", "draw"]

DEFAULT_FOLDER, DEFAULT_RUNS = Path("figures"), Path("results/figures-cache")

# of captions
CHAINS_CAPTION = (
    "Black: the four chains of each element's mean cell, deformed and projected on its face, cut off before its edge."
)
PEELED = "the outer layers of elements cut shorter than the inner ones"
WALL = "coloured by the deformed angle of the chains in the wall"
PROFILE_CAPTION = (
    "reference fibre angle over the radius at t = 150; lines: means of the element layers, bands: all elements"
)
RELAXED = (
    "The printed pass over-corrects with {}: here it is relaxed by one half, in the material frame "
    "(docs/theory.md, Stability of the pass)."
)


@dataclass(frozen=True)
class FigureSpec:
    """Title and caption of a figure, the names of the runs that it needs, and how it is drawn from them.

    Title and caption stand in the files of the pictures, and captions in docs/verification.md too.
    """

    title: str
    caption: str
    runs: tuple[str, ...]
    draw: Callable[[dict[str, RecordedRun], Page], None]


FIGURES: dict[str, FigureSpec] = {
    "fig1": FigureSpec(
        "Force of a single chain (Fig. 1)",
        "Force of a wormlike chain, eq. (2), for kθ = 1 and three persistence lengths A. It locks at r = L (dotted).",
        (),
        curves.draw_chain_force,
    ),
    "fig5": FigureSpec(
        "Alignment of the chains of a cube under tension (Fig. 5)",
        "Mean reference angle between chains and load for four values of κ. Circles: closed form of the same cells.",
        tuple(f"cube-{kappa:g}" for kappa in KAPPAS),
        curves.draw_alignment,
    ),
    "fig6": FigureSpec(
        "Cylindrical tendon under uniaxial tension (Fig. 6)",
        "(a) Stretch over time; points: the times of the pictures. (b) to (f) Its elements by their deformed angle "
        f"between chains and load axis. {CHAINS_CAPTION}",
        ("tendon",),
        structures.draw_tendon,
    ),
    "fig7": FigureSpec(
        "Artery under axial elongation and inner pressure (Fig. 7)",
        f"(a) to (e) The wall at five times, {WALL}; below, the loads. {CHAINS_CAPTION}",
        ("artery",),
        structures.draw_artery,
    ),
    "fig8": FigureSpec(
        "Chains in the layers of the artery's wall (Fig. 8)",
        f"(a) The innermost, (b) the fourth and (c) the outermost of eight layers of elements at t = 150, {WALL}. "
        f"{CHAINS_CAPTION}",
        ("artery",),
        structures.draw_layers,
    ),
    "fig9": FigureSpec(
        "Load cases from pure elongation to pure pressure (Fig. 9)",
        f"(a) to (e) The wall at t = 150 under five pairs of axial elongation and inner pressure p, {PEELED}, {WALL}. "
        f"{CHAINS_CAPTION}",
        tuple(load_case_name(*case) for case in LOAD_CASES),
        structures.draw_load_cases,
    ),
    "fig10": FigureSpec(
        "Remodeling driven by the Cauchy or the second Piola-Kirchhoff stress (Fig. 10)",
        f"(a) {PROFILE_CAPTION.capitalize()}. (b), (c) The wall, {PEELED}. {CHAINS_CAPTION} {RELAXED.format('S')}",
        ("artery", "artery-pk2"),
        partial(curves.draw_drivers, other="pk2"),
    ),
    "fig11": FigureSpec(
        "Remodeling driven by the Cauchy stress or the Finger tensor (Fig. 11)",
        f"(a) {PROFILE_CAPTION.capitalize()}. (b), (c) The wall, {PEELED}. {CHAINS_CAPTION} {RELAXED.format('b')}",
        ("artery", "artery-finger"),
        partial(curves.draw_drivers, other="finger"),
    ),
    "rate": FigureSpec(
        "Eqs. (10) and (11) on the same artery (erratum 7)",
        "(a) Mean reference fibre angle of the innermost, middle and outermost elements over time. "
        f"(b) {PROFILE_CAPTION.capitalize()}.",
        ("artery", "artery-rate"),
        curves.draw_rate,
    ),
    "energy": FigureSpec(
        "Stored energy and power of remodeling (Remark 6)",
        "(a) to (c) Stored energy. (d) to (f) Power of each step's remodeling pass; green: it releases stored energy, "
        "red: it takes energy in. Dotted: end of the ramp.",
        ("cube-0.025", "tendon", "artery"),
        curves.draw_energy,
    ),
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
        For NAME.png (or .pdf, .svg), NAME*.csv and NAME.json. Only files that this function wrote are ever overwritten.
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
    recordings = {name: RecordedRun(path) for name, path in recorded.items()}
    progress, written = Line("figures"), []
    for number, name in enumerate(chosen, start=1):
        progress.show(f"drawing {name} ({number}/{len(chosen)})", at_once=True)
        figure = FIGURES[name]
        page = Page(
            folder, name, figure.title, figure.caption, bodies.scale_colours(), tuple(dict.fromkeys(formats)), stamp
        )
        with matplotlib.rc_context(STYLE):
            figure.draw(recordings, page)
        written += page.written
    progress.end()
    return written
