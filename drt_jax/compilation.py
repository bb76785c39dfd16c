"""Options of XLA for programs that are slow to compile, and a folder that keeps compiled programs.

XLA refuses an option that its release does not know, and drops old ones. Each option is therefore
tried once on a trivial program when it is needed.
"""

import functools
import os
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from .numerics import concrete

# XLA's newer fusion emitters for CPUs take twice as long to compile large programs, which run no
# faster.
LARGE = {"xla_cpu_use_fusion_emitters": False}
# For large programs that run once. Level 0 compiles no faster, and gave one program of second
# derivatives a gradient that was wrong in the fifth digit, and Hessians that were NaN.
ONCE = {**LARGE, "xla_backend_optimization_level": 1}
# A preset of compiler passes with which a RED-Net step takes a tenth less time
# (docs/performance.md).
NETWORK = {"xla_cpu_opt_preset": "CPU_OPT_PRESET_FAST_COMPILE"}


def keep_programs(folder: str | os.PathLike | None = None) -> pathlib.Path:
    """Keeps compiled programs on disk, so that the next process need not compile them.

    Changes JAX's settings; call it before the first program is compiled.

    folder: folder for the programs. None for that which JAX_COMPILATION_CACHE_DIR or an earlier
        call names, else `drt_jax` in the user's cache.

    Returns the folder. OSError if it cannot be made.
    """
    chosen = folder or jax.config.values["jax_compilation_cache_dir"]
    if not chosen:
        home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        folder = chosen = pathlib.Path(home) / "drt_jax"
    if folder:  # programs that compile quickly, too
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    path = pathlib.Path(chosen).absolute()
    if not path.is_dir():
        path.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(path))
    return path


def known_options(wanted: Mapping[str, Any]) -> dict[str, Any]:
    """The options that the default backend knows, for `jax.jit(compiler_options=...)`.

    There are none unless the backend is a CPU, because the options were measured only there. Starts
    the backend.

    wanted: options and their values.
    """
    if jax.default_backend() != "cpu":
        return {}
    return {name: value for name, value in wanted.items() if _known(name, value)}


@functools.cache
def _known(name: str, value: Any) -> bool:
    """Whether the backend knows an option."""
    try:
        jax.jit(lambda x: x + 1, compiler_options={name: value}).lower(0.0).compile()
    except RuntimeError:  # INVALID_ARGUMENT: no such option, or no such value
        return False
    return True


def jit(function: Callable, wanted: Mapping[str, Any], **keywords: Any) -> Callable:
    """`jax.jit(function, **keywords)` with those of the wanted options that the backend knows.

    The backend is asked at the first call. Inside of other programs and of derivatives, where JAX
    accepts no options, it has none. The attribute `program` is a function without arguments that
    returns the program with options.
    """
    inside = jax.jit(function, **keywords)

    @functools.cache
    def program() -> Callable:
        return jax.jit(function, compiler_options=known_options(wanted), **keywords)

    @functools.wraps(function)
    def run(*args: Any, **named: Any) -> Any:
        # Inside `jax.jit` a new array is a tracer, too.
        known = concrete((args, named, jnp.zeros(())))
        return (program() if known else inside)(*args, **named)

    run.program = program  # type: ignore[attr-defined]
    return run
