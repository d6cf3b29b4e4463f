"""What is computed at every quadrature point, in C: compiled like the forms, held against Python by tests.

`kernels` compiles the C files and calls them; it and `tensor` have a method for each function. Most stand for a
function of the package: it is the reference, decides where C leaves a point open, and runs in its place with
``REMODEL_FENICSX_KERNELS=numpy`` in the environment, for a debugger. Those of `factor`, which calls CHOLMOD, stand for
none: without them factors are PETSc's, in double precision.

=================== =====================================================================================
in C                stands for
=================== =====================================================================================
principal           model.spectral.principal
positive_direction  model.spectral.positive_direction
without_noise       model.spectral.without_noise
stretches           model.energy.squared_end_to_end_length, model.energy.axes_sum
parts               kernels.kernels.PointKernels.gradient_and_driver
structure           model.cells.structure_tensor
extension           kernels.kernels.PointKernels.extension
may_turn            kernels.kernels.PointKernels.may_turn
room                kernels.kernels.PointKernels.room
log_sum             model.energy.log_sum
log_derivatives     model.energy.log_derivatives
target              model.laws.tensor_target
solve               model.implicit.CondensedPoints.solve
tangent             model.implicit.CondensedPoints.tangent
factor_new          kernels.kernels.SingleFactor
factor_renew        kernels.kernels.SingleFactor.renew
factor_solve        kernels.kernels.SingleFactor.solve
factor_free         kernels.kernels.SingleFactor.close
=================== =====================================================================================
"""
