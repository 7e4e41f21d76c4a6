"""Transport between the nodes: the loopback interface, no shared memory."""

from collections.abc import Mapping

from st_recordings.paths import config

RANGE, PROFILES, RMW = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE", "RMW_IMPLEMENTATION"


def loopback(environment: Mapping[str, str]) -> dict[str, str]:
    """Variables to add to `environment` so that all nodes started with them stay on the loopback interface.

    For Fast DDS that is a profile (config/dds/loopback.xml). The range LOCALHOST, which has the same effect for any
    middleware, would enable shared memory, over which a node restarted after `kill -9` may receive nothing
    (docs/manual/reliability.md, Transport). It is used for other middleware, and with a profile of the user.
    """
    own = str(config("dds/loopback.xml"))
    if environment.get(PROFILES, own) != own or not environment.get(RMW, "rmw_fastrtps_cpp").startswith("rmw_fastrtps"):
        return {RANGE: "LOCALHOST"}
    return {RANGE: "SYSTEM_DEFAULT", PROFILES: own}
