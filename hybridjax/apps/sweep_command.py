"""The command `hybridjax sweep`: a map of limit cycles over parameters of a user's system."""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from .._core.arguments import package
from ..errors import DefinitionError
from ..plot.look import save
from ..plot.over_parameters import sweep as plot_sweep
from ..scale.sweep import sweep
from ..scale.wanted import Want


def run(
    model: tuple[str, str],
    axes: Sequence[tuple[str, float, float, int]],
    want: Sequence[str],
    out: str,
    scheduler: str | None,
    force: bool,
) -> tuple[Any, list[str]]:
    """Sweep, and draw the maps beside the store. Return the dataset and the pictures' files.

    **Raises:** `DefinitionError` for a file without such a model, and as `sweep`.
    """
    for name in want:
        if name not in get_args(Want):
            kinds = ", ".join(get_args(Want))
            raise DefinitionError(f"`{name}` is nothing that a sweep keeps: {kinds}.")
    quantities = cast(Sequence[Want], want)
    names = [name for name, *_ in axes]
    if len(set(names)) < len(names):
        raise DefinitionError("a parameter has two axes: give each `--over` another name.")
    over = {name: np.linspace(low, high, count) for name, low, high, count in axes}
    system = _load(*model)
    if scheduler is None:
        maps = sweep(system, over, quantities, store=out, force=force)
    else:
        distributed = package("distributed")
        package("cloudpickle").register_pickle_by_value(sys.modules[Path(model[0]).stem])
        try:
            client = distributed.Client(scheduler)
        except (OSError, ValueError) as error:
            raise DefinitionError(f"no Dask scheduler answers at '{scheduler}'.") from error
        with client:
            maps = sweep(system, over, quantities, store=out, client=client, force=force)
    pictures: list[str] = []
    for name in want:
        if maps[name].dims == tuple(names) and len(names) <= 2:
            picture = f"{Path(out).with_suffix('')}-{name}"
            pictures += map(str, save(picture, plot_sweep(maps, name)))
    return maps, pictures


def _load(file: str, name: str) -> Any:
    """The system, class or function of this name in a Python file."""
    path = Path(file)
    if not path.is_file():
        raise DefinitionError(f"there is no file '{file}': give the model as FILE.py:NAME.")
    sys.path.insert(0, str(path.parent.resolve()))  # for its own imports, and those of workers
    module = importlib.import_module(path.stem)
    if Path(module.__file__ or "").resolve() != path.resolve():
        raise DefinitionError(f"another module is called '{path.stem}': rename '{file}'.")
    try:
        system = getattr(module, name)
    except AttributeError as error:
        raise DefinitionError(f"'{file}' has no '{name}'.") from error
    return system() if isinstance(system, type) else system
