"""Settings of a scene from coarse to fine: what `remodel-fenicsx trade` runs, each a scene that a user could take."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from remodel_fenicsx.body.reductions import AUTO, choice, objections, step_cost
from remodel_fenicsx.fem.kinematics import KINEMATICS
from remodel_fenicsx.body.profile import PROFILE
from remodel_fenicsx.scene.scene import Scene, SceneError
from remodel_fenicsx.tissue.laws import LAWS

log = logging.getLogger(__name__)

SECONDS_PER_POINT = 3e-5  # of a step: a first guess, corrected by the runs
DEGREES_PER_RUN = 60.0  # what angles turn by: steps of a tolerance are about so many tolerances
STEPS = (8.0, 5.0, 4.0, 2.5, 2.0)  # longer ones than the scene's, in its own
HALVINGS = 3  # of the scene's own step
TOLERANCES = (2.0, 1.0, 0.5, 0.25)  # degrees
MESHES = ((1, 1), (2, 1), (4, 1), (8, 1), (1, 2), (2, 2), (4, 2))  # refinement, degree
TOGETHER = ((2, 1, 0.5), (2, 2, 0.5), (2, 2, 0.25), (4, 2, 0.25))  # both finer: refinement, degree, step in the scene's
SEEDS = 3  # where another mesh draws other cells
COMPARED = 8  # times at which rows are compared, beside corners of ramps and the end
TIME, MESH, BOTH, KINEMATIC = "time", "mesh", "both", "kinematics"


@dataclass(frozen=True)
class Setting:
    """One row of the table.

    Attributes
    ----------
    name
        Of its files.
    factor
        What it varies: TIME, MESH, BOTH or KINEMATIC.
    changes
        Values over the scene by dotted key.
    scene
        The user's scene with them.
    seeds
        Of its runs; one where cells are not random or are the same.
    """

    name: str
    factor: str
    changes: Mapping[str, Any] = field(hash=False)
    scene: Scene = field(hash=False)
    seeds: tuple[int, ...]

    @property
    def step(self) -> float | None:
        """The fixed step; None with a tolerance."""
        return self.scene.time.step if self.scene.time.tolerance is None else None

    @property
    def mesh(self) -> tuple[str, int, int]:
        """Kinematics, refinement and degree."""
        return self.scene.model.kinematics, self.scene.mesh.refinement, self.scene.mesh.degree

    @property
    def expected_seconds(self) -> float:
        """Of one of its runs, roughly."""
        time = self.scene.time
        steps = time.number_of_steps if time.tolerance is None else DEGREES_PER_RUN / time.tolerance
        return SECONDS_PER_POINT * step_cost(self.scene, self.scene.model.kinematics) * steps

    @property
    def steps_in_words(self) -> str:
        """How long they are, or their tolerance."""
        return f"step {self.step:g}" if self.step is not None else f"tolerance {self.scene.time.tolerance:g}"

    def in_words(self) -> str:
        """Kinematics, mesh and steps on a line."""
        kinematics, refinement, degree = self.mesh
        return f"{kinematics:12} refinement {refinement} degree {degree} {self.steps_in_words}"


def ladder(scene: Scene) -> list[Setting]:
    """All settings that the scene allows, each once: sweeps of one factor from the cheapest kinematics, then both.

    Raises
    ------
    SceneError
        If steps of the scene's own length do not hit its corners and its end: with a tolerance they need not.
    """
    own = choice(scene).name
    base = scene.with_values({"model.kinematics": _cheapest(scene), "time.tolerance": None})
    step, mesh = base.time.step, (base.mesh.refinement, base.mesh.degree)
    random, seed = scene.cells.initial == "random", scene.cells.seed
    several = tuple(range(seed, seed + SEEDS)) if random else (seed,)
    found: dict[str, Setting] = {}

    def add(factor: str, seeds: tuple[int, ...] = (seed,), **changes: Any) -> None:
        values = {key.replace("__", "."): value for key, value in changes.items()}
        try:
            changed = base.with_values(values)
        except SceneError as error:  # a step of which a corner is no multiple, an element that a formulation has not
            log.debug("left out: %s", error)
            return
        setting = Setting(_name(changed), factor, values, changed, seeds)
        found.setdefault(setting.name, setting)

    add(MESH, several)
    for factor in [*STEPS, *(0.5**k for k in range(1, HALVINGS + 1))]:
        add(TIME, time__step=factor * step)
    for refinement, degree in MESHES:
        add(MESH, several, mesh__refinement=refinement * mesh[0], mesh__degree=degree)
    for refinement, degree, factor in TOGETHER:
        finer = {"mesh__refinement": refinement * mesh[0], "mesh__degree": degree}
        add(BOTH, several, **finer, time__step=factor * step)
    if LAWS[scene.remodeling.law].remodels:
        for tolerance in TOLERANCES:
            add(BOTH, several, mesh__refinement=2 * mesh[0], mesh__degree=2, time__tolerance=tolerance)
            add(TIME, time__tolerance=tolerance)
    for name in dict.fromkeys((own, "sector", "full")):
        if name == own or not objections(scene, name):
            add(KINEMATIC, model__kinematics=name)
    return sorted(found.values(), key=lambda setting: setting.expected_seconds)


def _cheapest(scene: Scene) -> str:
    """That of `auto`, whatever the scene says."""
    return choice(scene.with_values({"model.kinematics": AUTO})).name


def _name(scene: Scene) -> str:
    time, (kinematics, mesh) = scene.time, (scene.model.kinematics, scene.mesh)
    steps = f"step-{time.step:g}" if time.tolerance is None else f"tolerance-{time.tolerance:g}"
    return f"{kinematics}-{mesh.refinement}-degree-{mesh.degree}-{steps}"


def compared_times(scene: Scene, settings: Sequence[Setting]) -> list[float]:
    """Times that every row has: corners of ramps, the end, and some between that are whole steps of all settings."""
    fixed = [setting.scene.time for setting in settings if setting.step is not None]
    longest = max(time.step for time in fixed)
    multiples = [longest * number for number in range(1, round(scene.time.end / longest))]
    hit = [time for time in multiples if all(one.is_hit(time) for one in fixed)]
    return sorted({*scene.stops(), *hit[:: -(-len(hit) // COMPARED) or 1]})


def as_run(setting: Setting, seed: int, times: list[float]) -> Scene:
    """The scene of a run of the study: only what is compared is measured."""
    shape = setting.scene.geometry
    lengths = [column.name for column in shape.columns if column.unit == "length" or column.name == "mean_stretch"]
    columns = [*lengths, "substeps", "seconds", "processor_seconds", *PROFILE]
    values = {"output.fields": False, "output.columns": columns, "output.times": times, "output.every": 1}
    return setting.scene.with_values({**values, "cells.seed": seed, "name": f"{setting.name}-{seed}"})


def is_reduced(setting: Setting) -> bool:
    """Whether a part stands for the body."""
    return KINEMATICS[setting.scene.model.kinematics].reduced
