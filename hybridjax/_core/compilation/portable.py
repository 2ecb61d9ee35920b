"""Compiled programs, and such that are still to be compiled, as bytes for another process."""

import dataclasses
import pickle
import uuid
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
from jax.experimental import serialize_executable
from jaxlib.mlir.passmanager import PassManager

from ..executor import Array
from .fingerprint import IndescribableError
from .lapack import calls_lapack, in_turn


class Portable(NamedTuple):
    """A program that was traced, for the CPU, but not compiled."""

    arguments: list[tuple[tuple[int, ...], str]]
    """Shapes and types."""
    results: list[tuple[tuple[int, ...], str]]
    kept: tuple[int, ...]
    """The arguments that it uses."""
    code: bytes
    structure: Any
    """The results' pytree, with numbers in place of arrays."""

    def to_bytes(self) -> bytes:
        return pickle.dumps(tuple(self))

    @staticmethod
    def from_bytes(data: bytes) -> "Portable":
        """(As of `Executable`: from a trusted place.)"""
        return Portable(*pickle.loads(data))


class Executable:
    """A compiled program of a flat list of arrays."""

    def __init__(self, compiled: jax.stages.Compiled, structure: Any, factorizes: bool):
        self._compiled = compiled
        self._structure = structure
        self._factorizes = factorizes

    def __call__(self, *arrays: Array) -> Any:
        with in_turn(self._factorizes):
            results = self._compiled(*arrays)
            results = iter(jax.block_until_ready(results) if self._factorizes else results)
        return jax.tree_util.tree_map(lambda _: next(results), self._structure)

    def to_bytes(self) -> bytes:
        payload, given, returned = serialize_executable.serialize(self._compiled)
        counts = given.num_leaves, returned.num_leaves
        return pickle.dumps((payload, *counts, self._structure, self._factorizes))

    @staticmethod
    def from_bytes(data: bytes) -> "Executable":
        """**Raises:** whatever JAX raises for what it cannot load. (Bytes are executed: they must
        come from a trusted place.)"""
        payload, given, returned, structure, factorizes = pickle.loads(data)
        form = jax.tree_util.tree_structure
        compiled = serialize_executable.deserialize_and_load(
            payload,
            form(((0,) * given, {})),
            form([0] * returned),
            backend="cpu",
            execution_devices=jax.local_devices(backend="cpu")[:1],
        )
        return Executable(compiled, structure, factorizes)


def trace(function: Callable, arrays: list[Array]) -> Portable:
    """`function(*arrays)` as a program.

    **Raises:** `IndescribableError` for one that another process could not compile.
    """
    program, shapes = jax.jit(function), _shapes(_types(arrays))
    program.trace(*shapes)  # what a user's function raises comes from here
    try:
        exported = jax.export.export(program, platforms=["cpu"])(*shapes)
    except ValueError as error:  # custom calls of other libraries
        raise IndescribableError from error
    return Portable(
        _types(exported.in_avals),
        _types(exported.out_avals),
        exported.module_kept_var_idx,
        exported.mlir_module_serialized,
        exported.out_tree.unflatten(range(len(exported.out_avals))),
    )


def build(program: Portable, options: dict[str, Any], kept: bool) -> Executable:
    """Compile a program, with these options of the compiler. It can be written if it is to be
    `kept`."""
    shapes = _shapes(program.arguments)
    # (JAX's own form for files needs one more library.)
    blank = jax.jit(lambda *_: [jnp.zeros(shape, kind) for shape, kind in program.results])
    exported = dataclasses.replace(
        jax.export.export(blank, platforms=["cpu"])(*shapes),
        mlir_module_serialized=program.code,
        module_kept_var_idx=program.kept,
    )

    def run(*arrays):
        return exported.call(*arrays)

    # What was loaded from JAX's own cache on disk cannot be written once more (it would not run):
    # no program there has this name.
    run.__name__ = f"program_{uuid.uuid4().hex}" if kept else "program"
    return compiled(jax.jit(run).lower(*shapes), options, program.structure)


def compiled(lowered: jax.stages.Lowered, options: dict[str, Any], structure: Any) -> Executable:
    """The program of a flat list of arrays, whose results have this structure.

    It does not say where in the source its operations come from: that would be half of the file.
    """
    module = lowered.compiler_ir()
    with module.context:
        PassManager.parse("builtin.module(strip-debuginfo)").run(module.operation)
        factorizes = calls_lapack(module)
    return Executable(lowered.compile(compiler_options=options), structure, factorizes)


def _types(arrays) -> list[tuple[tuple[int, ...], str]]:
    return [(tuple(x.shape), x.dtype.name) for x in arrays]


def _shapes(types) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(shape, kind) for shape, kind in types]
