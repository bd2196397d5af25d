# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

name = "flexarm_control"

setup(
    name=name,
    version="0.1.0",
    description="Slow and fast laws, composite control and observers for arms with flexible links.",
    license="Apache-2.0",
    maintainer="flexarm maintainers",
    maintainer_email="maintainers@flexarm.invalid",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "observer = flexarm_control.nodes:start_observer",
            "controller = flexarm_control.nodes:start_controller",
            "observer_controller = flexarm_control.nodes:start_observer_controller",
            "goals = flexarm_control.nodes:start_goals",
            "excite = flexarm_control.nodes:start_excite",
            "shaper = flexarm_control.nodes:start_shaper",
        ],
        "flexarm.slow_laws": [
            "none = flexarm_control.slow.none:NoSlowLaw",
            "linear_model_following = flexarm_control.slow.linear_model_following:LinearModelFollowing",
            "model_following = flexarm_control.slow.model_following:ModelFollowing",
            "computed_torque = flexarm_control.slow.computed_torque:ComputedTorque",
            "resolved_acceleration = flexarm_control.slow.resolved_acceleration:ResolvedAcceleration",
            "joint_pid = flexarm_control.slow.joint_pid:JointPid",
            "sliding_mode = flexarm_control.slow.sliding_mode:SlidingMode",
            "adaptive_model_following = flexarm_control.slow.adaptive_model_following:AdaptiveModelFollowing",
        ],
        "flexarm.fast_laws": [
            "none = flexarm_control.fast.none:NoFastLaw",
            "fixed_gain = flexarm_control.fast.fixed_gain:FixedGain",
            "lqr = flexarm_control.fast.lqr:Lqr",
            "scheduled_lqr = flexarm_control.fast.scheduled_lqr:ScheduledLqr",
            "pole_placement = flexarm_control.fast.pole_placement:PolePlacement",
            "output_feedback = flexarm_control.fast.output_feedback:OutputFeedback",
        ],
        "flexarm.manifolds": [
            "quasi_steady = flexarm_control.manifold.quasi_steady:QuasiSteady",
            "reference = flexarm_control.manifold.reference:ReferenceManifold",
            "corrected = flexarm_control.manifold.corrected:CorrectedManifold",
        ],
        "flexarm.feedforwards": [
            "model = flexarm_control.feedforward.model:ModelFeedforward",
            "preview = flexarm_control.feedforward.preview:Preview",
        ],
        "flexarm.observers": [
            "true_rates = flexarm_control.observers.true_rates:TrueRates",
            "filtered_derivative = flexarm_control.observers.filtered_derivative:FilteredDerivative",
            "luenberger = flexarm_control.observers.luenberger:Luenberger",
            "kalman = flexarm_control.observers.kalman:Kalman",
            "motion_kalman = flexarm_control.observers.motion_kalman:MotionKalman",
            "extended_kalman = flexarm_control.observers.extended_kalman:ExtendedKalman",
        ],
    },
)
