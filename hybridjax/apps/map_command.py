"""The command `hybridjax sweep`: a map of limit cycles over parameters of a user's system."""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from .._core.packages import package
from ..errors import DefinitionError
from ..plot.look import Plot, panels, save
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
    """Sweep, and draw what is wanted beside the store. Gives the dataset, and the pictures' files.

    **Raises:** `DefinitionError` for a file without such a model, and as `sweep`.
    """
    known = get_args(Want)
    for name in want:
        if name not in known:
            raise DefinitionError(f"`{name}` is nothing that a sweep keeps: {', '.join(known)}.")
    names = [name for name, *_ in axes]
    if len(set(names)) < len(names):
        raise DefinitionError("a parameter has two axes: give each `--over` another name.")
    over = {name: np.linspace(low, high, count) for name, low, high, count in axes}
    found = _load(*model)
    if scheduler is None:
        maps = sweep(found, over, want, store=out, force=force)
    else:
        distributed = package("distributed")
        package("cloudpickle").register_pickle_by_value(sys.modules[Path(model[0]).stem])
        try:
            client = distributed.Client(scheduler)
        except (OSError, ValueError) as error:
            raise DefinitionError(f"no Dask scheduler answers at '{scheduler}'.") from error
        with client:
            maps = sweep(found, over, want, store=out, client=client, force=force)
    drawn = [name for name in want if maps[name].dims == tuple(names)] if len(names) <= 2 else []
    return maps, [_draw(maps[name], f"{Path(out).with_suffix('')}-{name}") for name in drawn]


def _draw(map: Any, path: str) -> str:
    """A picture of a map over one or two parameters; its file."""
    with panels(None) as axes:
        first = {"x": map.dims[0]} if map.ndim == 2 else {}
        map.plot(ax=axes[0, 0], **first)
        axes[0, 0].set_title("")
    save(path, Plot(axes), formats=("png",))
    return f"{path}.png"


def _load(file: str, name: str) -> Any:
    """What a file of Python calls by a name."""
    path = Path(file)
    if not path.is_file():
        raise DefinitionError(f"there is no file '{file}': give the model as FILE.py:NAME.")
    sys.path.insert(0, str(path.parent.resolve()))  # its own imports, and those of workers
    module = importlib.import_module(path.stem)
    if Path(module.__file__ or "").resolve() != path.resolve():
        raise DefinitionError(f"another module is called '{path.stem}': rename '{file}'.")
    try:
        found = getattr(module, name)
    except AttributeError as error:
        raise DefinitionError(f"'{file}' has no '{name}'.") from error
    return found() if isinstance(found, type) else found
