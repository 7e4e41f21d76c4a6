import pytest
from ros_processes import run_processes

processes = pytest.fixture(run_processes)
