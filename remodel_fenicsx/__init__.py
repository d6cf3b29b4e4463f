"""Predict how collagen in living tissue reorients under load (Kuhl & Holzapfel 2007) with FEniCSx."""

from __future__ import annotations

from typing import TYPE_CHECKING

from remodel_fenicsx._lazy import on_demand
from remodel_fenicsx._version import __version__

__all__ = [
    "Recording",
    "RecordingError",
    "RemodelError",
    "Scene",
    "SceneError",
    "Simulation",
    "__version__",
    "preset_scene",
    "read_scene",
    "run",
    "unloaded",
]

if TYPE_CHECKING:
    from remodel_fenicsx.errors import RemodelError
    from remodel_fenicsx.recording import Recording
    from remodel_fenicsx.results.recording import RecordingError
    from remodel_fenicsx.running import run
    from remodel_fenicsx.scene import Scene, SceneError, preset_scene, read_scene
    from remodel_fenicsx.simulation import Simulation
    from remodel_fenicsx.unloading import unloaded

# scenes and recordings need no dolfinx
__getattr__ = on_demand(
    __name__,
    {
        "Recording": "recording",
        "RecordingError": "results.recording",
        "RemodelError": "errors",
        "run": "running",
        **dict.fromkeys(("Scene", "SceneError", "preset_scene", "read_scene"), "scene"),
        "Simulation": "simulation",
        "unloaded": "unloading",
    },
)
