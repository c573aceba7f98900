"""The command line answers at once: help, lists and refusals import nothing large; a shell completes names."""

from __future__ import annotations

import importlib.metadata
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import call  # type: ignore[import-not-found]  # pytest puts this folder on the path

import lunar_rescue
import reproduce
from reproduce.storage.paths import ROOT

#: Calls that end without work, with their exit codes; the simulator comes only where scenes or splits are named.
AT_ONCE = [
    (["--help"], 0),
    (["--version"], 0),
    (["methods"], 0),
    (["train", "--help"], 0),
    (["evaluate", "nothing"], 2),
    (["train", "nothing", "--out", "x"], 2),
    (["train", "scripted", "--out", "x"], 2),
    (["train", "hrl_dcs", "--preset", "huge", "--out", "x"], 2),
    (["train", "hrl_dcs", "--out", "x", "--resume"], 2),
    (["replay", "scripted", "--out", "x.avi"], 2),
    (["replay", "nothing", "--out", "x.png"], 2),
    (["watch", "nothing"], 2),
    (["notebooks", "--only", "77"], 2),
    (["notebooks", "--preset", "tiny"], 2),
    (["batch", "--methods", "nothing"], 2),
    (["batch", "--until", "never"], 2),
    (["tune", "nothing"], 2),
    (["bench", "--part", "nothing"], 2),
    (["export", "nothing", "--out", "x"], 2),
    (["evaluate", "scripted", "--observation", "smell"], 2),
    (["perceive", "--help"], 0),
    (["perceive", "train", "nothing", "--out", "x"], 2),
    (["perceive", "compare", "nothing"], 2),
]
#: These need scenes, and so the environment, but nothing that learns.
WITH_SCENES = [
    (["evaluate", "scripted", "--split", "nothing"], 2),
    (["evaluate", "scripted", "--ablation", "nothing"], 2),
    (["replay", "scripted", "--out", "x.png", "--posture", "sitting"], 2),
]
LEARNING = ("torch", "stable_baselines3", "pandas", "matplotlib", "viser", "papermill", "imageio")
ENVIRONMENT = ("gymnasium", "pybullet", "scipy", "numpy")

#: Makes calls one after another in one process and prints codes and the large modules that are there by then.
MANY_CALLS = """
import json, sys
sys.path.insert(0, sys.argv[1])
from command_line import call
calls, large = json.loads(sys.argv[2])
told = []
for arguments in calls:
    answer = call(*arguments)
    told.append([answer.code, [name for name in large if name in sys.modules]])
print(json.dumps(told))
"""


@pytest.mark.process
@pytest.mark.parametrize(
    ("calls", "large"), [(AT_ONCE, LEARNING + ENVIRONMENT), (WITH_SCENES, LEARNING)], ids=["at once", "with scenes"]
)
def test_what_does_no_work_imports_nothing_large(
    calls: list[tuple[list[str], int]], large: tuple[str, ...], tmp_path: Path
) -> None:
    question = json.dumps([[arguments for arguments, _ in calls], large])
    command = [sys.executable, "-c", MANY_CALLS, str(ROOT / "tests"), question]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=True)
    for (arguments, code), told in zip(calls, json.loads(done.stdout), strict=True):
        assert told == [code, []], arguments
    assert not list(tmp_path.iterdir())


@pytest.mark.process
def test_help_takes_less_than_half_a_second_of_processor_time() -> None:
    """0.10 s on the machine that this was written on; 2.5 s where PyTorch is imported."""

    def spent() -> float:
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    before = spent()
    done = subprocess.run([sys.executable, "-m", "reproduce", "--help"], capture_output=True, text=True, check=True)
    assert spent() - before < 0.5 and "--install-completion" in done.stdout


def test_the_version_is_that_of_the_distribution() -> None:
    version = importlib.metadata.version("lunar-rescue")
    assert reproduce.__version__ == lunar_rescue.__version__ == version
    assert call("--version").out == f"lunar-rescue {version}\n"


@pytest.mark.process
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("reproduce eval", {"evaluate", "evaluate-reference"}),
        ("reproduce train fu", {"fun"}),
        ("reproduce train hrl_dcs --preset s", {"smoke"}),
        ("reproduce evaluate scripted --split te", {"test"}),
        ("reproduce bench --part t", {"training", "tests"}),
        ("reproduce watch scripted --task l", {"lift"}),
    ],
)
def test_a_shell_completes_commands_and_names(words: str, offered: set[str]) -> None:
    asked = {"_REPRODUCE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    command = [
        sys.executable,
        "-c",
        "import sys; sys.argv[0] = 'reproduce'; from reproduce.__main__ import main; main()",
    ]
    done = subprocess.run(command, env={**os.environ, **asked}, capture_output=True, text=True, timeout=60, check=True)
    assert set(done.stdout.split()) == offered


#: Builds networks as policies are loaded, lets one act, and says whether PyTorch's compiler came with them.
ACTING = """
import sys
import numpy as np
from reproduce.baselines.feudal.network import FunSpec
from reproduce.baselines.sac import SacSpec
from reproduce.learning.networks import Memory, NetworkSpec
FunSpec(3, 2, 16, 8, 2, 5).build(), SacSpec(3, 2, 16).build()
print(Memory(NetworkSpec(3, 2, 16, True).build(), 1).act(np.ones((1, 3), np.float32), np.array([0])).shape)
print("torch._dynamo" in sys.modules)
"""


@pytest.mark.process
def test_a_policy_is_loaded_and_acts_without_pytorch_s_compiler() -> None:
    """An optimiser brings it, which takes a second and 100 MB in each worker."""
    done = subprocess.run([sys.executable, "-c", ACTING], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.splitlines() == ["(1, 2)", "False"]
