# %% [markdown]
# # A tube-like artery subject to axial stretch and internal pressure
#
# Kuhl & Holzapfel 2007, Figs. 7 and 8: an artery with randomly oriented collagen is stretched by 10 % and pressurised
# to 4.8 in 25 steps, then held while its collagen reorients. `demos/artery.toml` is the same simulation as a scene.
#
#     ./with-fenicsx python3 demos/artery.py [END [FOLDER]]
#     ./with-fenicsx mpirun -n 2 python3 demos/artery.py

# %%
import sys

from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx import parts

end = float(sys.argv[1]) if len(sys.argv) > 1 else 150.0
comm = MPI.COMM_WORLD
folder = parts.chosen_folder(sys.argv[2] if len(sys.argv) > 2 else None, "artery-script", comm)
parts.end_all_ranks_on_exception()

# %% [markdown]
# ## Geometry and tissue
# Radii 1 and 3, length 8; 16 trilinear elements around, 8 through the wall, 12 along. The unknown is the displacement
# $u$, the deformation gradient $F = I + \nabla u$, $C = F^T F$, $J = \det F$.
# An isotropic matrix and eight-chain cells with dimensions $l_I$ along orthonormal axes $n_I$:
# $$W = \frac{\lambda}{2}\ln^2 J + \frac{\mu}{2}(\operatorname{tr} C - 3) - \mu \ln J
#     + c\,\frac{L}{4}\Big(2\frac{r^2}{L^2} + \frac{1}{1-r/L} - \frac{r}{L}\Big)
#     - \frac{c}{2}\,g(r_0) \sum_I l_I^2 \ln(n_I \cdot C n_I)$$
# with the end-to-end length $r^2 = \sum_I l_I^2\, n_I \cdot C n_I$ and $c = k\theta n / (4 A_p)$; `model/energy.py`
# says it in UFL. The cells live at the quadrature points; each element starts with random dimensions, $|l| = r_0$.

# %%
body = parts.Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
domain = body.build(parts.Mesh(refinement=1, element="hexahedron", degree=1), comm)
kinematics = parts.FullKinematics()
displacement = kinematics.unknown(domain.mesh, degree=1)
tissue = parts.Material(lame_lambda=27.293, lame_mu=3.103, chain_density=2.0e21, contour_length=1.594,
                        persistence_length=1.365, temperature=310.0).tissue(end_to_end_length=1.0)  # fmt: skip
quadrature = parts.Quadrature(domain.mesh, element_degree=1)
start = parts.Cells(initial="random", axes="cylindrical", seed=1, end_to_end_length=1.0)
cells = parts.UnitCells(quadrature, domain, start, body.local_axes(domain, quadrature))

# %% [markdown]
# ## Supports and loads
# The ends slide in their planes; three inner nodes of the bottom hold the rigid motions without holding the section in
# shape. The pressure follows the deformed inner face: $p \int \operatorname{cof}(F) N \cdot v\, \mathrm{d}A$.

# %%
loading = parts.Loading(domain, displacement, kinematics)
loading.hold_face("bottom", component=2)
loading.hold_node((1.0, 0.0, 0.0), component=1)
loading.hold_node((-1.0, 0.0, 0.0), component=1)
loading.hold_node((0.0, 1.0, 0.0), component=0)
loading.add_prescribed_elongation("elongation", "top", component=2, length=8.0)
loading.add_follower_pressure("pressure", "inner")


def load_values(time: float) -> dict[str, float]:
    """Up to t = 25, then held."""
    return {"pressure": 4.8 * min(time / 25.0, 1.0), "elongation": 0.1 * min(time / 25.0, 1.0)}


# %% [markdown]
# ## Remodeling, step by step
# Each step sets the loads of its time, finds $u$ in equilibrium with the cells as they are, and then lets them remodel.
# With the eigenvalues $\lambda_I$ of the Cauchy stress, their positive parts and $e = \lambda^+ / |\lambda^+|$, every
# point turns its axes to the principal directions at once and its dimensions gradually (eq. 11):
# $$l = l^0 + (r_0\, e - l^0)\,(1 - e^{-\kappa t})$$

# %%
remodeling = parts.Remodeling(driver="cauchy", law="explicit", frame="spatial", kappa=0.025)
state = parts.State(displacement, kinematics, cells, loading)
stepper = parts.Stepper(state, tissue, remodeling, parts.Solver(), load_values)
line = "t = {time:5.1f}  outer radius {outer_radius:.4f}  angles {fibre_angle_inner:.1f} to {fibre_angle_outer:.1f}"
with parts.RunFolder(folder, "# made by demos/artery.py\n", comm.rank) as record:
    for step in stepper.march(parts.times(end, step=1.0), [parts.Observer(body, stepper), record]):
        PETSc.Sys.Print(line.format(**step.row))
