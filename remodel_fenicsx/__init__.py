"""Predict how collagen in living tissue reorients under load (Kuhl & Holzapfel 2007) with FEniCSx."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from remodel_fenicsx._version import __version__

__all__ = [
    "Recording",
    "RecordingError",
    "Scene",
    "SceneError",
    "Simulation",
    "__version__",
    "preset_scene",
    "read_scene",
    "run",
]

if TYPE_CHECKING:
    from remodel_fenicsx.results.recording import Recording, RecordingError
    from remodel_fenicsx.running import run
    from remodel_fenicsx.scene import Scene, SceneError, preset_scene, read_scene
    from remodel_fenicsx.simulation import Simulation

_PLACES = {
    **dict.fromkeys(("Recording", "RecordingError"), "results.recording"),
    "run": "running",
    **dict.fromkeys(("Scene", "SceneError", "preset_scene", "read_scene"), "scene"),
    "Simulation": "simulation",
}


def __getattr__(name: str) -> Any:
    """The names above, when they are first asked for: scenes and recordings need no dolfinx."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_PLACES[name]}"), name)
