"""Prediction of collagen remodeling in living tissue under load (Kuhl & Holzapfel 2007)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from remodel_fenicsx._lazy import on_demand
from remodel_fenicsx._version import __version__ as __version__

if TYPE_CHECKING:
    from remodel_fenicsx.errors import RemodelError as RemodelError
    from remodel_fenicsx.recording import Recording as Recording
    from remodel_fenicsx.results.recording import RecordingError as RecordingError
    from remodel_fenicsx.running import run as run
    from remodel_fenicsx.scene import (
        Scene as Scene,
        SceneError as SceneError,
        preset_scene as preset_scene,
        read_scene as read_scene,
    )
    from remodel_fenicsx.simulation import Simulation as Simulation
    from remodel_fenicsx.unloading import unloaded as unloaded

_PLACES = {  # imported on first access, because scenes and recordings need no dolfinx
    "Recording": "recording",
    "RecordingError": "results.recording",
    "RemodelError": "errors",
    "run": "running",
    **dict.fromkeys(("Scene", "SceneError", "preset_scene", "read_scene"), "scene"),
    "Simulation": "simulation",
    "unloaded": "unloading",
}
__getattr__ = on_demand(__name__, _PLACES)
if not TYPE_CHECKING:  # type checkers use the imports
    __all__ = sorted(["__version__", *_PLACES])
