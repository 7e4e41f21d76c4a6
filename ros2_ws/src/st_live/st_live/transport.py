"""Which way the nodes talk to each other: on this machine only, and not over shared memory."""

from collections.abc import Mapping

from st_recordings.paths import config

RANGE, PROFILES, RMW = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE", "RMW_IMPLEMENTATION"


def loopback(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables to add to `environment` so that all nodes started with them stay on the loopback interface.

    For Fast DDS that is a profile (config/dds/loopback.xml). The range LOCALHOST, which does the same for any
    middleware, would bring back the shared memory over which a node started again after `kill -9` may stay deaf
    (docs/manual/reliability.md, Transport). Another middleware gets it, and so does who has a profile of his own.
    """
    own = str(config("dds/loopback.xml"))
    if environment.get(PROFILES, own) != own or not environment.get(RMW, "rmw_fastrtps_cpp").startswith("rmw_fastrtps"):
        return {RANGE: "LOCALHOST"}
    return {RANGE: "SYSTEM_DEFAULT", PROFILES: own}
