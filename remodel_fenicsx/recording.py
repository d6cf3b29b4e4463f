"""A recorded run in scripts and notebooks: what it recorded, its page, its body in PyVista, its pictures."""

from __future__ import annotations

import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from remodel_fenicsx.results.recording import RecordedRun, RecordingError

if TYPE_CHECKING:
    import pyvista
    from numpy.typing import ArrayLike

NOTEBOOK_SIZE = 5.0  # MB that a page has at most in a notebook, which is saved with all of them
FRAME_STYLE = "width: 100%; height: 48em; border: 1px solid #888"


class Recording(RecordedRun):
    """The folder of a run, finished or under way. In a notebook it shows its report.

    Everything is read when it is first asked for, and once: a new `Recording` sees what has been added since.

    Parameters
    ----------
    folder
        What `remodel-fenicsx run -o` was given.

    Attributes
    ----------
    path : Path
        The folder.

    Raises
    ------
    RecordingError
        If it is no folder of a run.

    Examples
    --------
    The cube of the paper's Fig. 5, pulled for two steps:

    >>> from remodel_fenicsx import Recording, preset_scene, run
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 2.0})
    >>> recording = Recording(run(scene, "pulled-cube", report=False))
    >>> recording.history["mean_fibre_angle"].round(2)
    array([54.74, 54.74, 53.57])
    >>> recording.times
    array([0., 1., 2.])
    >>> recording.fields(2.0)["displacement"].shape  # (nodes, 3)
    (8, 3)

    In a notebook `recording` alone shows the report, and `recording.plot(layers=2).show()` the body.
    """

    def _repr_html_(self) -> str:
        from remodel_fenicsx.report import page_of

        page = escape(page_of(self, NOTEBOOK_SIZE))
        sandbox = "allow-scripts allow-downloads"  # no origin of its own: it reaches nothing of the notebook
        return f'<iframe srcdoc="{page}" sandbox="{sandbox}" style="{FRAME_STYLE}" title="report of a run"></iframe>'

    def report(self, path: Path | None = None) -> Path:
        """Make the page of the run for a browser, as `remodel-fenicsx report` does.

        Parameters
        ----------
        path
            A new file; default: report.html in the folder, which is made anew.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        ReportError
            If this package has not made the report.html that is there; a ValueError.
        FileExistsError
            If the file is there already; a ValueError too.
        RecordingError
            If the folder is damaged.
        OSError
            If it cannot be written.
        """
        from remodel_fenicsx.report import write_report

        return write_report(self.path, path)

    def grid(self, time: float | None = None) -> pyvista.UnstructuredGrid:
        """The whole body at a recorded time for PyVista; of a reduction it is turned into the body.

        Parameters
        ----------
        time
            As recorded; default: the last.

        Returns
        -------
        pyvista.UnstructuredGrid
            The reference body. Its points have `displacement`, (n, 3), where that was recorded, and
            `grid.warp_by_vector("displacement")` is the deformed body. Its elements have all other fields, and `layer`.

        Raises
        ------
        RecordingError
            If no fields of a body are recorded at this time, or they are damaged.
        ImportError
            If there is no PyVista.
        """
        from remodel_fenicsx.pictures import WholeBody, grid

        return grid(WholeBody(self), self._time(time))

    def plot(
        self, time: float | None = None, name: str = "fibre_angle_deformed", *, layers: int | None = None,
        cut: str | None = None, elements: ArrayLike | None = None, chains: bool = True,
        plotter: pyvista.Plotter | None = None, **options: object,
    ) -> pyvista.Plotter:  # fmt: skip
        """Put the deformed body at a recorded time into a plotter of PyVista: `recording.plot().show()`.

        Parameters
        ----------
        time
            As recorded; default: the last.
        name
            The field that colours the elements; of vectors and tensors PyVista shows the magnitude. Fibre angles have
            the colours of the report and of the paper's figures.
        layers
            Show so many, from the inside of a tube, from the bottom of others; default: all.
        cut
            "half" or "quarter": leave out what is in front.
        elements
            Show of these alone: which ones of `grid()`, a mask (elements,).
        chains
            Whether the four chains of each element are drawn on the faces that are seen, where cells were recorded.
        plotter
            To put it into; default: a new one.
        options
            For `pyvista.Plotter.add_mesh`, which draws the body.

        Returns
        -------
        pyvista.Plotter
            Not shown yet.

        Raises
        ------
        RecordingError
            If the field, or any, was not recorded at this time.
        FigureError
            If there are no such layers or elements, or nothing is left by the cut; a ValueError.
        ImportError
            If there is no PyVista.
        """
        from remodel_fenicsx import pictures

        whole = pictures.WholeBody(self)
        shown = pictures.shown_elements(whole, pictures.Viewing(layers, cut))
        if elements is not None:
            if np.shape(elements) != shown.shape:
                rule = f"allowed is a mask of all {len(shown)}"
                raise pictures.FigureError(f"elements of shape {np.shape(elements)}: {rule}")
            shown &= np.asarray(elements, dtype=bool)
        found = pictures.grid(whole, self._time(time), shown)
        if name not in found.cell_data:
            there = ", ".join(found.cell_data)
            raise RecordingError(f"{self.path}: no field {name!r} of elements; there are {there}")
        plotter = plotter or pictures.new_plotter()
        pictures.add_body(plotter, pictures.deformed(found), name, chains, **options)
        return plotter

    def screenshot(
        self, path: str | os.PathLike[str] | None = None, times: Sequence[float] | None = None, *,
        layers: int | None = None, cut: str | None = None, view: str = "front",
    ) -> Path:  # fmt: skip
        """Draw the body into a file, as `remodel-fenicsx picture` does: it needs no display.

        Parameters
        ----------
        path
            A new file: .png or .pdf; default: NAME-tTIME.png in the folder, numbered when taken.
        times
            To show beside each other; the nearest recorded ones are taken. Default: the last.
        layers, cut
            As of `plot`.
        view
            "front", "above" or "X,Y,Z": where the eye is, from the middle of the body.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        FigureError
            One line: what is not allowed, or that nothing can be drawn here; a ValueError.
        FileExistsError
            If the file is there already; a ValueError too.
        RecordingError
            If the folder is damaged.
        OSError
            If the file cannot be written.
        """
        from remodel_fenicsx.pictures import Viewing, draw_picture

        return draw_picture(self.path, times, Viewing(layers, cut, view), None if path is None else Path(path))

    def _time(self, time: float | None) -> float:
        """A time with fields: this one or the last."""
        return float(self.times[-1]) if time is None else time
