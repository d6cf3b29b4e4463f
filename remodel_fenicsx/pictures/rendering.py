"""Pictures of bodies in space, drawn in a child process: ``python3 -m remodel_fenicsx.pictures.rendering JOB``.

A VTK that knows only X (Debian 13's) kills its process where there is no display, so the child gets one of its own from
xvfb-run; a VTK that can draw without (EGL) gets by without that program.
"""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.results.drawing import AMBIENT
from remodel_fenicsx.studies.page import FigureError
from remodel_fenicsx.system.temporary import temporary_folder

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

SAMPLES = 2  # pictures are drawn this much larger and made smaller: smooth edges with every VTK


@dataclass(frozen=True)
class Patch:
    """Quadrilaterals or triangles in space.

    Attributes
    ----------
    corners
        (m, 4 or 3, 3), counter-clockwise where they are seen from outside.
    colours
        One of each, (m, 3) in 0..1.
    edges
        Whether their edges are drawn.
    lies_on
        0 for a surface. For what lies on one: how far it is moved towards the eye so that the surface does not cover
        it. In a parallel view that moves nothing in the picture. Where it is seen from behind, it is left out.
    """

    corners: Array
    colours: Array
    edges: bool = False
    lies_on: float = 0.0


@dataclass(frozen=True)
class View:
    """A parallel view: from which side, what is in the middle, the length from top to bottom, the pixels."""

    direction: tuple[float, float, float]
    centre: tuple[float, float, float]
    height: float
    pixels: tuple[int, int]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Picture:
    """What is seen and from where."""

    view: View
    patches: list[Patch] = field(default_factory=list)


def render(pictures: list[Picture]) -> list[Pixels]:
    """Draw pictures off-screen, each (rows, columns, 3).

    Raises
    ------
    FigureError
        If the child process could not draw (exit code 5: the environment).
    """
    with temporary_folder() as folder:
        job = folder / "job"
        job.write_bytes(pickle.dumps(pictures))
        command = [sys.executable, "-m", __name__, str(job)]
        if shutil.which("xvfb-run"):
            command = ["xvfb-run", "-a", "-s", "-screen 0 1280x1024x24", *command]
        paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYVISTA_OFF_SCREEN": "true"}
        environment["MPLBACKEND"] = "agg"  # a notebook's own is one that only its kernel may know
        # in the folder of the job: Python looks for modules where it is started, and that may be anybody's folder
        silent: Any = {"capture_output": True, "text": True, "stdin": subprocess.DEVNULL}
        child = subprocess.run(command, env=environment, cwd=folder, **silent)
        result = job.with_suffix(".npz")
        if child.returncode != 0 or not result.exists():
            said = (child.stderr.strip().splitlines() or ["it said nothing"])[-1]
            message = f"no picture in space: pyvista ended with {child.returncode}: {said}; are xvfb and xauth there?"
            raise FigureError(message, 5)
        with np.load(result) as found:
            return [found[f"picture{number}"] for number in range(len(pictures))]


# ---------------------------------------------------------------- the child


def main(job: str) -> None:
    """Draw the pictures of a job file and save them beside it."""
    with open(job, "rb") as file:
        pictures = pickle.load(file)
    drawn: dict[str, Any] = {f"picture{number}": _draw(picture) for number, picture in enumerate(pictures)}
    np.savez(f"{job}.npz", **drawn)


def add_patches(plotter: Any, patches: list[Patch], direction: Array | None, line_width: float = 1.0) -> None:
    """Put patches into a PyVista plotter whose light is a headlight.

    Parameters
    ----------
    plotter
        A `pyvista.Plotter`.
    patches
        What is seen.
    direction
        Unit vector from the body towards the eye, (3,): what lies on a surface is moved that way. None: it is moved
        along its own normal, for a body that will be turned.
    line_width
        Of the edges, in half pixels.
    """
    import pyvista

    for patch in patches:
        count, size = patch.corners.shape[:2]
        if not count:
            continue
        faces = np.column_stack([np.full(count, size), np.arange(size * count).reshape(-1, size)]).ravel()
        lift = patch.lies_on * (_normal(patch.corners) if direction is None else direction)
        surface = pyvista.PolyData((patch.corners + lift).reshape(-1, 3), faces)
        surface.cell_data["colour"] = np.rint(255 * patch.colours).astype(np.uint8)
        plotter.add_mesh(
            surface, scalars="colour", rgb=True, show_edges=patch.edges, edge_color="#777777",
            line_width=line_width * 0.5, ambient=AMBIENT, diffuse=1 - AMBIENT, specular=0.0, smooth_shading=False,
            show_scalar_bar=False, culling="back" if patch.lies_on else None,
        )  # fmt: skip


def _normal(corners: Array) -> Array:
    """Unit normals of faces (m, n, 3), as (m, 1, 3)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return (normal / np.where(length > 0, length, 1.0))[:, None]


def _draw(picture: Picture) -> Pixels:
    import pyvista

    columns, rows = (SAMPLES * pixels for pixels in picture.view.pixels)
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=[columns, rows], lighting="none")
    plotter.set_background("white")
    plotter.add_light(pyvista.Light(light_type="headlight", intensity=1.0))
    direction = np.array(picture.view.direction) / np.linalg.norm(picture.view.direction)
    add_patches(plotter, picture.patches, direction, SAMPLES)
    view = picture.view
    camera = plotter.camera
    camera.focal_point = view.centre
    camera.position = tuple(np.array(view.centre) + 10 * view.height * direction)
    camera.up = view.up
    camera.parallel_projection = True
    camera.parallel_scale = view.height / 2
    plotter.reset_camera_clipping_range()
    image = np.asarray(plotter.screenshot(return_img=True))[..., :3]
    plotter.close()
    smaller = image.reshape(rows // SAMPLES, SAMPLES, columns // SAMPLES, SAMPLES, 3).mean(axis=(1, 3))
    return np.rint(smaller).astype(np.uint8)


if __name__ == "__main__":
    main(sys.argv[1])
