# SPDX-License-Identifier: Apache-2.0
"""Makes a run of the case study with simulator, observer and controller as three processes over DDS."""

import shutil

from flexarm_control.motions import profiles
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.case_study.runs import DURATION
from flexarm_studies.loop import closed_loop, parameter_files

from ..recording import recorder
from ..running import lockstep
from ..running.processes import Processes, own_domain


def start_nodes(processes, run):
    """Start the run's simulator, in lockstep and paused, observer and controller."""
    for name, parameters in (
        ("simulator", {"lockstep": True, **run.simulator}),
        ("observer", run.observer),
        ("controller", run.controller),
    ):
        parameters = parameters | recorder.keep_for_recording(name)
        processes.start_node(name, parameters, parameter_files.find(run.file))


def run_nodes(run, directory, progress=lambda fraction: None):
    """The run with simulator, observer and controller as three processes over DDS, recorded.

    Parameters
    ----------
    run : Run
    directory : Path
        For the bag and the nodes' logs.
    progress : callable
        Called with the fraction done.

    Returns
    -------
    record : Record
    timing : Timing

    Raises
    ------
    FlexarmError
        If a node fails, or the arm is lost.
    """
    with own_domain() as domain, Processes(domain, directory / "log") as processes:
        start_nodes(processes, run)
        with lockstep.LockstepRun(processes) as session:
            joints = arm_file.load(run.arm).joint_names
            start = closed_loop.TRAJECTORY_START_NS
            message = lockstep.trajectory_message(joints, profiles.paper_profile(), 101, start)
            samples, timing = session.run(message, DURATION, progress)
        codes = processes.stop()
        if any(codes.values()):
            hint = f"see the logs in {directory / 'log'}"
            raise FlexarmError(f"exit codes {codes}", field=run.name, hint=hint)
    bag = directory / "bag"
    shutil.rmtree(bag, ignore_errors=True)
    recorder.write_bag(bag, samples, run.arm)
    return recorder.to_record(samples, start, run.arm), timing
