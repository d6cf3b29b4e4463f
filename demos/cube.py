# %% [markdown]
# # The speed of remodeling: a unit cube in uniaxial tension
#
# Kuhl & Holzapfel 2007, Fig. 5 (Remark 7): an isotropic cube is pulled with a force of 10 in 10 steps and held to
# t = 100. The angle between chains and load falls from 54.7 degrees; how fast is a matter of $\kappa$ alone:
# $$\tan\alpha(t) = \frac{\sqrt2\,(1-s)}{1 - s + \sqrt3\, s}, \qquad s = 1 - e^{-\kappa t}$$
# `demos/cube.toml` is the same simulation as a scene.
#
#     ./with-fenicsx python3 demos/cube.py [END [FOLDER]]

# %%
import sys

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx import parts

end = float(sys.argv[1]) if len(sys.argv) > 1 else 100.0
comm = MPI.COMM_WORLD
folder = parts.chosen_folder(sys.argv[2] if len(sys.argv) > 2 else None, "cube-script", comm)
parts.end_all_ranks_on_exception()

# %% [markdown]
# ## Geometry and tissue
# One element. Isotropic cells: $l_1 = l_2 = l_3 = r_0 / \sqrt3$.

# %%
body = parts.Cube(side=1.0)
domain = body.build(parts.Mesh(refinement=1, element="hexahedron", degree=1), comm)
kinematics = parts.FullKinematics()
displacement = kinematics.unknown(domain.mesh, degree=1)
tissue = parts.Material(lame_lambda=27.293, lame_mu=3.103, chain_density=7.0e21, contour_length=2.125,
                        persistence_length=1.82, temperature=310.0).tissue(end_to_end_length=1.0)  # fmt: skip
quadrature = parts.Quadrature(domain.mesh, element_degree=1)
start = parts.Cells(initial="isotropic", axes="global", end_to_end_length=1.0)
cells = parts.UnitCells(quadrature, domain, start, body.local_axes(domain, quadrature))

# %% [markdown]
# ## Supports and loads
# Three symmetry planes, a dead force along z on the face z = 1.

# %%
loading = parts.Loading(domain, displacement, kinematics)
loading.hold_face("x0", component=0)
loading.hold_face("y0", component=1)
loading.hold_face("z0", component=2)
loading.add_dead_force("force", "z1", component=2)


def load_values(time: float) -> dict[str, float]:
    """Up to t = 10, then held."""
    return {"force": 10.0 * min(time / 10.0, 1.0)}


# %% [markdown]
# ## Remodeling and the way through time
# The row of a time belongs to the solved state, before the cells remodel: its cells are those of the step before.

# %%
kappa = 0.025
remodeling = parts.Remodeling(driver="cauchy", law="explicit", frame="spatial", kappa=kappa)
state = parts.State(displacement, kinematics, cells, loading)
stepper = parts.Stepper(state, tissue, remodeling, parts.Solver(), load_values)


def closed_form(time: float) -> float:
    """Angle of the cells of the step before, in degrees."""
    s = 1 - np.exp(-kappa * (time - 1.0))
    return np.degrees(np.arctan2(np.sqrt(2) * (1 - s), 1 - s + np.sqrt(3) * s))


line = "t = {time:5.1f}  stretch {mean_stretch:.4f}  angle {mean_fibre_angle:8.5f}, in closed form {exact:8.5f}"
with parts.RunFolder(folder, "# made by demos/cube.py\n", comm.rank) as record:
    for step in stepper.march(parts.times(end, step=1.0), [parts.Observer(body, stepper), record]):
        PETSc.Sys.Print(line.format(**step.row, exact=closed_form(step.time)))
