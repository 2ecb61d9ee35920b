"""Signatures as users read them in `help`: with the annotations of the source.

`checked.py` gives each public function a `ShortSignature`, which `help` and `inspect.signature`
show. It must stay lazy: a source is read and parsed when a signature is first asked for, and not
when the package is imported. Only what is shown comes from here; arguments are checked against the
annotations themselves (`parameters.py`).

If `help` shows the text of a check, such as `Annotated[int, ...]`, look at `_WithoutChecks`; if it
shows types in place of the words of the source, at `_definition`, which has found no source; if
annotations of a constructor are missing, at `_of_fields`.
"""

import ast
import functools
import inspect
import textwrap
from collections.abc import Callable
from types import MappingProxyType
from typing import Any


class ShortSignature(inspect.Signature):
    """The signature of a function, or of the constructor of a class. An annotation such as `Count`
    has its name here, not the text of its check.

    It is made when it is first read: reading the sources of all public functions would slow down
    the import.
    """

    def __init__(self, function: Callable, cls: type | None = None):
        super().__init__()
        self._function = function
        self._cls = cls

    @functools.cached_property
    def _readable(self) -> inspect.Signature:
        signature = inspect.signature(self._function)
        written = _of_function(self._function)
        if not written and self._cls is not None:
            written = _of_fields(self._cls)
        parameters = [
            x.replace(annotation=written.get(x.name, x.annotation))
            for x in signature.parameters.values()
        ]
        returned = written.get("return", signature.return_annotation)
        return signature.replace(parameters=parameters, return_annotation=returned)

    @property
    def parameters(self) -> MappingProxyType[str, inspect.Parameter]:
        return self._readable.parameters

    @property
    def return_annotation(self) -> Any:
        return self._readable.return_annotation

    def __reduce__(self) -> Any:
        return self._readable.__reduce__()

    def replace(self, **changes: Any) -> inspect.Signature:  # type: ignore[override]
        return self._readable.replace(**changes)


class _Written(str):
    """An annotation, which prints without quotation marks."""

    def __repr__(self) -> str:
        return str(self)


class _WithoutChecks(ast.NodeTransformer):
    """`Annotated[int, ...]` becomes `int`."""

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        is_annotated = isinstance(node.value, ast.Name) and node.value.id == "Annotated"
        if is_annotated and isinstance(node.slice, ast.Tuple):
            return self.visit(node.slice.elts[0])
        return self.generic_visit(node)


def _of_function(function: Callable) -> dict[str, _Written]:
    """Annotations in the source of a function, by parameter and for "return"; none without a
    source."""
    definition = _definition(function)
    if not isinstance(definition, ast.FunctionDef):
        return {}
    nodes = {
        x.arg: x.annotation for x in ast.walk(definition.args) if isinstance(x, ast.arg)
    }
    nodes["return"] = definition.returns
    return {name: _written(node) for name, node in nodes.items() if node is not None}


def _of_fields(cls: type) -> dict[str, _Written]:
    """Annotations of the fields of a class whose constructor `dataclasses` has made."""
    written = {}
    for base in reversed(cls.__mro__):
        definition = _definition(base)
        lines = definition.body if isinstance(definition, ast.ClassDef) else []
        for line in lines:
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                written[line.target.id] = _written(line.annotation)
    return written


def _definition(thing: Any) -> ast.stmt | None:
    """The source of a function or class; None if there is none."""
    try:
        source = textwrap.dedent(inspect.getsource(thing))
        return ast.parse(source).body[0]
    except (OSError, TypeError, SyntaxError):
        return None


def _written(node: ast.expr) -> _Written:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return _Written(node.value)
    return _Written(ast.unparse(_WithoutChecks().visit(node)))
