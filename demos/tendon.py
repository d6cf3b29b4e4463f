# %% [markdown]
# # A cylindrical tendon under uniaxial tension
#
# Kuhl & Holzapfel 2007, Fig. 6: a tendon of length 10 and cross-section 10 with randomly oriented collagen is pulled
# with a force of 300 in 12 steps, then held. At first it stretches to about 175 %; while its collagen turns into the
# direction of the load it stiffens, down to about 140 %. `demos/tendon.toml` is the same simulation as a scene.
#
#     ./with-fenicsx python3 demos/tendon.py [END [FOLDER]]
#     ./with-fenicsx mpirun -n 2 python3 demos/tendon.py

# %%
import sys

from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx import parts

end = float(sys.argv[1]) if len(sys.argv) > 1 else 150.0
comm = MPI.COMM_WORLD
folder = parts.chosen_folder(sys.argv[2] if len(sys.argv) > 2 else None, "tendon-script", comm)
parts.end_all_ranks_on_exception()

# %% [markdown]
# ## Geometry
# 48 trilinear elements in the cross-section, 10 along the axis z.

# %%
body = parts.Tendon(length=10.0, area=10.0)
domain = body.build(parts.Mesh(refinement=1, element="hexahedron", degree=1), comm)
kinematics = parts.FullKinematics()
displacement = kinematics.unknown(domain.mesh, degree=1)

# %% [markdown]
# ## Tissue
# The energy of `model/energy.py`; a unit cell at every quadrature point with one random draw of $l_I$ per element,
# $|l| = r_0$. A cell whose long side lies along z is stiff, one that lies across is soft: the body is not homogeneous.

# %%
tissue = parts.Material(lame_lambda=27.293, lame_mu=3.103, chain_density=2.0e21, contour_length=1.594,
                        persistence_length=1.365, temperature=310.0).tissue(end_to_end_length=1.0)  # fmt: skip
quadrature = parts.Quadrature(domain.mesh, element_degree=1)
start = parts.Cells(initial="random", axes="global", seed=1, end_to_end_length=1.0)
cells = parts.UnitCells(quadrature, domain, start, body.local_axes(domain, quadrature))

# %% [markdown]
# ## Supports and loads
# The bottom slides in its plane; its centre and one further node hold the rigid motions. On the top a dead traction
# $T = F / A_0$ along z; the top is free to deform.

# %%
loading = parts.Loading(domain, displacement, kinematics)
loading.hold_face("bottom", component=2)
loading.hold_node((0.0, 0.0, 0.0), component=0)
loading.hold_node((0.0, 0.0, 0.0), component=1)
loading.hold_node((domain.dimensions["radius"], 0.0, 0.0), component=1)
loading.add_dead_force("force", "top", component=2)


def load_values(time: float) -> dict[str, float]:
    """Up to t = 12, then held."""
    return {"force": 300.0 * min(time / 12.0, 1.0)}


# %% [markdown]
# ## Remodeling, step by step
# Each step sets the loads of its time, finds $u$ in equilibrium with the cells as they are, and then lets them remodel.
# Under uniaxial tension only the first eigenvalue of the Cauchy stress is positive, so $e \to (1, 0, 0)$ and eq. (11)
# lets $l_1 \to r_0$, $l_2, l_3 \to 0$ with $n_1$ along the load.

# %%
remodeling = parts.Remodeling(driver="cauchy", law="explicit", frame="spatial", kappa=0.025)
state = parts.State(displacement, kinematics, cells, loading)
stepper = parts.Stepper(state, tissue, remodeling, parts.Solver(), load_values)
line = "t = {time:5.1f}  stretch {mean_stretch:.4f}  angle {mean_fibre_angle:5.1f}"
with parts.RunFolder(folder, "# made by demos/tendon.py\n", comm.rank) as record:
    for step in stepper.march(parts.times(end, step=1.0), [parts.Observer(body, stepper), record]):
        PETSc.Sys.Print(line.format(**step.row))
