"""The runs behind the figures: the paper's preset with what each figure varies.

The printed pass over-corrects with the drivers of Figs. 10 and 11 (docs/theory.md, "Stability of the pass"), so these
two runs relax it, in the frame that is objective.
"""

from __future__ import annotations

from remodel_fenicsx.body.reductions import AUTO, choice
from remodel_fenicsx.scene.scene import Scene, preset_scene

PRESET = "kuhl-holzapfel-2007"
KAPPAS = (0.01, 0.025, 0.05, 0.1)  # those of the printed Fig. 5 cannot be read
LOAD_CASES = ((0.10, 0.0), (0.10, 2.4), (0.10, 4.8), (0.05, 4.8), (0.0, 4.8))  # Fig. 9: (elongation, pressure)

# how the package names the prescribed engineering strain of a tube: the load of a scene, the column of a history
ELONGATION_LOAD, ELONGATION_COLUMN = "elongation", "axial_elongation"


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
