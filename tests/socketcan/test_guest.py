"""Runs the tests marked `socketcan` in a User-Mode Linux guest if the kernel of this machine has no CAN."""

import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from support import ROOT

HERE = Path(__file__).parent
NO_PACKAGE, NO_START = 69, 70  # exit statuses of uml.sh
TIMEOUT = 900  # s


@pytest.mark.slow
@pytest.mark.timing("a node in a slow guest follows frames at 100 Hz")
@pytest.mark.timeout(TIMEOUT + 60)
def test_socketcan_tests_pass_in_a_guest_with_can(no_can, tmp_path):
    if not no_can:
        pytest.skip("this kernel has CAN: the socketcan tests run on it directly")
    if not shutil.which("apt-get") and not shutil.which("linux.uml"):
        pytest.skip("User-Mode Linux is not installed, and there is no apt-get to download it")
    guest = [HERE / "uml.sh", "-c", ROOT / ".st" / "uml", "-o", tmp_path, "-t", str(TIMEOUT)]
    tests = [sys.executable, "-m", "pytest", "-q", "-m", "socketcan", "-p", "no:cacheprovider", "--durations=8", HERE,
             "--basetemp=/run/pytest", f"--junitxml={tmp_path}/results.xml"]
    run = subprocess.run([*guest, *tests], cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode in (NO_PACKAGE, NO_START):
        pytest.skip(run.stderr.strip().splitlines()[-1])
    assert run.returncode == 0, f"{run.stdout[-6000:]}\n{run.stderr[-2000:]}"
    results = ElementTree.parse(tmp_path / "results.xml").getroot().find("testsuite")
    counts = {name: int(results.get(name)) for name in ("tests", "failures", "errors", "skipped")}
    print(f"{counts['tests']} tests in {float(results.get('time')):.0f} s in the guest")
    assert counts["tests"] >= 40
    assert counts["failures"] == counts["errors"] == counts["skipped"] == 0
