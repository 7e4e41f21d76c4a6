"""How our nodes talk to each other."""

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(("given", "used"), [(None, "UDPv4"), ("LARGE_DATA", "LARGE_DATA")])
def test_nodes_talk_by_udp_unless_told_otherwise(given, used):
    environment = {k: v for k, v in os.environ.items() if k != "FASTDDS_BUILTIN_TRANSPORTS"}
    if given:
        environment["FASTDDS_BUILTIN_TRANSPORTS"] = given
    code = "import os, st_ros.spin; print(os.environ['FASTDDS_BUILTIN_TRANSPORTS'])"
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert said.stdout.strip() == used
