"""The runs behind the figures: the paper's preset with what each figure varies, and the folder where they are kept.

The printed pass over-corrects with the drivers of Figs. 10 and 11 (docs/theory.md, "Stability of the pass"), so these
two runs relax it, in the frame that is objective.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import shutil
from collections.abc import Iterable
from pathlib import Path

from remodel_fenicsx._version import __version__
from remodel_fenicsx.body.reductions import AUTO, choice
from remodel_fenicsx.results.recording import RecordedRun, RecordingError
from remodel_fenicsx.results.run_lock import is_vacant
from remodel_fenicsx.scene.scene import Scene, SceneError, preset_scene
from remodel_fenicsx.studies.page import FigureError
from remodel_fenicsx.studies.runs import Run, run_all
from remodel_fenicsx.system.regular_files import refusal_in_words
from remodel_fenicsx.system.terminal import announce

PRESET = "kuhl-holzapfel-2007"
KAPPAS = (0.01, 0.025, 0.05, 0.1)  # those of the printed Fig. 5 cannot be read
LOAD_CASES = ((0.10, 0.0), (0.10, 2.4), (0.10, 4.8), (0.05, 4.8), (0.0, 4.8))  # Fig. 9: (elongation, pressure)

# how the package names the prescribed engineering strain of a tube: the load of a scene, the column of a history
ELONGATION_LOAD, ELONGATION_COLUMN = "elongation", "axial_elongation"

_LIBRARIES = ("fenics-dolfinx", "fenics-ufl", "fenics-ffcx", "petsc4py", "gmsh", "numpy")
_COST = {"tendon": 0.2, "cube": 0.01}  # of a step, beside those of other shapes


def load_case_name(elongation: float, pressure: float) -> str:
    """Name of the run of one of Fig. 9's load cases."""
    return "artery" if (elongation, pressure) == (0.10, 4.8) else f"artery-{100 * elongation:g}-{pressure:g}"


def cheapest(scene: Scene) -> Scene:
    """With the cheapest kinematics that is exact for it: for scenes of which a figure shows the history alone."""
    return scene.with_values({"model.kinematics": choice(scene.with_values({"model.kinematics": AUTO})).name})


def scenes() -> dict[str, Scene]:
    """Every scene that a figure needs, by name."""
    found = {"tendon": preset_scene(PRESET, "tendon"), "artery": preset_scene(PRESET, "tube")}
    last_only = {"output.every": found["artery"].time.number_of_steps}
    for elongation, pressure in LOAD_CASES:
        changes = {f"loads.{ELONGATION_LOAD}.value": elongation, "loads.pressure.value": pressure}
        found.setdefault(load_case_name(elongation, pressure), found["artery"].with_values(changes | last_only))
    for driver in ("pk2", "finger"):
        method = {"remodeling.driver": driver, "remodeling.frame": "material", "remodeling.coupling": "relaxed"}
        found[f"artery-{driver}"] = found["artery"].with_values(method | last_only)
    found["artery-rate"] = found["artery"].with_values({"remodeling.law": "rate"} | last_only)
    for kappa in KAPPAS:
        changes = {"remodeling.kappa": kappa, "output.fields": False}
        found[f"cube-{kappa:g}"] = cheapest(preset_scene(PRESET, "cube").with_values(changes))
    return {name: scene.with_values({"name": name}) for name, scene in found.items()}


# ---------------------------------------------------------------- the folder where they are kept


def library_versions() -> dict[str, str]:
    """Versions of package and libraries that decide a run's numbers, without importing them."""
    return {name: importlib.metadata.version(name) for name in _LIBRARIES} | {"remodel_fenicsx": __version__}


def kept_run(scene: Scene, folder: Path) -> Run:
    """The run of a scene in FOLDER/NAME-KEY; KEY is a hash of the scene with all its defaults and the versions."""
    everything = json.dumps([scene.model_dump(mode="json"), library_versions()], sort_keys=True)
    key = hashlib.sha256(everything.encode()).hexdigest()[:12]
    return Run(scene.name, scene, folder / f"{scene.name}-{key}")


def obtain(wanted: Iterable[Scene], folder: Path, jobs: int) -> dict[str, Path]:
    """Folders of whole runs by name of scene; what is not recorded with the present versions is run first.

    Parameters
    ----------
    wanted
        Scenes.
    folder
        Of the recorded runs; made when it is needed.
    jobs
        Runs at a time; the longest begin first.

    Raises
    ------
    FigureError
        If a run fails, with its exit code; the others are stopped.
    Interrupted
        If a signal asked for the end. What is recorded stays, and the same call goes on from there.
    OSError
        If the folder cannot be written.
    """

    def cost(run: Run) -> float:
        return _COST.get(run.scene.geometry.name, 1.0) * run.scene.time.number_of_steps

    def ended(run: Run, code: int, last_words: str) -> None:
        if code != 0:
            message = f"the run {run.name} in {run.folder}: {last_words}"
            raise FigureError(message, code if code > 0 else 128 - code)

    runs = [kept_run(scene, folder) for scene in wanted]
    missing = [run for run in runs if run.is_under_way() or not _is_whole(run)]
    run_all(sorted(missing, key=cost, reverse=True), jobs, "figures", ended=ended)
    return {run.name: run.folder for run in runs}


def _is_whole(run: Run) -> bool:
    """Whether all of a run is there; what is damaged, so that it could not go on, is removed."""
    if not run.folder.exists() or is_vacant(run.folder):
        return False
    try:
        _ = RecordedRun(run.folder).history
        return run.is_complete()
    except (SceneError, RecordingError, OSError) as error:
        words = refusal_in_words(error) if isinstance(error, OSError) else error
        announce(f"figures: run again: {run.folder}: {words}")
        shutil.rmtree(run.folder)
        return False


# ---------------------------------------------------------------- what they were made with


def first_cells(run: RecordedRun) -> str:
    """How the cells of a run were at first, in words."""
    cells = run.scene.cells
    return f"random cells of seed {cells.seed}" if cells.initial == "random" else f"{cells.initial} cells"


def made_with(run: RecordedRun, cells: str | None = None) -> str:
    """Package, library and scene of a run, in a line; `cells` says more than `first_cells` of this run alone."""
    scene, versions = run.scene, run.versions
    libraries = ", ".join(f"{name} {versions.get(name, '?')}" for name in ("remodel_fenicsx", "dolfinx"))
    kinematics = "" if scene.model.kinematics == "full" else f" with kinematics {scene.model.kinematics}"
    method = f"preset {scene.preset}{kinematics}, frame {scene.remodeling.frame}"
    return f"{libraries}; {method}, {cells or first_cells(run)}"
