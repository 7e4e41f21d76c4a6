import pytest
from ros_processes import refusing_node, run_processes

processes, refuse = pytest.fixture(run_processes), pytest.fixture(refusing_node)
