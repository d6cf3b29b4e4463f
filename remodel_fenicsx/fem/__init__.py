"""Finite elements without tissue: versions, compilation, quadrature, kinematics, PETSc options."""
