"""Functions that start without tracing: what JAX makes of one, kept in a file.

Before its first answer JAX traces a function: it runs the Python of it once, with
shapes in place of numbers, and writes down what it would compute. For a whole search
that takes seconds, at every start, whatever else is cached. But the trace depends on
nothing except code, settings and shapes, so it can be kept: `jax.export` writes it as
StableHLO, a language that later versions of JAX promise to read (for half a year).

What remains at a start is XLA's part, from StableHLO to machine code: seconds the first
time on a machine, a fraction of one where JAX's persistent compilation cache is on
(`jax_compilation_cache_dir`; the command line has it on).

A `Program` takes and gives plain arrays, the leaves of the function's pytrees; `stored`
makes trackers and queries of it. `recalled` is for the same machine and the same code:
it keeps the trace of any function in a folder, under a digest of all it depends on.
"""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import equinox
import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, PyTree

from fsmsm_jax.localisation.array_file import UNREADABLE, read_arrays, write_arrays

__all__ = ["Program", "platform_here", "recalled"]

_VERSION = 1  # of the file
_PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Program:
    """A traced function of `constants` and arguments; `trace` one, or `load` one."""

    kind: str
    """What it is: a file of one kind is not taken for another."""
    about: Mapping[str, Any]
    """What its users want to know of it; goes through JSON."""
    exported: export.Exported
    """The function, from the leaves of constants and arguments to those of results."""
    constants: tuple[Array | np.ndarray, ...]
    """Leaves of what does not change from call to call."""

    @classmethod
    def trace(
        cls,
        kind: str,
        function: Callable[..., PyTree],
        constants: PyTree,
        arguments: Sequence[PyTree],
        platforms: Sequence[str] | None = None,
        **about: Any,
    ) -> "Program":
        """Trace a function.

        Args:
            kind: what it is.
            function: of `constants` and then the arguments.
            constants: arrays that a file is to hold beside the function.
            arguments: of the shapes and types that it will be called with.
            platforms: "cpu", "cuda", "rocm", "tpu"; the present one if left out.
            about: what users want to know of it.
        """
        leaves, structure = jax.tree.flatten((constants, *arguments))

        def flat(*leaves):
            return jax.tree.leaves(function(*jax.tree.unflatten(structure, leaves)))

        shapes = [jax.ShapeDtypeStruct(np.shape(a), jnp.result_type(a)) for a in leaves]
        exported = export.export(jax.jit(flat), platforms=platforms)(*shapes)
        return cls(kind, about, exported, tuple(jax.tree.leaves(constants)))

    def save(self, path: str | Path) -> None:
        """Write the file.

        Raises:
            ValueError: it cannot be written there.
        """
        module = np.frombuffer(self.exported.serialize(), np.uint8)
        head = {
            "version": _VERSION,
            "kind": self.kind,
            "jax": jax.__version__,
            "about": dict(self.about),
        }
        arrays = {f"constant_{n}": np.asarray(a) for n, a in enumerate(self.constants)}
        arrays = {"head": np.asarray(json.dumps(head)), **arrays}
        try:
            write_arrays(
                Path(path), arrays, "module", module.shape, module.dtype, [module]
            )
        except OSError as error:
            raise ValueError(f"cannot write a program to {path}: {error}") from error

    @classmethod
    def load(cls, path: str | Path, kind: str) -> "Program":
        """Read a file that `save` wrote; nothing is traced.

        Raises:
            ValueError: the file is missing, torn, no program, one of another kind or
                version, or not for this machine's platform.
        """
        anew = "export it anew"
        try:
            kept = read_arrays(Path(path))
            head = json.loads(str(kept["head"]))
            if head["version"] != _VERSION:
                raise ValueError(f"it is of version {head['version']}, not {_VERSION}")
            if head["kind"] != kind:
                raise ValueError(f"it holds a {head['kind']}")
            module = bytearray(kept["module"].tobytes())
            names = [f"constant_{n}" for n in range(len(kept) - 2)]
            constants = tuple(jnp.asarray(kept[name]) for name in names)
        except UNREADABLE as error:
            raise ValueError(f"cannot read a {kind} from {path} ({error})") from error
        try:
            exported = export.deserialize(module)
        except ValueError as error:
            raise ValueError(
                f"{path} was written by jax {head['jax']}, which jax {jax.__version__} "
                f"cannot read ({error}); {anew}"
            ) from error
        here = platform_here()
        if here not in exported.platforms:
            raise ValueError(
                f"{path} is for {' and '.join(exported.platforms)}, this is {here}; "
                f"{anew}, with platforms=('{exported.platforms[0]}', '{here}')"
            )
        return cls(kind, head["about"], exported, constants)

    def compiled(self) -> Callable[..., list[Array]]:
        """The function from its arguments to the leaves of its results.

        Arrays are taken for what the program was traced with: of these shapes, cast to
        these types. It raises a ValueError where a shape is another.
        """
        shapes = [
            jax.ShapeDtypeStruct(a.shape, a.dtype) for a in self.exported.in_avals
        ]
        run = jax.jit(self.exported.call).lower(*shapes).compile()
        expected = self.exported.in_avals[len(self.constants) :]

        def call(*arguments):
            leaves = jax.tree.leaves(arguments)
            found = [np.shape(leaf) for leaf in leaves]
            if found != [aval.shape for aval in expected]:
                raise ValueError(
                    f"the {self.kind} takes arrays of shapes "
                    f"{', '.join(str(aval.shape) for aval in expected)}, got "
                    f"{', '.join(map(str, found))}; export one for these"
                )
            pairs = zip(leaves, expected, strict=True)
            return run(*self.constants, *(_as(leaf, a.dtype) for leaf, a in pairs))

        return call


def platform_here() -> str:
    """This machine's kind, as `jax.export` has it: "cpu", "cuda", "rocm" or "tpu"."""
    kind = jax.default_backend()
    if kind != "gpu":
        return kind
    maker = jax.devices()[0].client.platform_version.lower()
    return "rocm" if "rocm" in maker else "cuda"


def recalled(
    folder: Path,
    function: Callable[..., PyTree],
    arguments: tuple,
    like: PyTree,
) -> Callable[[], PyTree]:
    """The function of these arguments, traced only if no process before has done so.

    Args:
        folder: where traces are kept. One that cannot be written keeps none.
        function: a jitted function of this package.
        arguments: of the function.
        like: a pytree of the result's structure, whatever its leaves.

    Returns:
        A function without arguments, for it is bound to these, that gives the result.
        Another one than the original is never run: the trace's name is a digest of the
        package's sources, the versions and settings of JAX, shapes and static fields.
    """
    path = folder / f"{function.__name__}-{_digest(function, arguments)}.trace"
    try:
        program = Program.load(path, "trace")
    except ValueError:
        call = lambda constants, *rest: function(*rest)
        program = Program.trace("trace", call, (), arguments)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            program.save(path)
        except (OSError, ValueError):
            pass  # it is a cache: without it, all is as slow as it was
    run, structure = program.compiled(), jax.tree.structure(like)
    return lambda: jax.tree.unflatten(structure, run(*arguments))


def _as(leaf, dtype):
    """On the host unless it is right already: an eager cast would be a program."""
    return leaf if jnp.result_type(leaf) == dtype else np.asarray(leaf, dtype)


def _digest(function, arguments) -> str:
    """Of all that the trace of a call depends on."""
    settings = sorted((k, v) for k, v in os.environ.items() if k.startswith("JAX_"))
    facts = (
        *(_sources(), jax.__version__, equinox.__version__, jax.default_backend()),
        *(settings, str(jnp.result_type(float))),
        *(function.__module__, function.__qualname__, _described(arguments)),
    )
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:32]


def _described(value) -> Any:
    """Shapes and types of arrays, all else as it is. A `repr` would hide defaults."""
    if hasattr(value, "shape"):
        return value.shape, str(value.dtype)
    if isinstance(value, equinox.Module):
        return type(value).__qualname__, _described(vars(value))
    if isinstance(value, dict):
        return {key: _described(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return type(value).__qualname__, [_described(part) for part in value]
    return repr(value)


@cache
def _sources() -> str:
    """Of the code of this package."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
