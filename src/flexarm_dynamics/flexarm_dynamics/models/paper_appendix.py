# SPDX-License-Identifier: Apache-2.0
r"""The one-link model that Siciliano & Book publish in their appendix: misprints corrected, omissions kept.

These are corrected, because the published formulas do not give the published numbers: the sign of :math:`\nu_i` in
(A1); :math:`\phi_{ie}^2` in k11 and k22; the factor :math:`\dot\theta` in (A5); :math:`\phi_e' = \frac1L d\phi/d\xi`;
:math:`\int\phi^2 = 1`.

The paper leaves these terms out of its own Lagrangian, and so does this class:

=============================================  ==========================================================
omitted                                        effect on arm R
=============================================  ==========================================================
the beam's own :math:`m\sum\delta_i^2` in m11  composite's peak joint error 3.457 -> 3.449 deg
and :math:`m\dot\theta^2\delta_i` in K2
:math:`J_p` in m11, :math:`J_p\phi_e'`         m12 .071435 -> .071493 lbf s^2; zeta_2 .4052 -> .3995;
in m12 and m13                                 first gain -127.04 -> -127.56 lbf
Gram matrix taken as the identity              nothing for R (clamped-free modes are orthonormal); for
                                               modes from measured frequencies int phi1 phi2 = 0.298
:math:`m = \rho A L`, :math:`J_0 = mL^2/3`     published values are rounded: last digit only
=============================================  ==========================================================

For arms P3 and R only; for your own arm use `one_link.OneLink`.
"""

import numpy as np

from ..errors import ModelError
from .model import damping_matrix
from .one_link import Coefficients, OneLinkEquations


class PaperAppendix(OneLinkEquations):
    r"""(A1)-(A8) for any number of modes.

    ``m23_fit`` is added to m23 and m32. It is a fitted number without physical meaning, needed to reproduce the
    published gains (arm P3).
    """

    def __init__(self, arm, shapes=None):
        if arm.model != "paper_appendix" or not arm.model_options:
            hint = "this model needs that section of the arm file"
            raise ModelError("missing", field=f"paper_appendix of {arm.name}", hint=hint)
        if any(arm.gravity):
            problem, gravity = "is not in the published model", list(arm.gravity)
            raise ModelError(problem, field="gravity", value=gravity, hint="use model one_link")
        super().__init__(arm, shapes)

    def derive(self):
        link, payload, shapes = self.link, self.arm.payload, self.shapes
        options = self.arm.model_options
        L, M, Jp = link.length, payload.mass, payload.inertia[2][2]
        m, phi, slope = options["beam_mass"], self.phi_tip, self.slope_tip
        count = shapes.count
        # (A2): only the payload's terms depend on the deflections.
        G = M * np.outer(phi, phi)
        M22 = m * np.eye(count) + G + Jp * np.outer(slope, slope)
        if count > 1:
            M22[0, 1] += options["m23_fit"]
            M22[1, 0] += options["m23_fit"]
        elif options["m23_fit"]:
            raise ModelError(
                "needs two modes", field="paper_appendix.m23_fit", limit=f"{count} given"
            )
        # k_ei, diagonal in the published model.
        K = link.stiffness["y"] / L**3 * np.diag(np.diag(shapes.gram(2)))
        w = link.mass_per_length * L**2 * shapes.integral(lambda xi: xi)
        return Coefficients(
            rigid=options["beam_inertia"] + M * L**2 + self.joint.inertia,
            moment=0.0,
            h=M * L * phi + w,
            M22=M22,
            G=G,
            K=K,
            D=damping_matrix(M22, K, self.flexibility.damping),
            s=np.zeros(count),
        )
