"""Check a notebook's parameters before it does anything, however it was started.

papermill only warns of a parameter that a notebook does not know, and takes any value. So each notebook begins with
``check(globals(), ...)``, and the command line makes the same check for all notebooks before the first one runs.
"""

from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from lunar_rescue.scenes.splits import HELDOUT
from reproduce.experiments.presets import check_preset
from reproduce.storage.errors import UserError

STRICT = ConfigDict(strict=True, allow_inf_nan=False)
_Seed = Annotated[int, Field(strict=True, ge=0, lt=HELDOUT.stop)]
#: Every parameter that some notebook has: its type and range.
PARAMETERS: dict[str, TypeAdapter[Any]] = {
    "preset": TypeAdapter(str, config=STRICT),
    "seed": TypeAdapter(_Seed),
    "first_seed": TypeAdapter(_Seed),
    "tests": TypeAdapter(Annotated[int, Field(strict=True, ge=1, le=100_000)]),
    "steps": TypeAdapter(Annotated[int, Field(strict=True, ge=1)]),
    "gamma": TypeAdapter(Annotated[float, Field(strict=True, ge=0.0, le=1.0, allow_inf_nan=False)]),
}
_CHECKED = "_parameters_checked"
_PLAIN = (str, int, float, bool, list, dict, tuple, type(None))


def check_value(name: str, value: Any, default: Any) -> None:
    """Refuse a value of the wrong type or out of range; what ``PARAMETERS`` does not have has its default's type."""
    if name == "preset":
        check_preset(value)
    adapter = PARAMETERS.get(name) or TypeAdapter(type(default), config=STRICT)
    try:
        adapter.validate_python(value)
    except ValidationError as error:
        problem = error.errors()[0]["msg"]
        raise UserError(f"{name}: {problem[0].lower()}{problem[1:]}; got {value!r}") from None


def check(namespace: dict[str, Any], *names: str) -> None:
    """Check the parameters of the notebook that calls this in its first cell after the parameters.

    ``namespace`` is the notebook's ``globals()``, ``names`` are its own parameters. A value out of range, or plain data
    under another public name, which papermill may have put there, is a ``UserError``.
    """
    for name in names:
        check_value(name, namespace[name], namespace[name])
    # Later the notebook has names of its own, and whoever runs this cell again gives no new parameters.
    if not namespace.get(_CHECKED):
        brought = namespace["get_ipython"]().user_ns_hidden if "get_ipython" in namespace else {}
        public = {name for name, value in namespace.items() if name[0] != "_" and isinstance(value, _PLAIN)}
        if strangers := sorted(public.difference(names, brought)):
            raise UserError(f"{strangers[0]}: no parameter of this notebook; expected {', '.join(names)}")
    namespace[_CHECKED] = True
