"""What is computed at every quadrature point, in C: compiled like the forms, held against Python by tests.

`library` compiles the C files and calls them; `points` and `tensor` have a method for each function. Most stand for a
function of the package: it is the reference, decides where C leaves a point open, and runs in its place with
``REMODEL_FENICSX_KERNELS=numpy`` in the environment, for a debugger.

=================== =====================================================================================
in C                stands for
=================== =====================================================================================
principal           tissue.spectral.principal
positive_direction  tissue.spectral.positive_direction
without_noise       tissue.spectral.without_noise
stretches           tissue.energy.squared_end_to_end_length, tissue.energy.axes_sum
parts               kernels.points.PointKernels.gradient_and_driver
structure           tissue.cells.structure_tensor
extension           kernels.points.PointKernels.extension
may_turn            kernels.points.PointKernels.may_turn
room                kernels.points.PointKernels.room
log_sum             tissue.energy.log_sum
log_derivatives     tissue.energy.log_derivatives
target              tissue.laws.tensor_target
solve               tissue.condensed.CondensedPoints.solve
tangent             tissue.condensed.CondensedPoints.tangent
=================== =====================================================================================
"""
