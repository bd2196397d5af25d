"""The three nodes on one arm, and the paper's motion: for a machine with ROS 2 and its `ros2 launch`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "arm": ("R", "arm file: a shipped name (R, P3, one_link) or a path"),
    "controller": (
        "paper_composite",
        "controller file: a shipped name (paper_composite, paper_slow)",
    ),
    "namespace": ("", "namespace of the three nodes, to run two arms side by side"),
    "simulate": ("true", "false: a driver of yours takes the simulator's place"),
    "move": ("true", "publish the paper's trajectory once the controller is there"),
}


def generate_launch_description():
    """Simulator in real time, observer, controller, and one trajectory."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    file = PathJoinSubstitution(
        [
            FindPackageShare("flexarm_bringup"),
            "config",
            "controllers",
            [value["controller"], ".yaml"],
        ]
    )

    def node(package, executable, **more):
        return Node(
            package=package,
            executable=executable,
            namespace=value["namespace"],
            parameters=[file, {"arm": value["arm"]}],
            output="screen",
            **more,
        )

    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            node("flexarm_sim", "simulator", condition=IfCondition(value["simulate"])),
            node("flexarm_control", "observer"),
            node("flexarm_control", "controller"),
            Node(
                package="flexarm_bringup",
                executable="publish_trajectory",
                namespace=value["namespace"],
                arguments=["paper", "--arm", value["arm"], "--timeout", "30"],
                output="screen",
                condition=IfCondition(value["move"]),
            ),
        ]
    )
