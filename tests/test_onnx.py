"""Exported networks put out what PyTorch's do, step by step, with their memories and for any number of environments."""

from __future__ import annotations

import builtins
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch as th
from command_line import call  # type: ignore[import-not-found]  # pytest puts this folder on the path
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from untrained import untrained_policy  # type: ignore[import-not-found]

from reproduce.experiments.methods import load_policy
from reproduce.learning.networks import Memory

Floats = NDArray[np.float32]
STEPS, COUNT, BEGINS = 14, 3, 6  # more steps than FuN's horizon of 10; environment 1 begins anew at step BEGINS
LEVELS = {"hrl_dcs": ("sgn", "lln"), "ppo_lstm": ("policy",), "fun": ("fun",), "sac": ("actor",)}


def shaken_policy(method: str, run: Path) -> Path:
    """Make a run folder whose weights and statistics are drawn, as before any training many are 0 or 1."""
    untrained_policy(method, run)
    generator = th.Generator().manual_seed(3)
    tensors = load_file(run / "policy.safetensors")
    for name, tensor in tensors.items():
        noise = 0.1 * th.randn(tensor.shape, generator=generator)
        tensors[name] = tensor + (noise.abs() if name.endswith(("variance", "count")) else noise)
    save_file(tensors, run / "policy.safetensors")
    return run


def recurrent(network: Any) -> Callable[[Floats, NDArray[np.bool_]], Floats]:
    memory = Memory(network, COUNT)

    def act(observations: Floats, starts: NDArray[np.bool_]) -> Floats:
        memory.forget(starts)
        return memory.act(observations, np.arange(COUNT))

    return act


def feudal(network: Any) -> Callable[[Floats, NDArray[np.bool_]], Floats]:
    memory = network.empty_memory(COUNT)

    def act(observations: Floats, starts: NDArray[np.bool_]) -> Floats:
        memory.forget(th.from_numpy(starts))
        actions: Floats = network.step(th.from_numpy(observations), memory, deterministic=True).actions.numpy()
        return actions

    return act


def feed_forward(actor: Any) -> Callable[[Floats, NDArray[np.bool_]], Floats]:
    def act(observations: Floats, starts: NDArray[np.bool_]) -> Floats:
        with th.no_grad():
            actions: Floats = actor(th.from_numpy(observations), deterministic=True).numpy()
        return actions

    return act


def exported(path: Path) -> tuple[Callable[[Floats, NDArray[np.bool_]], Floats], dict[str, str]]:
    """Return a network that ONNX Runtime runs, as somebody without PyTorch would use it, and its metadata."""
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    wanted = [i for i in session.get_inputs() if i.name != "observation"]
    kinds = {"tensor(float)": np.float32, "tensor(int64)": np.int64}
    memory = {
        i.name: np.zeros([COUNT if isinstance(size, str) else size for size in i.shape], kinds[i.type]) for i in wanted
    }
    axes = {i.name: next(axis for axis, size in enumerate(i.shape) if isinstance(size, str)) for i in wanted}

    def act(observations: Floats, starts: NDArray[np.bool_]) -> Floats:
        for name, part in memory.items():
            np.moveaxis(part, axes[name], 0)[starts] = 0
        action, *after = session.run(None, {"observation": observations, **memory})
        memory.update({name: part.copy() for name, part in zip(memory, after, strict=True)})
        return np.asarray(action)

    return act, session.get_modelmeta().custom_metadata_map


@pytest.mark.process
@pytest.mark.parametrize("method", LEVELS)
def test_an_exported_network_puts_out_the_same_over_many_steps(method: str, tmp_path: Path) -> None:
    run, out = shaken_policy(method, tmp_path / "run"), tmp_path / "for others"
    done = call("onnx", str(run), "--out", str(out))
    assert done.code == 0 and done.err == "", done.err
    assert {path.name for path in out.iterdir()} == {f"{level}.onnx" for level in LEVELS[method]} | {"policy.json"}
    policy: Any = load_policy(run)[1]
    networks = policy.networks if method == "hrl_dcs" else [policy.network]
    kind = {"fun": feudal, "sac": feed_forward}.get(method, recurrent)
    described = json.loads((run / "policy.json").read_text())
    rng = np.random.default_rng(5)
    for level, network in zip(LEVELS[method], networks, strict=True):
        (ours, theirs), size = (kind(network), exported(out / f"{level}.onnx")), network.observation_space.shape[0]
        assert theirs[1]["method"] == method and json.loads(theirs[1]["policy"]) == described
        outputs = []
        for step in range(STEPS):
            seen = rng.normal(size=(COUNT, size)).astype(np.float32)
            starts = np.array([step == 0, step in (0, BEGINS), step == 0])
            expected, answer = ours(seen, starts), theirs[0](seen, starts)
            assert answer.shape == expected.shape == (COUNT, network.action_space.shape[0])
            assert np.abs(answer - expected).max() < 2e-5, (level, step)
            outputs.append(expected)
        assert np.std(outputs, axis=0).mean() > 0.01, "outputs that hardly vary would not show a difference"


def test_what_cannot_be_exported_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = call("onnx", "scripted", "--out", str(tmp_path / "x"))
    assert done.code == 2 and "scripted" in done.complaint and "run folder" in done.complaint
    run = untrained_policy("sac", tmp_path / "run")
    find = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name == "onnxscript":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return find(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    monkeypatch.setattr("reproduce.console.missing_extra", lambda module: "onnx" if module == "onnxscript" else None)
    done = call("onnx", str(run), "--out", str(tmp_path / "x"))
    assert done.code == 2 and not (tmp_path / "x").exists()
    assert (
        done.complaint == "reproduce: this needs onnxscript, which is not installed: pip install 'lunar-rescue[onnx]'"
    )
    shutil.rmtree(run)
