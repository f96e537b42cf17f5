"""Traced programs, kept on disk for later processes.

JAX keeps compiled programs on disk, but each process traces its functions anew, which
takes longer than to load them. Here the traced program of a function is kept, too. It
is found by all that it depends on: the function's name, the shapes of its arguments,
the code of this package, versions, JAX's configuration and the device.
"""

import functools
import hashlib
import importlib.metadata
import pickle
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax

Function = Callable[..., Any]

_PACKAGES = (
    *("jax", "jaxlib", "flax", "optax", "chex", "numpy"),
    *("brax", "jaxopt", "mujoco", "mujoco-mjx"),
)
_folder: Path | None = None
_names: dict[Function, str] = {}


def _read_code() -> str:
    """Digest of this package's files."""
    code = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        code.update(path.read_bytes())
    return code.hexdigest()


_CODE = _read_code()


def keep_in(folder: Path | None) -> None:
    """Sets the folder of programs; None keeps no more of them.

    Whoever can write to it can execute code here, as with JAX's compiled programs.
    """
    global _folder
    _folder = folder


def programs_kept() -> bool:
    """Whether there is a folder of programs."""
    return _folder is not None


def give_name(name: str, *functions: Function) -> None:
    """Names functions of this package by what they compute.

    Only programs made of named functions are kept: the code of others is not known.
    """
    _names.update(dict.fromkeys(functions, name))


def common_name(*functions: Function) -> str:
    """The name that all of these functions have; empty if there is none."""
    names = {_names.get(function, "") for function in functions}
    return names.pop() if len(names) == 1 else ""


def kept(
    function: Function, name: str, compiled: Callable[[Function], Function]
) -> Function:
    """A compiled function whose program is kept, if there is a folder for it.

    Args:
        function: what is compiled, for one device.
        name: what it computes; all that its arguments do not tell.
        compiled: compiles a function at its first call.
    """
    plain = compiled(function)
    programs: dict[Any, Function] = {}

    def call(*arguments: Any) -> Any:
        if _folder is None:
            return plain(*arguments)
        leaves, structure = jax.tree.flatten(arguments)
        shapes = tuple(_shape(leaf) for leaf in leaves)
        configuration = _configuration()
        key = structure, shapes, configuration
        if key not in programs:
            known = f"{_origin()} {configuration} {name} {structure} {shapes}"
            path = _folder / hashlib.sha256(known.encode()).hexdigest()
            made = _read(path) or _make(path, plain, leaves, structure)
            programs[key] = compiled(made) if made else plain
        return programs[key](*arguments)

    # As of any compiled function.
    call.lower = plain.lower  # type: ignore[attr-defined]
    return call


def _shape(leaf: Any) -> tuple[Any, ...]:
    aval = jax.typeof(leaf)
    return aval.shape, str(aval.dtype), aval.weak_type


@functools.cache
def _origin() -> str:
    """What a program depends on besides its function, arguments and configuration."""
    device = jax.devices()[0]
    versions = [(name, _version(name)) for name in _PACKAGES]
    return f"{_CODE} {versions} {device.platform} {device.device_kind}"


def _configuration() -> str:
    """JAX's settings, without those that say where programs are kept."""
    values = sorted(jax.config.values.items())
    return repr([(name, value) for name, value in values if "cache" not in name])


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _make(
    path: Path, plain: Function, leaves: Iterable[Any], structure: Any
) -> Function | None:
    """Traces a function and keeps its program; None if it cannot be kept."""
    results: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        found, result = jax.tree.flatten(plain(*jax.tree.unflatten(structure, leaves)))
        results.append(result)
        return found

    try:
        exported = jax.export.export(jax.jit(flat))(*leaves)
        # Classes of pytrees are found again by their names.
        result = jax.tree.unflatten(results[0], [0] * results[0].num_leaves)
        content = pickle.dumps((bytes(exported.serialize()), result))
        if _read_code() == _CODE:  # else the files are no longer those that run
            _write(path, _digest(path, content) + content)
    # Whatever cannot be exported or written is traced and compiled as usual, and an
    # error of the function itself is then raised there.
    except Exception:
        return None
    return _program(exported, results[0])


def _digest(path: Path, content: bytes) -> bytes:
    """32 bytes that tell a whole file under its own name."""
    return hashlib.sha256(path.name.encode() + content).digest()


def _write(path: Path, content: bytes) -> None:
    """Writes a file as a whole, whatever other processes do."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        file.write(content)
    Path(file.name).replace(path)


def _read(path: Path) -> Function | None:
    """The program in a file; None if there is none, or it is damaged."""
    if not path.is_file():
        return None
    try:
        digest, content = (held := path.read_bytes())[:32], held[32:]
        if _digest(path, content) != digest:
            return None
        program, result = pickle.loads(content)
        exported = jax.export.deserialize(bytearray(program))
    except Exception:
        return None
    return _program(exported, jax.tree.structure(result))


def _program(exported: jax.export.Exported, result: Any) -> Function:
    """The function that a program computes."""

    def function(*arguments: Any) -> Any:
        return jax.tree.unflatten(result, exported.call(*jax.tree.leaves(arguments)))

    return function
