# SPDX-License-Identifier: Apache-2.0
"""What the launch files start: their arguments, and the nodes that follow from the arguments' values.

Only `description`, which makes a launch description of both, imports `launch`: a machine without a ROS installation
does not have it.
"""

from dataclasses import dataclass, field

from flexarm_dynamics.errors import ParameterError
from flexarm_studies.loop import parameter_files

LEVELS = ("debug", "info", "warn", "error", "fatal")
SWITCH = ("true", "false")


@dataclass(frozen=True)
class Argument:
    """An argument of a launch file."""

    default: str
    description: str
    choices: tuple = ()


@dataclass
class Start:
    """One executable to start: what `launch_ros.actions.Node` takes."""

    package: str
    executable: str
    namespace: str = ""
    parameters: list = field(default_factory=list)
    arguments: list = field(default_factory=list)
    log_level: str = "info"


ARM = Argument(
    "", "arm file: a shipped name (R, two_link, ...) or a path; empty: the controller file's"
)
CONTROLLER = Argument(
    "",
    "controller file, for all nodes: a shipped name (composite, two_link, ...) or a path; empty: the arm's shipped one,"
    " for another arm none, and its control is designed",
)
NAMESPACE = Argument("", "namespace of the nodes and of their topics")
LOCKSTEP = Argument(
    "false", "true: the simulator runs as fast as the machine goes; false: in real time", SWITCH
)
LOG_LEVEL = Argument("info", "least severity that is logged", LEVELS)
SIMULATOR = Argument("true", "false: a driver of yours takes the simulator's place", SWITCH)
SHAPE = Argument("false", "true: the node shape draws the arm, for RViz and Foxglove", SWITCH)
GOALS = Argument("true", "false: no action servers, joint_trajectory alone", SWITCH)
AUTOSTART = Argument(
    "true",
    "true: torque follows with the first valid state; false: the controller waits for a lifecycle manager",
    SWITCH,
)

ONE_ARM = {
    "arm": ARM,
    "controller": CONTROLLER,
    "namespace": NAMESPACE,
    "with_simulator": SIMULATOR,
    "with_goals": GOALS,
    "with_shape": SHAPE,
    "lockstep": LOCKSTEP,
    "log_level": LOG_LEVEL,
}
TWO_ARMS = {
    "left_namespace": Argument("left", "namespace of the first arm"),
    "left_arm": ARM,
    "left_controller": CONTROLLER,
    "right_namespace": Argument("right", "namespace of the second arm"),
    "right_arm": ARM,
    "right_controller": CONTROLLER,
    "with_simulator": SIMULATOR,
    "with_goals": GOALS,
    "lockstep": LOCKSTEP,
    "log_level": LOG_LEVEL,
}
BESIDE_A_DRIVER = {
    "arm": ARM,
    "controller": CONTROLLER,
    "namespace": NAMESPACE,
    "autostart": AUTOSTART,
    "with_goals": GOALS,
    "driver_package": Argument("", "package of a driver to start as well; empty: it runs already"),
    "driver_executable": Argument("driver", "executable of driver_package"),
    "driver_parameters": Argument("", "parameter file of the driver, beside the controller file"),
    "log_level": LOG_LEVEL,
}
CASE_STUDY = {
    "arm": Argument("R", "arm file: a shipped name (R, P3, one_link) or a path"),
    "controller": Argument(
        "paper_composite", "controller file: a shipped name (paper_composite, paper_slow) or a path"
    ),
    "namespace": NAMESPACE,
    "simulate": SIMULATOR,
    "move": Argument("true", "publish the paper's trajectory once the controller is there", SWITCH),
}


def one_arm(values):
    """The nodes of one arm, a list of `Start`.

    Parameters
    ----------
    values : mapping
        Of the arguments `ONE_ARM`, as strings.

    Raises
    ------
    ParameterError
        For a controller file that does not exist, or a value that is not one of an argument's choices.
    """
    # Not arguments of every launch file.
    values = {"with_goals": GOALS.default, "with_shape": SHAPE.default, **values}
    check(values, ONE_ARM)
    arm, file = values["arm"] or "R", values["controller"]
    file = parameter_files.find(file) if file else parameter_files.of_arm(arm)
    common = [str(file)] if file else []
    if values["arm"]:
        common.append({"arm": values["arm"]})
    own = {"namespace": values["namespace"], "log_level": values["log_level"]}
    starts = [
        Start("flexarm_control", "observer", parameters=list(common), **own),
        Start("flexarm_control", "controller", parameters=list(common), **own),
    ]
    if is_true(values["with_simulator"]):
        # It must not start paused: nothing would unpause it.
        pace = {"lockstep": is_true(values["lockstep"]), "pause_at": -1.0}
        starts.insert(0, Start("flexarm_sim", "simulator", parameters=[*common, pace], **own))
    if is_true(values["with_goals"]):
        starts.append(Start("flexarm_control", "goals", parameters=list(common), **own))
    if is_true(values["with_shape"]):
        starts.append(Start("flexarm_bringup", "shape", parameters=list(common), **own))
    return starts


def two_arms(values):
    """The nodes of two arms, each in a namespace; see `one_arm`."""
    check(values, TWO_ARMS)
    if values["left_namespace"].strip("/") == values["right_namespace"].strip("/"):
        raise ParameterError(
            "is that of both arms: they would share their topics",
            field="left_namespace, right_namespace",
            value=values["left_namespace"],
            hint="give each arm its own",
        )
    starts = []
    for side in ("left_", "right_"):
        own = {name: values[side + name] for name in ("arm", "controller", "namespace")}
        starts += one_arm({**values, **own})
    return starts


def beside_a_driver(values):
    """Observer and controller, and the driver if its package is given; see `one_arm`."""
    check(values, BESIDE_A_DRIVER)
    starts = one_arm({**values, "with_simulator": "false", "lockstep": "false"})
    controller = next(s for s in starts if s.executable == "controller")
    controller.parameters.append({"autostart": is_true(values["autostart"])})
    if values["driver_package"]:
        driver = Start(values["driver_package"], values["driver_executable"], values["namespace"])
        driver.parameters = [*starts[0].parameters, *filter(None, [values["driver_parameters"]])]
        driver.log_level = values["log_level"]
        starts.insert(0, driver)
    return starts


def case_study(values):
    """The three nodes, and the paper's motion; see `one_arm`."""
    check(values, CASE_STUDY)
    more = {"with_simulator": values["simulate"], "lockstep": "false", "log_level": "info"}
    starts = one_arm({**values, **more, "with_goals": "false"})
    if is_true(values["move"]):
        publisher = Start("flexarm_bringup", "publish_trajectory", values["namespace"])
        publisher.arguments = ["paper", "--arm", values["arm"], "--timeout", "30"]
        starts.append(publisher)
    return starts


def is_true(text):
    """Whether a switch is on."""
    return text == "true"


def check(values, arguments):
    """Refuse a value that is not one of its argument's choices."""
    for name, argument in arguments.items():
        if argument.choices and values[name] not in argument.choices:
            limit = ", ".join(argument.choices)
            problem = "is not one of the choices"
            raise ParameterError(problem, field=name, value=values[name], limit=limit)


def description(arguments, starts):
    """A launch description of some arguments, and of the nodes that follow from their values.

    Parameters
    ----------
    arguments : mapping of str to Argument
    starts : callable
        Takes the values by name, returns a list of `Start`.
    """
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    from launch.substitutions import LaunchConfiguration

    def declared(name, argument):
        choices = {"choices": list(argument.choices)} if argument.choices else {}
        return DeclareLaunchArgument(
            name, default_value=argument.default, description=argument.description, **choices
        )

    def nodes(context):
        values = {name: LaunchConfiguration(name).perform(context) for name in arguments}
        return [node(start) for start in starts(values)]

    declarations = [declared(name, argument) for name, argument in arguments.items()]
    return LaunchDescription([*declarations, OpaqueFunction(function=nodes)])


def node(start):
    """The launch action of a `Start`."""
    from launch_ros.actions import Node

    return Node(
        package=start.package,
        executable=start.executable,
        namespace=start.namespace,
        parameters=start.parameters,
        arguments=start.arguments,
        ros_arguments=["--log-level", start.log_level],
        output="screen",
    )
