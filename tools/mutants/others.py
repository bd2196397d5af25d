# SPDX-License-Identifier: Apache-2.0
"""Errors in the simulator, the messages of the nodes, and the studies."""

from .mutant import Mutant, of

RANDOM_ARMS = "flexarm_studies/test/test_random_arms.py"

ERRORS = [
    *of(
        "flexarm_ros",
        ".",
        "flexarm_ros/test/test_session.py",
        (
            "session",
            "a request that was sent twice: the first answer is taken",
            "if done and (due or done[-1] is self._futures[-1]):",
            "if done:",
        ),
        (
            "session",
            "a flood of messages keeps a session from its callbacks",
            "MAX_TAKE = 0.005",
            "MAX_TAKE = 0.1",
        ),
    ),
    *of(
        "flexarm_sim",
        ".",
        "flexarm_sim/test/test_damping.py",
        (
            "damping",
            "the soft start",
            "at_once + self._grown(elapsed) * (full - at_once)",
            "full",
        ),
        (
            "damping",
            "the torque of the first speed",
            "np.maximum(self.speed, np.abs(velocity), out=self.speed)",
            "self.speed[:] = np.abs(velocity)",
        ),
    ),
    *of(
        "flexarm_studies",
        "uncertain",
        "flexarm_studies/test/test_uncertain.py",
        (
            "baselines",
            "strain feedback: sign of the moment that a gauge shows",
            '(1.0 if gauge.direction == "twist" else -1.0)',
            '(-1.0 if gauge.direction == "twist" else 1.0)',
        ),
        (
            "baselines",
            "strain feedback: of the whole moment, not of what the motion leaves",
            "(s[n : n + m] - still)",
            "s[n : n + m]",
        ),
        (
            "baselines",
            "LQG: as much noise in the torque as there may be",
            "value + max(np.log10(noisy / NOISIEST), 0.0)",
            "value",
        ),
        (
            "plants",
            "friction: none is added",
            "viscous=own.viscous + fraction * limit, coulomb=own.coulomb + fraction * limit",
            "viscous=own.viscous, coulomb=own.coulomb",
        ),
        (
            "report",
            "a lost run counts as its errors until then",
            "word = next((w for w in (REFUSED, LOST) if w in row), None)",
            "word = None",
        ),
        (
            "report",
            "the worst plant is the best one",
            'found[-1] if over == "worst"',
            'found[0] if over == "worst"',
        ),
    ),
    *[
        Mutant(
            name,
            "flexarm_ros/flexarm_ros/torque_gate.py",
            old,
            new,
            "flexarm_ros/test/test_torque_gate.py",
        )
        for name, old, new in (
            (
                "freshness: a torque that is too old",
                "        if self._until >= now:\n",
                "        if True:\n",
            ),
            (
                "freshness: a state's age, not the message's",
                "self._fresh_until = controller, sent + self.timeout",
                "self._fresh_until = controller, now + self.timeout",
            ),
            (
                "freshness: another session",
                "        if message.session != self.session:\n",
                "        if False:\n",
            ),
            (
                "freshness: out of order",
                "(sequence - self._answered) % WRAP >= WRAP // 2",
                "False",
            ),
            (
                "freshness: DISABLED",
                "            return self._close(self.DISABLED)\n",
                "            return self.DISABLED\n",
            ),
            (
                "two controllers in turn",
                "            if controller in self.ids:\n",
                "            if False:\n",
            ),
            (
                "freshness: a state that is published again",
                "self._sent[sequence] = self._sent[sequence][0], named",
                "self._sent[sequence] = now, named",
            ),
            (
                "handshake: a state that names none",
                "        if named != controller:\n",
                "        if False:\n",
            ),
            (
                "race: two torques for one state",
                "            if (torque != self._answer).any():\n",
                "            if False:\n",
            ),
            (
                "race: a torque after DISABLED",
                "            if not self._enabled:\n",
                "            if False:\n",
            ),
        )
    ],
    *of(
        "flexarm_sim",
        "",
        "flexarm_sim/test/test_plant.py",
        (
            "integrators",
            "friction asks for no shorter steps",
            "return count * min(_more(model, period, count), MOST)",
            "return count",
        ),
        (
            "integrators",
            "breakaway is no friction",
            "max(f.coulomb, f.breakaway)",
            "f.coulomb",
        ),
        (
            "integrators",
            "no friction is too much for the steps",
            "if more <= MOST:",
            "if True:",
        ),
    ),
    *of(
        "flexarm_studies",
        "uncertain",
        "flexarm_studies/test/test_uncertain.py",
        (
            "limits",
            "what friction holds is a peak",
            "(np.sqrt(2.0) * plant.arm.reach)",
            "plant.arm.reach",
        ),
    ),
    *of(
        "flexarm_studies",
        "uncertain",
        RANDOM_ARMS,
        (
            "trial",
            "an arm that its integrator loses is lost",
            "if loop.lost and loop.simulator.plant.implicit:",
            "if False:",
        ),
    ),
]
