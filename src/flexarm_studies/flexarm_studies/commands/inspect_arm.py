# SPDX-License-Identifier: Apache-2.0
"""``flexarm frequencies`` and ``flexarm show``: show natural frequencies and properties of an arm file's arm."""

import json
from dataclasses import asdict

import numpy as np

from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models import levels, model

from .arm_figure import draw
from .options import add_arm_arguments, add_model_arguments, angles, load_arm

#: A tip that sags by more than this fraction of its link's length is beyond small deflections.
LARGE_SAG = 0.05
#: Control rate to which warnings about fast modes refer [Hz].
USUAL_RATE = 1000.0


def _add_arm(parser):
    """Add the arguments of both commands: the arm, its joint angles and model, and ``--json``."""
    add_arm_arguments(parser)
    parser.add_argument("--at", metavar="q1,q2,...", help="joint angles [rad]; zero if not given")
    add_model_arguments(parser)


def add_frequency_arguments(parser):
    """Arguments of ``frequencies``."""
    parser.description = (
        "Undamped natural frequencies of the straight arm at given joint angles, gravity left out."
    )
    parser.epilog = "example: flexarm frequencies two_link --at 0,1.57 --locked"
    _add_arm(parser)
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--locked", action="store_true", help="only with joints locked (both if neither is given)"
    )
    which.add_argument("--free", action="store_true", help="only with joints free")
    parser.add_argument(
        "--shapes", action="store_true", help="joint angles and modal amplitudes of each mode"
    )


def frequencies(options):
    """Run ``frequencies``."""
    arm = load_arm(options)
    arm_model = model.build(arm)
    q = angles(options.at, arm, "--at")
    cases = {"locked": True, "free": False}
    if options.locked or options.free:
        cases = {k: v for k, v in cases.items() if getattr(options, k)}
    result = {"arm": arm.name, "q": q.tolist()}
    for case, locked in cases.items():
        omega, shapes = arm_model.normal_modes(q, locked)
        result[case] = {"rad_s": omega.tolist(), "Hz": (omega / (2.0 * np.pi)).tolist()}
        if options.shapes:
            # The largest entry of each is one: its joint angles [rad] and modal amplitudes [m, rad].
            scale = np.abs(shapes).max(axis=0) if shapes.size else 1.0
            result[case]["shapes"] = (shapes / scale).T.tolist()
    if options.json:
        print(json.dumps(result))
        return result
    print(
        f"{arm.name} at q = [{', '.join(f'{v:g}' for v in q)}] rad: natural frequencies, undamped, without gravity"
    )
    for case in cases:
        print(f"\njoints {case}\n  mode       rad/s          Hz")
        if not result[case]["rad_s"]:
            print("  none: the arm is rigid")
        for i, (w, f) in enumerate(zip(result[case]["rad_s"], result[case]["Hz"], strict=True)):
            print(f"  {i + 1:4d}{w:12.5g}{f:12.5g}")
        if options.shapes:
            names = [*arm.joint_names, *arm.mode_names]
            print(f"  shapes: {', '.join(names)}")
            for i, shape in enumerate(result[case]["shapes"]):
                print(f"  {i + 1:4d}  " + " ".join(f"{v:8.4f}" for v in shape))
    return result


def add_show_arguments(parser):
    """Arguments of ``show``."""
    parser.description = "Describes the arm of an arm file, with warnings."
    parser.epilog = "example: flexarm show long_reach --at 0,0.5,0,0 --plot"
    _add_arm(parser)
    parser.add_argument(
        "--plot",
        metavar="FILE.png",
        nargs="?",
        const="",
        help="draw the arm and its mode shapes (results/ARM.png if no file is named)",
    )


def show(options):
    """Run ``show``."""
    arm = load_arm(options)
    arm_model = model.build(arm)
    q = angles(options.at, arm, "--at")
    result = describe(arm_model, q)
    if options.plot is not None:
        result["plot"] = draw(arm_model, q, options.plot or f"results/{arm.name}.png")
    print(json.dumps(result) if options.json else "\n".join(text(result)))
    return result


def describe(arm_model, q):
    """Masses, inertias, modes, frequencies, gauges and warnings of an arm, as plain data in SI."""
    arm, n = arm_model.arm, arm_model.n_joints
    M = arm_model.terms(q, np.zeros(n)).M
    joints = [
        {
            "name": j.name,
            "hub_inertia": j.hub_inertia,
            "reflected_rotor_inertia": j.rotor_inertia * j.gear_ratio**2,
            "motor_mass": j.motor_mass,
            "inertia_of_the_straight_arm": M[i, i],
            "transmission": None if j.transmission is None else asdict(j.transmission),
            "encoder": j.encoder,
            "safe_action": j.safe_action,
            "torque_limit": j.limits.torque if np.isfinite(j.limits.torque) else None,
        }
        for i, j in enumerate(arm.joints)
    ]
    links = [
        {
            "name": link.name,
            "length": link.length,
            "mass": link.total_mass,
            "root": list(link.root),
            "bodies": [asdict(body) for body in link.bodies],
            "stiffness": link.stiffness,
            "sections": [
                {
                    "to": b * link.length,
                    "mass_per_length": [link.mass_per_length * v for v in ends(piece.mass)],
                    "stiffness": {
                        d: [EI * v for v in ends(getattr(piece, d))]
                        for d, EI in link.stiffness.items()
                    },
                }
                for piece, b in zip(link.pieces, link.breaks[1:], strict=False)
            ],
            "flexible": {
                d: {"modes": f.modes, "shape": f.shape, "damping": list(f.damping)}
                for d, f in link.flexible.items()
            },
        }
        for link in arm.links
    ]
    mass = sum(link.total_mass for link in arm.links) + sum(j.motor_mass for j in arm.joints)
    result = {
        "arm": arm.name,
        "description": arm.description,
        "source": " ".join(arm.source.split()),
        "model": arm.model,
        "foreshortening": arm.foreshortening or arm.finite_slope,
        "finite_slope": arm.finite_slope,
        "simulated_level": levels.level_of(levels.simulated(arm)),
        "gravity": list(arm.gravity),
        "mass": mass + arm.payload.mass,
        "q": q.tolist(),
        "joints": joints,
        "links": links,
        "payload": {
            "mass": arm.payload.mass,
            "inertia": [list(row) for row in arm.payload.inertia],
            "offset": list(arm.payload.offset),
        },
        "modes": list(arm.mode_names),
        "observed_modes": list(arm.observed_modes),
        "frequencies_hz": {
            "locked": (arm_model.frequencies(q, locked=True) / (2.0 * np.pi)).tolist(),
            "free": (arm_model.frequencies(q) / (2.0 * np.pi)).tolist(),
        },
        "gauges": [
            {"name": g.name, "link": g.link, "position": g.position, "direction": g.direction}
            | ({"point": g.point} if g.point else {})
            for g in arm.gauges
        ],
    }
    result |= {"sag": None, "strain_map_condition": None}
    return result | {"warnings": warnings(arm_model, q, result)}


def ends(coefficients):
    """Values of a polynomial at 0 and 1."""
    return float(coefficients[0]), float(sum(coefficients))


def warnings(arm_model, q, result):
    """Warnings for users of this arm; fills in the sag and the condition of the strain map."""
    arm, found = arm_model.arm, []
    try:
        delta = arm_model.static_deflection(q)
        result["sag"] = {
            link.name: arm_model.tip_deflection(delta, link.name).tolist() for link in arm.links
        }
        for link in arm.links:
            fraction = np.hypot(*result["sag"][link.name]) / link.length
            if fraction > LARGE_SAG and not (arm.foreshortening or arm.finite_slope):
                found.append(
                    f"{link.name} sags by {100 * fraction:.1f} % of its length under gravity, beyond small deflections:"
                    " simulation takes level finite_slope, the control model does not (finite_slope: true)"
                )
    except ModelError as error:
        found.append(str(error))
    if arm.gauges:
        try:
            result["strain_map_condition"] = StrainMap(arm_model).condition
        except ModelError as error:
            found.append(str(error))
    elif arm.known.modes:
        found.append("no gauges: no modal amplitudes without them")
    missing = set(arm.known.mode_names) - set(arm.observed_modes)
    if missing and arm.gauges:
        found.append(
            f"modes that are not observed leak into the gauges: {', '.join(sorted(missing))}"
        )
    fast = [f for f in result["frequencies_hz"]["free"] if f > USUAL_RATE / 4.0]
    if fast:
        found.append(
            f"{len(fast)} of the free modes are above {USUAL_RATE / 4.0:g} Hz, up to {fast[-1]:.4g} Hz: too fast"
            f" to be damped at {USUAL_RATE:g} samples per second"
        )
    for joint in arm.joints:
        if joint.transmission is not None and joint.transmission.play:
            found.append(
                f"{joint.name} has play: flexarm analyze, simulate and design warn where a loop is likely to oscillate"
                " in it"
            )
    for link in arm.links:
        for direction, f in link.flexible.items():
            if not f.damping:
                found.append(f"{link.name} has no damping in {direction}: it never stops vibrating")
    return found


def text(d):
    """Lines of the description for people."""
    yield f"{d['arm']}: {d['description']}"
    if d["source"]:
        yield f"source: {d['source']}"
    level = "foreshortening" if d["foreshortening"] else "first order"
    level = "finite slope" if d["finite_slope"] else level
    level += f" (simulated: {d['simulated_level']})"
    yield f"model {d['model']}, {level}; {d['mass']:.4g} kg in all; gravity {d['gravity']} m/s^2"
    yield ""
    yield f"{'joint':18}{'hub':>10}{'rotor':>10}{'motor':>10}{'all':>12}{'limit':>10}  safe action"
    yield f"{'':18}{'kg m^2':>10}{'kg m^2':>10}{'kg':>10}{'kg m^2':>12}{'N m':>10}"
    for j in d["joints"]:
        limit = "none" if j["torque_limit"] is None else f"{j['torque_limit']:.4g}"
        yield (
            f"{j['name']:18}{j['hub_inertia']:10.4g}{j['reflected_rotor_inertia']:10.4g}{j['motor_mass']:10.4g}"
            f"{j['inertia_of_the_straight_arm']:12.4g}{limit:>10}  {j['safe_action']}"
        )
    yield f"(all: inertia of the straight arm about the joint at q = {d['q']})"
    for j in d["joints"]:
        if (t := j["transmission"]) is not None:
            yield (
                f"transmission of {j['name']}: {t['stiffness']:.4g} N m/rad, {t['damping']:.4g} N m s/rad, play"
                f" {1e3 * t['play']:.4g} mrad, {t['load_damping']:.4g} s/rad; encoder at the {j['encoder']}"
            )
    yield ""
    yield f"{'link':18}{'length':>10}{'mass':>10}  flexible"
    yield f"{'':18}{'m':>10}{'kg':>10}"
    for link in d["links"]:
        flexible = ", ".join(
            f"{k}: {v['modes']} {v['shape']}, {'GJ' if k == 'twist' else 'EI'} {link['stiffness'][k]:.4g} N m^2"
            if k in link["stiffness"]
            else f"{v['modes']} modes of reduced matrices"
            for k, v in link["flexible"].items()
        )
        yield f"{link['name']:18}{link['length']:10.4g}{link['mass']:10.4g}  {flexible or 'rigid'}"
        for b in link["bodies"]:
            yield f"{'':18}body of {b['mass']:.4g} kg at {b['position']:.4g} m"
        for part in link["sections"]:
            values = {"kg/m": part["mass_per_length"]}
            values |= {
                f"N m^2 ({'GJ' if d == 'twist' else f'EI {d}'})": v
                for d, v in part["stiffness"].items()
                if d in link["flexible"]
            }
            spans = (f"{a:.4g} to {b:.4g} {unit}" for unit, (a, b) in values.items())
            yield f"{'':18}to {part['to']:.4g} m: {', '.join(spans)}"
    p = d["payload"]
    yield f"payload {p['mass']:.4g} kg, centre of mass {p['offset']} m from the tip"
    yield ""
    yield "frequencies [Hz]"
    for case, values in d["frequencies_hz"].items():
        yield f"  joints {case:8}" + (", ".join(f"{v:.4g}" for v in values) or "none: rigid")
    if d["sag"] and any(any(v) for v in d["sag"].values()):
        yield "sag under gravity, along y and z of each link [m]"
        for name, value in d["sag"].items():
            yield f"  {name:18}{value[0]:10.4g}{value[1]:10.4g}"
    if d["gauges"]:
        yield "gauges"
        for g in d["gauges"]:
            where = f"{g['position']:.4g} m, {g['direction']}"
            yield f"  {g['name']:18}{g['link']} at {g.get('point', where)}"
    if d["strain_map_condition"] is not None:
        yield f"  condition number of the strain map {d['strain_map_condition']:.3g}"
    for w in d["warnings"]:
        yield f"warning: {w}"
    if "plot" in d:
        yield f"plot: {d['plot']}"
