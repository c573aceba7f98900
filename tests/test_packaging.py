"""What is installed from a wheel works without a checkout, and every import is declared."""

from __future__ import annotations

import ast
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterable
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from untrained import untrained_policy  # type: ignore[import-not-found]  # pytest puts this folder on the path

from reproduce.storage.paths import ROOT

PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input", "-q"]


def run(command: list[str], folder: Path, **environment: str) -> str:
    """Run a command in a folder with nothing of this checkout around it; return what it prints."""
    surroundings = {"PATH": "/usr/bin:/bin", "HOME": str(folder), "OMP_NUM_THREADS": "1", **environment}
    done = subprocess.run(command, cwd=folder, env=surroundings, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of what is built from, as building writes beside it."""
    folder = tmp_path_factory.mktemp("packaging") / "source tree"
    for name in ("envs", "reproduce"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "requirements.lock", "environment.yml"):
        shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture(scope="module")
def wheel(source: Path) -> Path:
    offline = ["--no-deps", "--no-build-isolation", "--no-index"]
    run([*PIP, "wheel", *offline, "-w", str(source.parent), str(source)], source.parent)
    (built,) = source.parent.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """Return a folder with the packages and nothing else; their dependencies are those of this Python."""
    bare = wheel.parent / "bare folder"
    run([*PIP, "install", "--no-deps", "--no-index", "--target", str(bare), str(wheel)], wheel.parent)
    return bare


@pytest.mark.process
def test_a_wheel_holds_every_module_and_data_file(source: Path, wheel: Path) -> None:
    roots = {"lunar_rescue": source / "envs", "reproduce": source}
    files = {p.relative_to(root).as_posix() for n, root in roots.items() for p in (root / n).rglob("*") if p.is_file()}
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert packed == files
    assert {"reproduce/experiments/workflow/Snakefile", "lunar_rescue/data/robot.urdf"} <= packed


@pytest.mark.process
@pytest.mark.timeout(300)
def test_an_installed_wheel_works_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    def reproduce(*arguments: str) -> str:
        command = [sys.executable, str(installed / "bin" / "reproduce"), *arguments]
        return run(command, tmp_path, PYTHONPATH=str(installed))

    before = sorted(installed.iterdir())
    assert "evaluate" in reproduce("--help")
    untrained_policy("hrl_dcs", tmp_path / "shipped policy")
    assert re.search(r"hrl_dcs: \d of 4 rescued", reproduce("evaluate", "shipped policy", "--tests", "4"))
    (tmp_path / "notebooks").mkdir()
    shutil.copy(ROOT / "notebooks" / "02_reward_design.ipynb", tmp_path / "notebooks")
    reproduce("notebooks", "--preset", "smoke", "--only", "02", "--no-report")
    assert (tmp_path / "results" / "notebooks" / "02_reward_design.ipynb").is_file()
    assert sorted(installed.iterdir()) == before, "nothing is written beside the packages"


def snippets(page: str) -> list[str]:
    """Return the Python of a page, as it stands there."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(scope="module")
def with_policy(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder in which the README's command has trained the policy that its snippets load."""
    folder = tmp_path_factory.mktemp("snippets")
    (command,) = set(
        re.findall(r"`reproduce (train \S+ --preset smoke --out runs/first)`", (ROOT / "README.md").read_text())
    )
    short = ["--steps", "512"]  # the preset's take a quarter of a minute, and nobody asks what was learnt
    program = [sys.executable, str(installed / "bin" / "reproduce")]
    run([*program, *command.split(), *short], folder, PYTHONPATH=str(installed))
    return folder


#: Runs each program that it is given as ``python -c`` would, in a process of its own; they are forked from one that has
#: imported what is large and not ours, which takes each of them longer than what it does. Prints what each one printed.
ONE_BY_ONE = """
import json, os, sys
import torch, stable_baselines3

def run(text):
    exec(compile(text, "<string>", "exec"), {"__name__": "__main__"})
    sys.stdout.flush()

said = []
for text in json.loads(sys.argv.pop()):
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.dup2(writing, 1)
        os.close(reading), os.close(writing)
        run(text)
        sys.exit()
    os.close(writing)
    with open(reading, encoding="utf-8") as pipe:
        said.append(pipe.read())
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code == 0, f"code {code}: {text}"
print(json.dumps(said))
"""


@pytest.mark.process
@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", ["README.md", "docs/library.md", "docs/learners.md"])
def test_snippets_run_as_they_stand_in_an_empty_folder(page: str, installed: Path, with_policy: Path) -> None:
    if page == "docs/library.md":
        command = [sys.executable, str(installed / "bin" / "reproduce")]
        commands = re.findall(r"```\nreproduce (.*)\n```", (ROOT / page).read_text(encoding="utf-8"))
        assert [
            run([*command, *c.split()], with_policy, PYTHONPATH=str(installed)).count(": written") for c in commands
        ] == [2]
    programs = [sys.executable, "-c", ONE_BY_ONE, json.dumps(snippets(page))]
    said = json.loads(run(programs, with_policy, PYTHONPATH=str(installed)))
    if page == "README.md":
        assert re.fullmatch(r"[a-z_]+ (rescued|failed by [a-z_]+)\n", said[0])
        assert len(said) == 2 and all(len(text.splitlines()) <= 12 for text in snippets(page))
    if page == "docs/library.md":
        assert re.fullmatch(r"(True|False) (None|[a-z_]+)\n", said[0])
        assert re.fullmatch(r"(\d+ (lift|turn_over) \w+ (True|False) \w+ \d+\n){3}", said[1])
        assert said[3] == "(1, 11) ['environment_version', 'level', 'method', 'policy']\n"
        assert re.fullmatch(r"return -?[\d.]+, standard deviation [\d.]+\n", said[2])
    if page != "docs/library.md":
        with zipfile.ZipFile(with_policy / "ppo.zip") as model:
            assert "policy.pth" in model.namelist()
        assert all("set_num_threads(1)" in text for text in snippets(page) if "PPO" in text)


def _imports(folder: Path) -> set[str]:
    """Return the top-level names that the modules of a folder import, inside functions too."""
    names: set[str] = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                names.add(node.module)
    return {name.split(".")[0] for name in names} - set(sys.stdlib_module_names)


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements(*extras: str) -> list[str]:
    """Return what the project requires with some extras, by the distributions' names; extras may name others."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = project["dependencies"] + [line for extra in extras for line in project["optional-dependencies"][extra]]
    more = [name for line in lines if (own := re.match(r"lunar-rescue\[(.*)\]", line)) for name in own[1].split(",")]
    return [_normal(re.split(r"[<>=!~\[; ]", line)[0]) for line in lines] + (requirements(*more) if more else [])


@pytest.mark.parametrize(
    ("folders", "extras"),
    [
        (("envs",), ("report", "mujoco")),
        (("envs", "reproduce"), ("all", "peers")),
        (("tests", "examples"), ("all", "dev", "peers")),
    ],
)
def test_every_import_is_declared(folders: tuple[str, ...], extras: tuple[str, ...]) -> None:
    declared = set(requirements(*extras))
    distributions = importlib.metadata.packages_distributions()
    ours = {"lunar_rescue", "reproduce"} | {path.stem for path in (ROOT / "tests").glob("*.py")}
    missing = {
        name
        for folder in folders
        for name in _imports(ROOT / folder) - ours
        if not {_normal(distribution) for distribution in distributions.get(name, [name])} & declared
    }
    assert not missing


def test_the_lock_holds_a_version_of_every_dependency() -> None:
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").split()
    names = [line.split("==")[0] for line in lines]
    assert names == sorted(names) and all(line.count("==") == 1 for line in lines)
    assert set(requirements("all", "dev")) - {"lunar-rescue"} <= {_normal(name) for name in names}


def closure(names: Iterable[str]) -> set[str]:
    """Return distributions and all that they require without extras, as they are installed here."""
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        name = _normal(waiting.pop())
        if name not in found:
            found.add(name)
            for line in map(Requirement, importlib.metadata.requires(name) or []):
                waiting += [line.name] if line.marker is None or line.marker.evaluate({"extra": ""}) else []
    return found


@pytest.fixture(scope="module")
def environment_alone(installed: Path) -> Path:
    """Return a folder of links to what ``pip install .`` brings without extras, and to nothing else."""
    folder = installed.parent / "environment alone"
    folder.mkdir()
    for name in closure(requirements()):
        files = importlib.metadata.files(name) or []
        for top in {file.parts[0] for file in files} - {"..", "__pycache__"}:
            path = Path(str(importlib.metadata.distribution(name).locate_file(top)))
            if not (folder / top).exists():
                (folder / top).symlink_to(path)
    return folder


@pytest.mark.process
def test_the_environment_alone_works_and_the_rest_names_its_extra(
    installed: Path, environment_alone: Path, tmp_path: Path
) -> None:
    def python(*arguments: str) -> subprocess.CompletedProcess[str]:
        surroundings = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "OMP_NUM_THREADS": "1"}
        surroundings["PYTHONPATH"] = os.pathsep.join(map(str, (installed, environment_alone)))
        command = [sys.executable, "-S", *arguments]  # -S: nothing of this Python's own site-packages
        return subprocess.run(command, cwd=tmp_path, env=surroundings, capture_output=True, text=True, timeout=120)

    assert python("-c", "import torch").returncode == 1, "this Python's packages are in the way"
    text = """
import gymnasium, lunar_rescue
env = gymnasium.make("LunarRescue-v0", render_mode="rgb_array")
env.reset(seed=0)
print(len(env.step(env.action_space.sample())), env.render().ndim)
"""
    assert python("-W", "ignore", "-c", text).stdout.split()[-2:] == ["5", "3"]
    command = str(installed / "bin" / "reproduce")
    assert "evaluate" in python(command, "--help").stdout and "hrl_dcs" in python(command, "methods").stdout
    for arguments, module, extra in (
        (["train", "hrl_dcs", "--preset", "smoke", "--out", "x"], "pandas", "learning"),
        (["evaluate", "scripted", "--tests", "2"], r"\w+", "learning"),
        (["claims"], "yaml", "report"),
    ):
        done = python(command, *arguments)
        (line,) = done.stderr.splitlines()
        assert done.returncode == 2, line
        wanted = rf"reproduce: this needs {module}, which is not installed: pip install 'lunar-rescue\[{extra}\]'"
        assert re.fullmatch(wanted, line)
    assert not (tmp_path / "x").exists()


@pytest.mark.process
def test_pip_takes_what_conda_hands_to_it(source: Path) -> None:
    """Conda writes the pip lines of environment.yml to a file beside it and starts ``pip install -r`` there."""
    environment = yaml.safe_load((source / "environment.yml").read_text(encoding="utf-8"))
    (lines,) = [part["pip"] for part in environment["dependencies"] if isinstance(part, dict)]
    (source / "condaenv.requirements.txt").write_text("\n".join(lines), encoding="utf-8")
    offline = ["--dry-run", "--no-deps", "--no-build-isolation", "--no-index"]
    run([*PIP, "install", *offline, "-r", "condaenv.requirements.txt"], source)
