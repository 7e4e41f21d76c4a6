"""Cache of compiled kernels across processes: reused, never stale, in the first writable folder or in none."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import st_core
from st_core.backends import has_numba, numba_cache
from st_core.vehicle import VehicleParameters

pytestmark = pytest.mark.skipif(not has_numba(), reason="numba is not installed")

PROGRAM = """
import sys
import numpy as np
from pathlib import Path
from st_core.augmented import augment
from st_core.backends import numba_lanes as lanes
from st_core.effects import load_folder
from st_core.vehicle import VehicleParameters
base, effects = sys.argv[2], sys.argv[3:]
for folder in [e for e in effects if "/" in e]:
    effects += load_folder(folder)
    effects.remove(folder)
car = VehicleParameters.from_yaml(Path(sys.argv[1]).read_text())
model = augment(base, effects)
p = model.parameters(car)
w = np.array([np.full(lanes.LANES, float(f)) for f in model.inputs(0.05, 0.1, p)])
start = np.tile([[0.0], [0.0], [12.0], [0.1], [0.2], [0.3]], lanes.LANES)
out = lanes.advance(model, p, start, w, np.zeros(41, int), 0.05, np.array([20]))
kernel, = lanes._kernels.values()
print(sum(kernel.stats.cache_hits.values()), float(out[0, 5, 0]).hex(), kernel._cache.cache_path)
"""
BANKED = ("linear", "road_bank")  # base and effects


class Install:
    """An editable copy of the package with its own home folder."""

    def __init__(self, folder: Path, vehicle: VehicleParameters):
        self.package = folder / "site" / "st_core"
        shutil.copytree(Path(st_core.__file__).parent, self.package, ignore=shutil.ignore_patterns("__pycache__"))
        self.home = folder / "home"
        self.home.mkdir()
        self.car = folder / "car.yaml"
        self.car.write_text(vehicle.to_yaml())
        self.environment = {key: value for key, value in os.environ.items()
                            if key not in ("XDG_CACHE_HOME", "PYTHONPATH") and not key.startswith("NUMBA_")}

    def run(self, *model, **changes):
        """(found in the cache, result, folder of the kernel or None) of a fresh process."""
        environment = {**self.environment, "PYTHONPATH": str(self.package.parent), "HOME": str(self.home),
                       "PYTHONDONTWRITEBYTECODE": "1", **changes}
        done = subprocess.run([sys.executable, "-c", PROGRAM, str(self.car), *model], env=environment, check=True,
                              capture_output=True, text=True, cwd=self.home)
        hits, result, folder = done.stdout.split()
        return int(hits) > 0, float.fromhex(result), None if folder == "None" else Path(folder)

    def edit(self, file, old, new):
        path = self.package / file
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    def compiled_files(self):
        """Contents of all files of compiled code by path."""
        return {path: path.read_bytes() for path in self.package.parent.rglob("*.nb[ci]")}


@pytest.fixture
def install(tmp_path, leaf):
    return Install(tmp_path, leaf)


@pytest.fixture(scope="module")
def first_run(tmp_path_factory, leaf):
    """(install, output and files of its first run) of the linear model on a banked road."""
    install = Install(tmp_path_factory.mktemp("banked"), leaf)
    return install, install.run(*BANKED), install.compiled_files()


@pytest.fixture(scope="module")
def kinematic(tmp_path_factory, leaf):
    """(install, result, folder of the kernel) of the kinematic model, compiled once."""
    install = Install(tmp_path_factory.mktemp("kinematic"), leaf)
    return install, *install.run("kinematic")[1:]


@pytest.mark.slow
def test_second_process_loads_the_kernel_from_the_cache(first_run):
    install, (found, result, folder), files = first_run
    assert not found and folder.is_relative_to(install.package / "backends" / "__pycache__" / "kernels")
    assert len(files) == 2  # index and code
    assert install.run(*BANKED) == (True, result, folder)
    assert files.items() <= install.compiled_files().items()


@pytest.mark.slow
def test_every_set_of_effects_has_its_own_kernel(install):
    _, plain, _ = install.run("linear")
    found, offset, _ = install.run("linear", "steering_offset", "road_bank")
    assert not found and offset != plain
    assert install.run("linear", "steering_offset", "road_bank")[:2] == (True, offset)
    assert install.run("linear")[:2] == (True, plain)
    # The value of an effect is an argument of the kernel, not a part of it.
    install.edit("effects/steering_offset.py", "initial=", "initial=0.5 * ")
    _, halved, _ = install.run("linear", "steering_offset", "road_bank")
    assert halved not in (offset, plain)


@pytest.mark.slow
@pytest.mark.parametrize(("file", "old", "new"), [
    ("tyres.py", "return -cornering_stiffness * slip", "return -1.1 * cornering_stiffness * slip"),
    ("models/_base.py", "slip_angle(velocity_y - p.", "slip_angle(velocity_y - 1.1 * p."),
    ("tyres.py", "GRAVITY = 9.81", "GRAVITY = 9.0"),  # a constant used by the effect in another file
    ("effects/road_bank.py", "zero - GRAVITY * sin(", "zero - 2.0 * GRAVITY * sin("),
    ("composition.py", "dv_y + a_y", "dv_y - a_y"),
    ("backends/numba_lanes.py", "S2, S3 = -0.16666666666666666, ", "S2, S3 = -0.15, "),
], ids=["tyre force", "slip angle", "constant", "effect", "composition", "compiled sine"])
def test_edited_equation_or_effect_recompiles_the_kernel(first_run, file, old, new):
    install, (_, before, _), _ = first_run
    install.edit(file, old, new)
    found, after, _ = install.run(*BANKED)
    install.edit(file, new, old)
    assert not found and after != before


@pytest.mark.slow
def test_undone_edits_use_the_first_kernel(first_run):
    install, (_, before, _), _ = first_run
    install.edit("tyres.py", "GRAVITY = 9.81", "GRAVITY = 9.0")
    install.edit("tyres.py", "GRAVITY = 9.0", "GRAVITY = 9.81")
    assert install.run(*BANKED)[:2] == (True, before)


@pytest.mark.slow
def test_edited_user_effect_recompiles_the_kernel(install, tmp_path):
    folder = tmp_path / "own"
    folder.mkdir()
    source = (install.package / "effects" / "road_bank.py").read_text().replace("from ..", "from st_core.")
    source = source.replace("from ._base", "from st_core.effects").replace('"road_bank"', '"my_bank"')
    (folder / "my_bank.py").write_text(source)
    (folder / "_helper.py").write_text("")
    _, before, _ = install.run("linear", str(folder))
    assert install.run("linear", str(folder))[:2] == (True, before)
    (folder / "my_bank.py").write_text(source.replace("zero - GRAVITY * sin(", "zero - 2.0 * GRAVITY * sin("))
    found, after, _ = install.run("linear", str(folder))
    assert not found and after != before


@pytest.mark.slow
def test_read_only_package_uses_the_user_cache(install):
    # Works for root too: nobody can make a folder inside a file.
    (install.package / "backends" / "__pycache__").write_text("")
    found, result, folder = install.run("kinematic")
    assert not found and folder.is_relative_to(install.home / ".cache" / "st_core")
    assert install.run("kinematic")[:2] == (True, result)
    for variable in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        other = install.home / variable
        assert install.run("kinematic", **{variable: str(other)})[2].is_relative_to(other)


@pytest.mark.slow
def test_without_a_writable_folder_nothing_is_cached(install):
    (install.package / "backends" / "__pycache__").write_text("")
    found, _, folder = install.run("kinematic", HOME="/dev/null")
    assert not found and folder is None


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nbc", "nbi"])
def test_damaged_cache_file_is_recompiled(kinematic, kind):
    install, result, folder = kinematic
    file, = folder.glob(f"*.{kind}")
    content = file.read_bytes()
    file.write_bytes(content[:-100] if kind == "nbc" else b"")
    found, again, _ = install.run("kinematic")
    file.write_bytes(content)
    assert not found and again == result


@pytest.mark.slow
def test_cache_unused_for_long_is_deleted(kinematic):
    install, _, folder = kinematic
    recent = folder.parent  # numba adds a level
    unused = recent.parent / "old"
    unused.mkdir()
    os.utime(unused, (0, 0))
    install.run("kinematic")
    assert not unused.exists() and recent.exists()


def test_fingerprint_includes_closure_values_and_called_functions():
    def make(factor, inner):
        def outer(x):
            return factor * inner(x)
        return outer

    def double(x):
        return x + x

    def square(x):
        return x * x

    fingerprints = [numba_cache.compute_fingerprint(make(*parts))
                    for parts in ((1.0, double), (2.0, double), (1.0, square))]
    assert len(set(fingerprints)) == 3
    assert numba_cache.compute_fingerprint(make(1.0, double)) == fingerprints[0]
    assert [f.__name__ for f in numba_cache.find_reachable_functions(make(1.0, double))] == ["double", "outer"]
    with pytest.raises(numba_cache.UnhashableError):
        numba_cache.compute_fingerprint(make(object(), double))
