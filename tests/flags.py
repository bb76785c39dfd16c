"""Flags of XLA for tests and for the notebooks of the site: most of their time is compilation.

Machine code that is not optimised compiles three times faster, without the newer fusions of CPUs
nearly twice as fast, in one piece instead of many in parallel a tenth faster, since both cores are
busy anyway, and with fewer passes over the program a sixth. What it computes is the same.
"""

import os
import subprocess
import sys

FLAGS = (
    "--xla_backend_optimization_level=0",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_cpu_opt_preset=CPU_OPT_PRESET_FAST_COMPILE",
)


def known(flag: str) -> bool:
    """Whether this XLA knows a flag, or several; XLA aborts a process with an unknown flag."""
    ask = [sys.executable, "-c", "import jax; jax.devices('cpu')"]
    flags = {"XLA_FLAGS": flag, "JAX_PLATFORMS": "cpu"}
    return not subprocess.run(ask, env=os.environ | flags, capture_output=True).returncode


def set_flags() -> None:
    """Sets the flags for backends that start later, here and in new processes, unless `XLA_FLAGS`
    is set."""
    if "XLA_FLAGS" not in os.environ:
        together = " ".join(FLAGS)
        os.environ["XLA_FLAGS"] = together if known(together) else " ".join(filter(known, FLAGS))
