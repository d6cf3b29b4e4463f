"""Scenes: their keys, the rules across tables, and the presets of published models."""

from remodel_fenicsx.scene.rules import RULES
from remodel_fenicsx.scene.scene import Scene, preset_scene, read_scene, scene_from_dict
from remodel_fenicsx.schema.tables import SceneError

__all__ = ["Scene", "SceneError", "preset_scene", "read_scene", "scene_from_dict"]
Scene._rules = RULES  # The rules need the class.
