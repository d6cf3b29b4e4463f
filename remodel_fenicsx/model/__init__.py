"""The paper's model in its order: plain functions on arrays or UFL, no mesh.

========= ====================================================== ============================
eq.       content                                                where
========= ====================================================== ============================
(1), (2)  energy and force of one wormlike chain                 `chains`
(3), (4)  W = W_iso + W_chn + W_rep                              `energy` (W is written only here)
(5)       end-to-end length r from the cell's I_I = n_I . C n_I  `cells` (the unit cell), `energy`
(6), (7)  Cauchy stress, by differentiation of W                 `energy`: `Tissue.stresses`
(8)       principal values and axes of the driving tensor        `drivers`, `spectral`
(9)       n_I = the principal axes, l_I -> r0 e                  `drivers` (frames), `spectral`
(10)      rate of l_I                                            `laws.rate`
(11)      l_I in closed form                                     `laws.explicit`
Remark 5  the older law, which rotates the fibres                `laws.rotation`
Remark 6  power of remodeling                                    `energy`: `Tissue.energy_increment`
========= ====================================================== ============================

Errors of the printed equations are corrected where the equations stand, under the numbers of
docs/model.md ("erratum 1"). The law for the structure tensor (`tensor_law`) is not in the paper.
Tools: `tensors` (one name on arrays and in UFL).
"""
