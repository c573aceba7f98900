"""The environment behaves the same whatever the process around it: locale, threads, missing streams."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

#: A rough scene with rocks, stepped and seen; prints a digest of all that.
EPISODE = """
import hashlib, locale, sys
import numpy as np
if len(sys.argv) > 1:
    locale.setlocale(locale.LC_ALL, "")
    assert locale.localeconv()["decimal_point"] == ",", locale.localeconv()
from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.physics import bodies
bodies.WORLD_LIFE = 1
env = LunarRescueEnv(render_mode="rgb_array")
scenes = [s for s in map(sample_scene, range(60)) if s.terrain.rough and len(s.rocks) > 2][:2]
digest = hashlib.sha256()
for scene in scenes:
    digest.update(env.reset_flat(options={"scene": scene})[0].tobytes())
    for step in range(15):
        digest.update(env.step_flat(np.full(11, 0.1 * (step % 5) - 0.2))[0].tobytes())
    digest.update(env.render().tobytes())
print(env.robot.lower.round(3).tolist()[:2], digest.hexdigest())
if len(sys.argv) > 1:
    assert locale.localeconv()["decimal_point"] == ","
"""


def _run(code: str, *arguments: str, **surroundings: str) -> str:
    ran = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **surroundings},
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.process
def test_a_decimal_comma_changes_nothing(tmp_path: Path) -> None:
    if shutil.which("localedef") is None:
        pytest.skip("no localedef to make a German locale with")
    german = ["localedef", "-i", "de_DE", "-f", "UTF-8", str(tmp_path / "de_DE.UTF-8")]
    if subprocess.run(german, capture_output=True, check=False).returncode > 1:
        pytest.skip("no German locale can be made here")
    plain = _run(EPISODE)
    assert plain.startswith("[-1.745, -0.436]")
    assert _run(EPISODE, "german", LOCPATH=str(tmp_path), LC_ALL="de_DE.UTF-8") == plain


def test_limits_that_were_read_wrong_are_refused_by_name() -> None:
    code = """
import contextlib, numpy as np
from lunar_rescue.physics import robot
from lunar_rescue.physics.bullet import BulletSimulation
table = BulletSimulation.joint_table
BulletSimulation.joint_table = lambda *a: [(*r[:3], float(int(r[3])), *r[4:]) for r in table(*a)]
try:
    robot.Robot(BulletSimulation())
except RuntimeError as error:
    print(error)
"""
    assert "joint 'A_shoulder_pitch': expected limits [" in _run(code)


@pytest.mark.process
def test_environments_made_in_threads_leave_stdout_alone() -> None:
    code = """
import os, threading
from lunar_rescue import LunarRescueEnv
before = os.fstat(1)
def make():
    for _ in range(3):
        LunarRescueEnv().close()
threads = [threading.Thread(target=make) for _ in range(4)]
[t.start() for t in threads]
[t.join() for t in threads]
assert os.path.samestat(before, os.fstat(1))
print("still here")
"""
    assert _run(code).strip() == "still here"


@pytest.mark.process
@pytest.mark.parametrize("closed", ["sys.stdout = sys.stderr = None", "sys.stdout.close()", "os.close(1); os.close(2)"])
def test_closed_streams_are_met(closed: str, tmp_path: Path) -> None:
    code = f"""
import os, sys
{closed}
from lunar_rescue import LunarRescueEnv
env = LunarRescueEnv()
env.reset_flat(seed=0)
env.close()
open(sys.argv[1], "w").write("done")
os._exit(0)
"""
    _run(code, str(tmp_path / "answer"))
    assert (tmp_path / "answer").read_text() == "done"


@pytest.mark.process
def test_workers_start_without_a_home_and_with_a_long_temporary_folder(tmp_path: Path) -> None:
    """The path of a socket has 107 characters at most, and the fork server's lies in TMPDIR."""
    folder = tmp_path / ("long" * 50)
    folder.mkdir()
    code = (
        "import os; from reproduce.experiments.evaluate import rescue_scenes\n"
        "del os.environ['HOME']\n"
        "if __name__ == '__main__':\n"
        "    print([row['seed'] for row in rescue_scenes('random', 2, workers=2, quiet=True)])"
    )
    assert _run(code, TMPDIR=str(folder)) == "[0, 1]\n"
    assert not list(folder.iterdir())
