"""Recorded runs in scripts and notebooks: results, report, body in PyVista, pictures."""

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

# Largest page in a notebook, in MB, because notebooks are saved with their pages.
NOTEBOOK_SIZE = 5.0
FRAME_STYLE = "width: 100%; height: 48em; border: 1px solid #888"


class Recording(RecordedRun):
    """Results of a run, finished or not, from its folder. In a notebook it shows its report.

    Each result is read once, on first access. A new `Recording` reads steps that were added since.

    Parameters
    ----------
    folder
        Folder of the run, as of `remodel-fenicsx run -o`.

    Attributes
    ----------
    path : Path
        Folder of the run.

    Raises
    ------
    RecordingError
        If it is not the folder of a run.

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

    In a notebook `recording` alone shows the report, and `recording.plot(layers=2).show()` the
    body.
    """

    def _repr_html_(self) -> str:
        from remodel_fenicsx.report import page_of

        page = escape(page_of(self, NOTEBOOK_SIZE))
        # The page has no origin of its own, so that it cannot access the notebook.
        sandbox = "allow-scripts allow-downloads"
        look = f'sandbox="{sandbox}" style="{FRAME_STYLE}" title="report of a run"'
        return f'<iframe srcdoc="{page}" {look}></iframe>'

    def report(self, path: Path | None = None) -> Path:
        """Write the report of the run for a browser, like `remodel-fenicsx report`.

        Parameters
        ----------
        path
            New file. Default: report.html in the folder, which is replaced.

        Returns
        -------
        Path
            Path of the file.

        Raises
        ------
        ReportError
            If report.html exists and was not written by this package. It is a ValueError.
        FileExistsError
            If the file already exists. It is a ValueError too.
        RecordingError
            If the folder is corrupt.
        OSError
            If the file cannot be written.
        """
        from remodel_fenicsx.report import write_report

        return write_report(self.path, path)

    def grid(self, time: float | None = None) -> pyvista.UnstructuredGrid:
        """Return the whole body at a recorded time for PyVista, also that of a reduction.

        Parameters
        ----------
        time
            Recorded time. Default: the last one.

        Returns
        -------
        pyvista.UnstructuredGrid
            Body in the reference configuration. Its points have `displacement`, (n, 3), if
            recorded, and `grid.warp_by_vector("displacement")` is the deformed configuration. Its
            elements have all other fields, and `layer`.

        Raises
        ------
        RecordingError
            If no fields of a body are recorded at this time, or if they are corrupt.
        ImportError
            If PyVista is missing.
        """
        from remodel_fenicsx.pictures import WholeBody, grid

        return grid(WholeBody(self), self._time(time))

    def plot(
        self,
        time: float | None = None,
        name: str = "fibre_angle_deformed",
        *,
        layers: int | None = None,
        cut: str | None = None,
        elements: ArrayLike | None = None,
        chains: bool = True,
        plotter: pyvista.Plotter | None = None,
        **options: object,
    ) -> pyvista.Plotter:
        """Add the deformed configuration at a recorded time to a plotter of PyVista.

        ``recording.plot().show()`` shows it.

        Parameters
        ----------
        time
            Recorded time. Default: the last one.
        name
            Field that colours the elements; PyVista shows the magnitude of vectors and tensors.
            Fibre angles have the colours of the report and of the paper's figures.
        layers
            Number of layers to show, from the inside of a tube or the bottom of other bodies.
            Default: all.
        cut
            "half" or "quarter" to remove the part in front.
        elements
            Elements of `grid()` to show, a mask (elements,).
        chains
            Whether to draw the four chains of each element on visible faces, if cells were
            recorded.
        plotter
            Plotter to use. Default: a new one.
        options
            Options of `pyvista.Plotter.add_mesh`, which draws the body.

        Returns
        -------
        pyvista.Plotter
            Plotter, not shown yet.

        Raises
        ------
        RecordingError
            If the field, or any field, was not recorded at this time.
        FigureError
            If these layers or elements do not exist, or if the cut removes all of them. It is a
            ValueError.
        ImportError
            If PyVista is missing.
        """
        from remodel_fenicsx import pictures

        whole = pictures.WholeBody(self)
        shown = pictures.visible_elements(whole, pictures.ViewOptions(layers, cut))
        if elements is not None:
            if np.shape(elements) != shown.shape:
                raise pictures.FigureError(
                    f"elements of shape {np.shape(elements)}: must be a mask of all {len(shown)}"
                )
            shown &= np.asarray(elements, dtype=bool)
        body = pictures.grid(whole, self._time(time), shown)
        if name not in body.cell_data:
            fields = ", ".join(body.cell_data)
            raise RecordingError(f"{self.path}: no field {name!r} of elements; recorded: {fields}")
        plotter = plotter or pictures.new_plotter()
        pictures.add_body(plotter, pictures.deformed(body), name, chains, **options)
        return plotter

    def screenshot(
        self, path: str | os.PathLike[str] | None = None, times: Sequence[float] | None = None, *,
        layers: int | None = None, cut: str | None = None, view: str = "front",
        name: str = "fibre_angle_deformed",
    ) -> Path:  # fmt: skip
        """Draw the body into a file, like `remodel-fenicsx picture`, without a display.

        Parameters
        ----------
        path
            New file with the suffix .png or .pdf. Default: NAME-tTIME.png in the folder, with a
            number if it exists.
        times
            Times to show next to each other; the nearest recorded ones are used. Default: the last
            one.
        layers, cut
            See `plot`.
        view
            "front", "above" or "X,Y,Z": position of the viewer from the centre of the body.
        name
            Field that colours the elements: "fibre_angle_deformed", "hoop_stress", "axial_stress",
            "max_principal_stress" or "von_mises_stress".

        Returns
        -------
        Path
            Path of the file.

        Raises
        ------
        FigureError
            If an argument is not allowed, or if drawing is impossible here. It is a ValueError.
        FileExistsError
            If the file already exists. It is a ValueError too.
        RecordingError
            If the folder is corrupt.
        OSError
            If the file cannot be written.
        """
        from remodel_fenicsx.pictures import ViewOptions, draw_picture

        viewing = ViewOptions(layers, cut, view, name)
        return draw_picture(self.path, times, viewing, None if path is None else Path(path))

    def _time(self, time: float | None) -> float:
        """Return this time, or the last one by default."""
        return float(self.times[-1]) if time is None else time
