"""Whatever is in a policy or a checkpoint that somebody else made: one line that names file and fault."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch as th
from command_line import call  # type: ignore[import-not-found]  # pytest puts this folder on the path
from safetensors.torch import load_file, save_file
from untrained import untrained_policy  # type: ignore[import-not-found]  # pytest puts this folder on the path

from reproduce.experiments.methods import METHODS, load_policy
from reproduce.experiments.presets import PRESETS
from reproduce.storage import checkpoint
from reproduce.storage.checkpoint import Progress, load_checkpoint, save_checkpoint
from reproduce.storage.errors import UserError
from reproduce.storage.paths import COMMITTED
from reproduce.storage.records import from_dict, to_dict

REFERENCE = COMMITTED / "reference"
NESTED = "[" * 900 + "]" * 900

#: Where in ``policy.json``, what as JSON, and words of the message.
ODD: list[tuple[str, str, str]] = [
    ("", "[]", "expected an object"),
    ("", "null", "expected an object"),
    ("", '"policy"', "expected an object"),
    ("", NESTED, "policy.json"),
    ("", '{"a": ' * 900 + "1" + "}" * 900, "policy.json"),
    ("", "9" * 5000, "policy.json"),
    ("", "{", "not readable as JSON"),
    ("format", "true", "format 1"),
    ("format", "2", "format 1"),
    ("format", "[1]", "format 1"),
    ("environment_version", '"1.0"', "environment_version: expected 2.0, got '1.0'; train it anew"),
    ("environment_version", "null", "environment_version: expected 2.0, got None"),
    ("method", "null", "method: expected a string"),
    ("method", "[]", "method: expected a string"),
    ("method", '"magic"', "method: expected one of"),
    ("method", '"planner"', "method: expected one of"),
    ("networks", "[]", "networks: expected an object"),
    ("networks", "{}", "networks: expected ['lln', 'sgn']"),
    ("networks", '{"sgn": 1}', "networks: expected ['lln', 'sgn']"),
    ("networks.sgn", "[]", "networks.sgn: expected"),
    ("networks.sgn", NESTED, "networks.sgn"),
    ("networks.sgn.hidden_units", "1e400", "hidden_units: expected a valid integer"),
    ("networks.sgn.hidden_units", "NaN", "hidden_units: expected"),
    ("networks.sgn.hidden_units", "128.0", "hidden_units: expected a valid integer"),
    ("networks.sgn.hidden_units", "true", "hidden_units: expected a valid integer"),
    ("networks.sgn.hidden_units", '"128"', "hidden_units: expected a valid integer"),
    ("networks.sgn.hidden_units", "0", "hidden_units: expected greater than or equal to 1, got 0"),
    ("networks.sgn.hidden_units", "-1", "hidden_units: expected greater than or equal to 1"),
    ("networks.sgn.hidden_units", "5000", "hidden_units: expected less than or equal to 4096"),
    ("networks.sgn.hidden_units", "9" * 400, "hidden_units: expected"),
    ("networks.sgn.hidden_units", "64", "policy.safetensors: sgn."),
    ("networks.sgn.bounded_mean", "1", "bounded_mean: expected a valid boolean"),
    ("networks.sgn.layers", "2", "networks.sgn.layers: unknown field"),
    ("mirror", "1", "mirror: expected a valid boolean"),
    ("set_point_changes", "null", "set_point_changes: expected a valid boolean"),
    ("interval", "0", "interval: expected greater than or equal to 1, got 0"),
    ("interval", "5.5", "interval: expected a valid integer, got 5.5"),
    ("interval", "[5]", "interval: expected a valid integer"),
    ("interval", "9" * 400, "interval: expected"),
    ("goals", "{}", "goals.frame: missing"),
    ("goals", "[0.25]", "goals: expected"),
    ("goals.frame", '"world"', "goals.frame: expected"),
    ("goals.reach", "NaN", "goals.reach: expected a finite number"),
    ("goals.reach", "Infinity", "goals.reach: expected"),
    ("goals.reach", "-0.25", "goals.reach: expected greater than or equal to 0.001"),
    ("goals.reach", "1e300", "goals.reach: expected less than or equal to 10"),
    ("goals.reach", "9" * 400, "goals.reach: expected"),
    ("goals.reach", '"far"', "goals.reach: expected a valid number, got 'far'"),
    ("goals.damping", "0", "goals.damping: expected greater than or equal to 0.001"),
    ("goals.furthest", "[1, 2]", "goals.furthest: expected"),
    ("goals.tempo", "1", "goals.tempo: unknown field"),
    ("joint_step", "0", "joint_step: expected a valid boolean"),
    ("remark", '"mine"', "remark: unknown field"),
]  # fmt: skip


def policy(folder: Path, method: str = "hrl_dcs") -> Path:
    """Make an untrained policy of a method."""
    return untrained_policy(method, folder / method)


def with_text(path: Path, where: str, text: str) -> None:
    """Put a JSON text at a place of a JSON file."""
    raw = json.loads(path.read_text())
    inner = raw
    *parents, last = where.split(".") if where else [""]
    for name in parents:
        inner = inner[name]
    inner[last] = "PLACE"
    path.write_text(json.dumps(raw).replace('"PLACE"', text) if where else text)


def complaint(folder: Path) -> str:
    with pytest.raises(UserError) as error:
        load_policy(folder)
    assert "\n" not in str(error.value) and len(str(error.value)) < 500
    return str(error.value)


def test_odd_policy_descriptions_are_refused_in_one_line(tmp_path: Path) -> None:
    run = policy(tmp_path)
    path = run / "policy.json"
    whole = path.read_text()
    for where, text, words in ODD:
        with_text(path, where, text)
        assert words in (said := complaint(run)), (where, text[:40], said)
        assert said.startswith(str(run))
        path.write_text(whole)
    for name in [*json.loads(whole), "networks.lln.actions", "goals.reach"]:
        raw = inner = json.loads(whole)
        *parents, last = name.split(".")
        for parent in parents:
            inner = inner[parent]
        del inner[last]
        path.write_text(json.dumps(raw))
        assert last in complaint(run)
    path.write_bytes(b"\xff\xfe\x00")
    assert "policy.json" in complaint(run)


@pytest.mark.process
@pytest.mark.parametrize("method", ["fun", "sac", "ppo_lstm"])
def test_odd_descriptions_of_other_methods_are_refused_too(method: str, tmp_path: Path) -> None:
    run = policy(tmp_path, method)
    path = run / "policy.json"
    whole = path.read_text()
    (level,) = json.loads(whole)["networks"]
    for field in json.loads(whole)["networks"][level]:
        for text in ("null", "[]", "NaN", "-3", "9" * 400, "{}", '"x"'):
            with_text(path, f"networks.{level}.{field}", text)
            assert f"networks.{level}.{field}: expected" in complaint(run)
            path.write_text(whole)
    with_text(path, "interval", "5")
    assert "interval: unknown field" in complaint(run)


def test_odd_weights_are_refused_in_one_line(tmp_path: Path) -> None:
    run = policy(tmp_path)
    path = run / "policy.safetensors"
    whole, tensors = path.read_bytes(), {name: tensor.clone() for name, tensor in load_file(path).items()}
    for data in (b"", b"\x00", whole[:7], whole[:100], whole[:-1], whole[8:], b"\xff" * 8 + whole[8:], b"{}" * 50):
        path.write_bytes(data)
        assert "not a readable safetensors file" in complaint(run)
    odd = {
        "lln.log_std": [th.full((11,), th.nan), th.full((11,), th.inf), th.zeros(11, 1), th.zeros(11).double(),
                        th.zeros(11, dtype=th.int64), th.zeros(11).to(th.bfloat16), th.zeros(0)],
        "sgn.extra": [th.zeros(1)],
    }  # fmt: skip
    for name, values in odd.items():
        for value in values:
            save_file({**tensors, name: value}, path)
            assert name in complaint(run)
    path.unlink()
    assert "weights are missing" in complaint(run)
    path.mkdir()
    assert "policy.safetensors" in complaint(run)


def test_the_command_says_so_and_ends_with_code_2(tmp_path: Path) -> None:
    run = policy(tmp_path)
    with_text(run / "policy.json", "goals.reach", "1e300")
    done = call("evaluate", str(run), "--tests", "1")
    assert done.code == 2 and "goals.reach: expected less than or equal to 10, got 1e+300" in done.complaint


class Learner:
    """What a checkpoint keeps of a learner, without one."""

    def state_tensors(self) -> dict[str, th.Tensor]:
        return {"weight": th.ones(3)}

    def state_numbers(self) -> dict[str, Any]:
        return {"rate": 0.5}

    def load_state(self, tensors: dict[str, th.Tensor], numbers: dict[str, Any]) -> None:
        th.zeros(3).copy_(tensors["weight"])
        float(numbers["rate"])


CONFIG = {"training": {"steps": 512, "low": {"gamma": 0.99}}}


def test_odd_checkpoints_are_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "checkpoint.safetensors"
    learners = {"level": Learner()}

    def refused(config: dict[str, Any] = CONFIG) -> str:
        with pytest.raises(UserError) as error:
            load_checkpoint(tmp_path, learners, config)
        assert "\n" not in str(error.value) and str(path) in str(error.value)
        return str(error.value)

    save_checkpoint(tmp_path, learners, Progress(1, 16, 2.5), CONFIG)
    assert load_checkpoint(tmp_path, learners, CONFIG) == Progress(1, 16, 2.5)
    other = {"training": {"steps": 2048, "low": {"gamma": 0.99}}}
    assert refused(other).endswith("was made with another configuration: training.steps was 512, is 2048")

    whole = path.read_bytes()
    for data in (b"", whole[:50], whole[:-1], whole[8:]):
        path.write_bytes(data)
        refused()
    path.write_bytes(whole)
    with checkpoint.safe_open(path, framework="pt") as file:
        meta = json.loads(file.metadata()["meta"])
    tensors = {name: tensor.clone() for name, tensor in load_file(path).items()}
    odd: list[tuple[str, Any]] = [
        ("version", 2), ("version", None), ("config", None), ("config", []), ("progress", None), ("progress", []),
        ("progress", {"update": 1}), ("progress", {"update": -1, "steps": 16, "seconds": 2.5}),
        ("progress", {"update": 1, "steps": "many", "seconds": 2.5}),
        ("progress", {"update": 1, "steps": 16, "seconds": float("nan")}),
        ("progress", {"update": 1, "steps": 1.5, "seconds": 2.5}), ("learners", None), ("learners", {}),
        ("learners", {"level": []}), ("learners", {"level": {"rate": None}}), ("learners", {"level": {"rate": [1]}}),
        ("numpy_rng", None), ("numpy_rng", ["MT19937"]), ("numpy_rng", ["other", 1, 0, 0.0]),
        ("numpy_rng", ["MT19937", 10**30, 0, 0.0]),
    ]  # fmt: skip
    for name, value in odd:
        save_file(tensors, path, metadata={"meta": json.dumps({**meta, name: value})})
        refused()
    for text in ("", "[]", "null", "1", NESTED, "{" * 3000, "9" * 5000):
        save_file(tensors, path, metadata={"meta": text})
        assert "not a checkpoint of version" in refused()
    for name, value in (("level.weight", th.full((3,), th.nan)), ("level.weight", th.ones(2, 2)),
                        ("torch_rng", th.zeros(3)), ("numpy_rng", th.zeros(3, dtype=th.int64))):  # fmt: skip
        save_file({**tensors, name: value}, path, metadata={"meta": json.dumps(meta)})
        refused()
    del tensors["level.weight"]
    save_file(tensors, path, metadata={"meta": json.dumps(meta)})
    assert "weight" in refused()


@pytest.mark.parametrize("name", sorted(path.parent.parent.name for path in REFERENCE.glob("*/seed0/config.json")))
def test_the_reference_runs_say_how_they_were_trained_and_how_they_act(name: str) -> None:
    folder, method = REFERENCE / name / "seed0", METHODS[name]
    described = json.loads((folder / "config.json").read_text())
    config: Any = from_dict(method.kind, described["training"], "training.")
    assert to_dict(config) == described["training"] and described["environment_version"] == "2.0"
    acts = json.loads((folder / "policy.json").read_text())
    assert {key: acts[key] for key in to_dict(config.policy)} == to_dict(config.policy)


def test_what_a_preset_says_is_a_field_of_some_method() -> None:
    known = {field for method in METHODS.values() for field in vars(method.config("laptop"))}
    assert {where.split(".")[0] for preset in PRESETS.values() for where in preset} <= known
