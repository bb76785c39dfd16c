"""Options of XLA are used if the backend knows them, and are not used otherwise."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import compilation

DROPPED = {"xla_cpu_option_of_another_release": True, "xla_backend_optimization_level": 0}


def test_options_that_the_backend_does_not_know_are_left_out():
    assert compilation.known_options(DROPPED) == {"xla_backend_optimization_level": 0}
    assert compilation.known_options({"xla_backend_optimization_level": "high"}) == {}
    np.testing.assert_array_equal(compilation.jit(jnp.sin, DROPPED)(0.0), 0)


def test_options_measured_on_cpus_are_left_out_elsewhere(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compilation.known_options(compilation.ONCE) == {}


@pytest.mark.parametrize("outer", [jax.jit, jax.grad, jax.jacfwd, jax.vmap])
def test_a_program_with_options_is_part_of_another(outer):
    program = compilation.jit(lambda x, power: x**power, DROPPED, static_argnums=1)
    x = jnp.full(2, 3.0) if outer is jax.vmap else jnp.asarray(3.0)
    found = outer(lambda x: program(x, 2) + program(2.0, 3))(x)
    np.testing.assert_allclose(found, 6 if outer in (jax.grad, jax.jacfwd) else 17)


@pytest.mark.parametrize("given", ["", "named"])
def test_programs_are_kept_for_the_next_process(tmp_path, given):
    """In the user's cache, or in a given folder; a second process compiles nothing anew."""
    argument = str(tmp_path / "named") if given else None
    code = (
        "import jax, jax.numpy as jnp, drt_jax\n"
        f"print(drt_jax.keep_programs({argument!r}))\n"
        "jax.jit(lambda x: jnp.sin(x) + 41)(1.0)"
    )
    gone = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    environment = {k: v for k, v in os.environ.items() if k not in gone}
    environment |= {"XDG_CACHE_HOME": str(tmp_path / "home"), "JAX_PLATFORMS": "cpu"}
    kept = []
    for _ in range(2):
        said = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env=environment
        )
        assert said.returncode == 0, said.stderr
        folder = tmp_path / given if given else tmp_path / "home" / "drt_jax"
        assert said.stdout.strip() == str(folder)
        kept.append({path.name for path in folder.iterdir() if path.name.endswith("-cache")})
    assert kept[0] and kept[0] == kept[1]


def test_importing_starts_no_backend():
    """After the import a user may still choose a backend, or start `jax.distributed`."""
    code = (
        "import drt_jax.design, drt_jax.learn.train, drt_jax.show, jax\n"
        "jax.config.update('jax_platforms', 'none such')\n"
        "try: jax.devices()\n"
        "except RuntimeError as error: print(error)"
    )
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )
    assert "none such" in said.stdout, said.stderr
