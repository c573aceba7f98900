"""The API reference, `docs/api.md`: signatures and docstrings as they stand in the source."""

import ast
import inspect
import pkgutil
import re
import textwrap
from dataclasses import dataclass, is_dataclass
from typing import Any

#: What others build on, by heading: ``module:name``, and of a class those of its methods that are shown.
PUBLIC: dict[str, dict[str, tuple[str, ...]]] = {
    "The environment": {
        "lunar_rescue:LunarRescueEnv": ("__init__", "reset", "step", "render", "close", "reset_flat", "step_flat"),
        "lunar_rescue:sample_scene": (),
        "lunar_rescue:Scene": (),
        "lunar_rescue:RewardWeights": (),
        "lunar_rescue:postures": (),
        "lunar_rescue.observation:as_flat": (),
        "lunar_rescue.observation:as_dict": (),
    },
    "Terms of the reward": {
        f"lunar_rescue.rewards:{name}": ()
        for name in ("approach", "obstacle_avoidance", "joint_motion", "time_bonus", "contact")
    },
    "Trained policies": {
        "reproduce:load_policy": (),
        "reproduce.experiments.library:LoadedPolicy": ("predict", "rescue"),
    },
    "The learners elsewhere": {
        "reproduce.hrl_dcs.goals:PlainGoals": ("__init__",),
        "reproduce.hrl_dcs.training:TwoLayerTraining": ("__init__", "update"),
        "reproduce.baselines.feudal.training:make_fun_learner": (),
    },
}
_SECTIONS = {"Args:": "Arguments", "Returns:": "Returns", "Raises:": "Raises", "Attributes:": "Attributes"}


@dataclass(frozen=True)
class Item:
    """One function, class or method of the reference."""

    name: str  # with its module or class before it
    signature: str  # as code
    text: str  # its docstring in Markdown
    fields: str  # of a dataclass: its fields as they stand in the source, or ""
    methods: tuple["Item", ...] = ()


def reference() -> dict[str, list[Item]]:
    """Return everything of ``PUBLIC``, by heading; a name that is not there is an error."""
    return {title: [_item(name, methods) for name, methods in names.items()] for title, names in PUBLIC.items()}


def _item(name: str, methods: tuple[str, ...]) -> Item:
    thing = pkgutil.resolve_name(name)
    dotted = name.replace(":", ".")
    shown = tuple(_method(dotted.rpartition(".")[2], getattr(thing, method)) for method in methods)
    if not inspect.isclass(thing):
        return Item(dotted, f"{_signature(thing)}", markdown(inspect.getdoc(thing) or ""), "")
    return Item(dotted, f"class {thing.__name__}", markdown(inspect.getdoc(thing) or ""), _fields(thing), shown)


def _method(owner: str, function: Any) -> Item:
    """Return a method as its caller writes it: without self, and the constructor under its class's name."""
    name = owner if function.__name__ == "__init__" else f"{owner}.{function.__name__}"
    signature = re.sub(r"\bself(, |,\n *|(?=\)))", "", _signature(function), count=1)
    signature = signature.replace("__init__", owner).removesuffix(" -> None")
    return Item(name, signature, markdown(inspect.getdoc(function) or ""), "")


def _tree(thing: Any) -> tuple[ast.stmt, list[str]]:
    """Return the definition of a class or function as a syntax tree, and its lines."""
    source = textwrap.dedent(inspect.getsource(thing))
    return ast.parse(source).body[0], source.splitlines()


def _signature(function: Any) -> str:
    """Return name, arguments and result of a function, as they stand in the source."""
    tree, lines = _tree(function)
    assert isinstance(tree, ast.FunctionDef)
    head = "\n".join(lines[tree.lineno - 1 : tree.body[0].lineno - 1])
    return head.removeprefix("def ").removesuffix(":")


def _fields(cls: Any) -> str:
    """Return the fields of a dataclass with the sentences beside and above them; "" of any other class."""
    if not is_dataclass(cls):
        return ""
    tree, lines = _tree(cls)
    assert isinstance(tree, ast.ClassDef)
    fields = [node for node in tree.body if isinstance(node, ast.AnnAssign)]
    first, last = fields[0].lineno - 1, fields[-1].end_lineno
    while lines[first - 1].lstrip().startswith("#"):
        first -= 1
    return textwrap.dedent("\n".join(lines[first:last]))


def markdown(docstring: str) -> str:
    """Turn a Google-style docstring into Markdown: sections become bold words with lists under them."""
    lines, section = [], False
    for line in docstring.replace("``", "`").splitlines():
        if line in _SECTIONS:
            section = True
            lines += [f"**{_SECTIONS[line]}**", ""]
        elif section and (entry := re.match(r"    (\w+(?:, \w+)*): (.*)", line)):
            lines.append(f"- `{entry[1]}`: {entry[2]}")
        else:
            lines.append(re.sub(r"^    (?:    )?", "  " if line.startswith("        ") else "", line))
            section = section and (line.startswith("    ") or not line)
    return "\n".join(lines)
