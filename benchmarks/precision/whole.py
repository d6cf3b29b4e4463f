"""The whole tube in three dimensions, from coarse to fine: the price where no part stands for the body."""

from __future__ import annotations

from dataclasses import dataclass

from remodel_fenicsx.scene.scene import Scene
from remodel_fenicsx.studies import trade as rungs

# as a user would solve them
SOLVED = {"model.kinematics": "full", "solver.method": "auto", "solver.predictor": "autoregressive"}
# refinement, degree, and steps or tolerances of the steps in degrees
STEPS = {
    "printed": {(1, 1): (5.0, 2.5, 1.0), (1, 2): (5.0, 2.5, 1.0, 0.5, 0.25), (2, 1): (1.0,)},
    "consistent": {(1, 1): (5.0, 1.0), (1, 2): (5.0, 1.0, 0.25, 0.125)},
}
TOLERANCES = {name: {(1, 1): (1.0,), (1, 2): (0.5,)} for name in STEPS}  # as in the profiles `fast` and `balanced`

# one other thing at a time, of the printed method on the paper's mesh with steps of 1
OTHERS = {
    "tetrahedra": {"mesh.element": "tetrahedron"},
    "selective integration": {"mesh.formulation": "selective-integration"},
    "residual to 1e-6": {"solver.relative_tolerance": 1e-6},
    "residual to 1e-4": {"solver.relative_tolerance": 1e-4},
    "method iterative": {"solver.method": "iterative"},
    "no predictor": {"solver.predictor": "none"},
}


@dataclass(frozen=True)
class Named(rungs.Setting):
    """A setting whose row has a name of its own."""

    title: str = ""

    @property
    def name(self) -> str:
        """Of its row."""
        return self.title


def settings(method: str, base: Scene) -> list[rungs.Setting]:
    """Those of a method (a key of `STEPS`; others have none), the cheapest first."""
    found = [
        _setting(base, refinement, degree, f"{key} {value:g}", {f"time.{key}": value})
        for key, table in (("step", STEPS), ("tolerance", TOLERANCES))
        for (refinement, degree), values in table.get(method, {}).items()
        for value in values
    ]
    others = OTHERS if method == "printed" else {}
    found += [_setting(base, 1, 1, f"step 1 {words}", {"time.step": 1.0, **values}) for words, values in others.items()]
    return sorted(found, key=lambda setting: setting.expected_seconds)


def other_words(name: str) -> str:
    """What a setting's name says of `OTHERS`."""
    return next((f", {words}" for words in OTHERS if name.endswith(_slug(words))), "")


def _slug(words: str) -> str:
    return words.replace(" ", "-")


def _setting(base: Scene, refinement: int, degree: int, steps: str, time: dict[str, float]) -> rungs.Setting:
    values = SOLVED | {"mesh.refinement": refinement, "mesh.degree": degree} | time
    name = f"whole-{refinement}-degree-{degree}-{_slug(steps)}"
    return Named(values, base.with_values(values), (1,), title=name)
