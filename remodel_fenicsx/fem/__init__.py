"""dolfinx, and nothing of the tissue: versions, compilation, quadrature points, kinematics, PETSc options."""
