# SPDX-License-Identifier: Apache-2.0
"""Services of the simulator node: `~/reset` and `~/pause`."""

from std_srvs.srv import SetBool, Trigger


def make(node):
    """Make the services of a `SimulatorNode`; they live until its clean-up."""

    def reset(request, response):
        response.success, response.message = True, f"session {node.reset()}"
        return response

    def pause(request, response):
        response.success, response.message = node.pause(request.data)
        return response

    node.make_service(Trigger, "~/reset", reset)
    node.make_service(SetBool, "~/pause", pause)
