"""A watcher of one's own: collagen that has to slide, warned of in every run, with a column of the largest shear.

    ./with-fenicsx remodel-fenicsx --with demos/extensions/largest_shear_watcher.py run demos/cube.toml
    ./with-fenicsx python3 demos/extensions/largest_shear_watcher.py

Fibres at an angle to the load shear the matrix between them. Of two lines of the tissue that were at right angles, the
angle changes most by arcsin((a^2 - b^2) / (a^2 + b^2)), with the largest and the smallest principal stretch a and b.
"""

from __future__ import annotations

import numpy as np

from remodel_fenicsx import Simulation, preset_scene
from remodel_fenicsx.extend import COLUMNS_ON_REQUEST, WATCHERS, Column, WarnsOnce, WatcherKind

LIMIT = 45.0  # degrees


def largest_shear(deformation_gradient: np.ndarray) -> np.ndarray:
    """Largest change of a right angle at points with F (n, 3, 3), degrees."""
    squares = np.linalg.eigvalsh(deformation_gradient.swapaxes(1, 2) @ deformation_gradient)
    smallest, largest = squares[:, 0], squares[:, -1]
    return np.degrees(np.arcsin((largest - smallest) / (largest + smallest)))


class ShearWarning(WarnsOnce):
    """Says once that the tissue is sheared by more than the limit somewhere."""

    name = "largest_shear"

    def check(self, step):
        """Look at a solved state: when loads change, and now and then without."""
        found = largest_shear(self.state.deformation_gradient()).reshape(self.quadrature.shape)
        if (most := self.quadrature.maximum(found)) <= LIMIT:
            return ""
        place = ", ".join(
            f"{coordinate:.3g}" for coordinate in self.quadrature.argmax_position(found)
        )
        return f"right angles change by up to {most:.3g} degrees, most at ({place}); the limit is {LIMIT:g}"


def shear_of_row(measurement) -> float:
    """The largest shear in the state of a row."""
    state = measurement.state
    return state.cells.quadrature.maximum(
        largest_shear(state.deformation_gradient()).reshape(state.cells.quadrature.shape)
    )


WATCHERS["largest-shear"] = WatcherKind(ShearWarning.for_scene, checks_each_case=True)
COLUMNS_ON_REQUEST["largest_shear"] = Column(
    "largest_shear", "degrees", "largest change of a right angle", shear_of_row
)

if __name__ == "__main__":
    scene = preset_scene("kuhl-holzapfel-2007", "tendon").with_values(
        {"time.end": 20.0, "output.columns": ["largest_shear"]}
    )
    for step in Simulation(scene).steps():
        print(f"time {step.time:4g}: {step.row['largest_shear']:5.1f} degrees")
