# SPDX-License-Identifier: Apache-2.0
"""Constants of an arm and work space, as `kernels.chain` and the modules that it is made of take them."""

from collections import namedtuple

#: Whether joints have transmissions, housings or friction beyond Coulomb's: compiled apart for arms without, which then
#: cost nothing more.
JOINT_PARTS = True
#: Deflection beyond the play, in parts of half of it, at which a transmission has half of its damping.
ENGAGEMENT = 0.1
TWIST, Y, Z, REDUCED = 0, 1, 2, 3
FIRST_ORDER, FORESHORTENING, FINITE_SLOPE = 0, 1, 2
#: Columns of `of_link`: integrals of s, its second derivative along delta_d and X^2 - x^2 over the mass; at the tip.
SHORT, SHORT_DD, XX, SHORT_TIP, SHORT_TIP_DD = 0, 1, 2, 3, 4
#: Columns of `of_mode`: of P_j, X P_j, y P_j, z P_j, y' P_j, z' P_j, s'' P_j, s phi_j, s' phi_j, s'' phi_j.
P, XP, YP, ZP, YDP, ZDP, SDDP, SPHI, SDPHI, SDDPHI = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
#: Constants of an arm: N links, at most K modes each, G quadrature nodes. SI.
DATA = {
    "links": (),  # N; arrays may be longer than that
    "level": (),  # FIRST_ORDER, FORESHORTENING or FINITE_SLOPE
    "nodes": (),  # G
    "count": ("N",),  # modes of each link
    "first": ("N",),  # where they start in delta
    "direction": ("N", "K"),  # TWIST, Y or Z
    "axis": ("N", 3),  # of the joint, in the joint's frame
    "xyz": ("N", 3),  # joint's origin in the previous tip's frame
    "turn": ("N", 3, 3),  # and its orientation
    "gear": ("N",),
    "rotor": ("N",),  # rotor inertia, motor side
    # place in delta of the deflection of each joint's transmission; -1: it has none
    "spring": ("N",),
    # stiffness, damping, half the play, damping per transmitted torque, rounding, damping within the play
    "transmission": ("N", 6),
    # friction beyond Coulomb's: breakaway level's excess, Stribeck speed, part of the transmitted torque, smoothing
    "slip": ("N", 4),
    "housed": ("N",),  # whether the joint's motor has a housing that turns
    "housing": ("N", 3, 3),  # its inertia about the joint, before the joint's turn
    "length": ("N",),
    "mass": ("N",),  # beam, and the motor at its base
    "moment": ("N",),  # int x dm
    "inertia": ("N", 3, 3),  # of the straight link about its frame's origin, hub included
    "s": ("N", "K"),  # int phi dm; twist: int theta rho I_p dx
    "e": ("N", "K"),  # int x phi dm
    # int phi_j phi_k dm, across directions too; twist: int theta theta rho I_p dx
    "gram": ("N", "K", "K"),
    "stiffness": ("N", "K", "K"),
    "damping": ("N", "K", "K"),
    "tip": ("N", "K"),  # phi(L)
    "slope": ("N", "K"),  # phi'(L); twist: theta(L)
    "node_x": ("N", "G"),
    "node_mass": ("N", "G"),  # quadrature weight times rho A
    "node_phi": ("N", "G", "K"),
    "node_slope": ("N", "G", "K"),
    "node_bend": ("N", "G", "K"),  # phi''
    "node_ei": ("N", "G", 2),  # quadrature weight times EI along y and z
    "cumulate": (
        "N",
        "G",
        "G+1",
    ),  # of a function at the nodes: integrals from the base to each node and to the tip
    "bishop": ("N", "K", "K"),  # int phi_y'' phi_z' dx
    "root": ("N", 3),  # where the link's axis begins, from its joint
    "rooted": ("N",),  # whether that is off the joint
    "root_mass": ("N",),  # mass of the beam, which begins there
    "bodies": (),  # B rigid bodies on sections of links
    "host": ("B",),  # the link of each
    "body_node": ("B",),  # the quadrature node at its section
    "body_x": ("B",),
    "body_tip": ("B", "K"),  # of its section, as tip, slope and bishop of a link's tip
    "body_slope": ("B", "K"),
    "body_bishop": ("B", "K", "K"),
    "body_mass": ("B",),
    "body_moment": ("B", 3),  # in the section's frame, about the section
    "body_inertia": ("B", 3, 3),
    # R links given by reduced matrices: see `arm.reduced`, whose symbols these are.
    "reduced": ("N",),  # which of them each link is; -1: a beam
    "red_first": ("R", 3),  # c0
    "red_tip": ("R", 3),
    "red_C": ("R", "K", 3),
    "red_l": ("R", "K", 3),
    "red_H": ("R", "K", 3, 3),
    "red_G": ("R", "K", "K", 3, 3),
    "red_C2": ("R", "K", "K", 3),
    "red_H2": ("R", "K", "K", 3, 3),
    "red_T": ("R", "K", 3),  # translation of the tip
    "red_R": ("R", "K", 3),  # its rotation
    "red_T2": ("R", "K", "K", 3),  # and second order
    "red_R2": ("R", "K", "K"),  # about x
    "payload_mass": (1,),
    "payload_moment": (3,),  # in the tip's frame, about the tip
    "payload_inertia": (3, 3),
    "gravity": (3,),  # in the base frame
}
#: Work space, filled by `prepare` (kinematics and inertia) and by the recursions. Row N is the tip's.
WORK = {
    "frame": ("N+1", 3, 3),  # link to previous link's coordinates
    "rate": ("N",),  # at which each link turns about its joint
    "housing": ("N", 3, 3),  # inertia of the joint's housing, link coordinates
    "al_carrier": ("N+1", 3),  # angular acceleration of what carries the joint, link coordinates
    "omega": ("N+1", 3),  # angular velocity of each link's frame, in its coordinates
    # angular velocity of what carries the joint, link coordinates; N: of the tip, link N - 1's
    "carrier": ("N+1", 3),
    "arm": ("N+1", 3),  # from link i - 1's base to joint i, its coordinates
    "partial": ("N+1", "K", 3),  # d arm / d delta of link i - 1
    "turning": ("N+1", "K", 3),  # angular partial velocity of its tip
    # acceleration of joint i that its parent's al, a0, delta_dd do not explain
    "bias_a": ("N+1", 3),
    "bias_al": ("N+1", 3),  # angular likewise
    "c": ("N", 3),
    "J": ("N", 3, 3),
    "p": ("N", "K", 3),
    "l": ("N", "K", 3),
    "M": ("N", "K", "K"),
    "N": ("N", 3),
    "F": ("N", 3),
    "q": ("N", "K"),  # velocity terms of the modes; the elastic force is apart
    "elastic": ("N", "K"),
    "al": ("N+1", 3),
    "a0": ("N+1", 3),
    "X": ("N+1", 3, 3),  # articulated inertia: n = X al + Y a0 + zn, f = Y' al + Z a0 + zf
    "Y": ("N+1", 3, 3),
    "Z": ("N+1", 3, 3),
    "zn": ("N+1", 3),
    "zf": ("N+1", 3),
    # L of the articulated modal mass L D L', on its diagonal the inverse of D
    "B": ("N", "K", "K"),
    "Bd": ("N", "K", "K"),  # L D
    "Ca": ("N", "K", 3),  # rows of its coupling to al
    "Cf": ("N", "K", 3),  # and to a0
    "rhs": ("N", "K"),
    "Ua": ("N", 3),
    "Uf": ("N", 3),
    "D": ("N",),
    "u": ("N",),
    # of a link behind a transmission: what Ua, Uf are before the motor; inverse of D, u, D without `extra`
    "Sa": ("N", 3),
    "Sf": ("N", 3),
    "S": ("N", 3),
    "t": (12, 3),  # scratch
    "tm": (6, 3, 3),  # scratch
    "of_link": ("N", 5),  # see `integrals`: SHORT, SHORT_DD ...
    "of_mode": ("N", "K", 10),  # P, XP ...
    "draws": ("N", "K"),  # P_j at the tip
    "of_body": ("B", 2),  # of bodies' sections, as SHORT_TIP, SHORT_TIP_DD of a tip
    "body_draws": ("B", "K"),
    "of_modes": ("N", "K", "K"),  # int P_j P_k dm for k <= j
    "bent": ("N", "K"),  # elastic force of bending at finite slopes
    "node": (4, "G+1"),  # integrands at the nodes and what they integrate to
    "node_partial": (2, "K", "G+1"),
}
Data = namedtuple("Data", DATA)
Work = namedtuple("Work", WORK)
