"""Tests run in float64, with strict promotion of dtypes and ranks and with warnings as errors, so
that no precision or shape changes silently."""

import gc
import itertools
import os
import pathlib
import resource
import signal
import tempfile
from collections.abc import Iterator

import jax
import numpy as np
import pytest

from .flags import set_flags
from .times import Times

set_flags()

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Tests that run the same program again, in this process or another, do not compile it again.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.TemporaryDirectory(prefix="drt-jax-compiled-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache.name
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

# JAX makes many small objects that live long. Garbage collection rarely frees any of them, and
# takes a seventh of the time of the tests.
gc.set_threshold(100_000, 20, 20)

# All slow tests take longer than CI allows: it runs one seventh of them, depending on the commit.
PARTS = 7
# Files whose cases share no programs; these may be separated, too.
APART = ("test_pages.py", "test_starts.py")
LONGEST = ("test_readme.py", "test_experiments.py", "test_derivatives.py")
RGB = (0.6, 0.53, 0.48)
LENSES = ("double_gauss", "double_gauss_addon", "cooke_triplet", "singlet")


def pytest_addoption(parser):
    """Adds --write-tables, with which tests that make a table of `results` write it there; and
    --part and --times."""
    parser.addoption("--write-tables", action="store_true", help="rewrite the tables in results/")
    parser.addoption("--part", type=int, choices=range(PARTS), help="a seventh of the slow tests")
    parser.addoption("--times", metavar="FILE", help="where the time goes, see times.py")


def pytest_configure(config):
    """Measures the times of the tests with --times."""
    if config.getoption("--times"):
        config.pluginmanager.register(Times(config.getoption("--times")))


def pytest_collection_modifyitems(config, items):
    """Sorts files with long tests to the front, so that none is left for a single worker at the
    end. With `--part`, selects every seventh slow function. The cases of one function share
    programs and stay together, except those of `APART`."""
    items.sort(key=lambda item: item.path.name not in LONGEST)
    part = config.getoption("--part")
    if part is None:
        return
    own = {i: i.name if i.path.name in APART else i.originalname for i in items}
    slow = {i: (i.path, own[i]) for i in items if i.get_closest_marker("slow")}
    wanted = set(itertools.islice(dict.fromkeys(slow.values()), part, None, PARTS))
    left = [item for item, function in slow.items() if function not in wanted]
    config.hook.pytest_deselected(items=left)
    items[:] = [item for item in items if slow.get(item) is None or slow[item] in wanted]


@pytest.fixture
def write_tables(request) -> bool:
    """Whether the tables in `results` are to be written."""
    return request.config.getoption("--write-tables")


@pytest.fixture
def shared() -> pathlib.Path:
    """Folder of reference data next to the checkout; the test is skipped if there is none."""
    path = pathlib.Path(__file__).resolve().parents[2] / "shared" / "data"
    if not path.is_dir():
        pytest.skip("no reference data beside the checkout")
    return path


@pytest.fixture(scope="session", autouse=True)
def ctrl_c() -> Iterator[None]:
    """Handles Ctrl-C also if the tests were started with SIGINT ignored (`nohup`, some CI), because
    some tests send it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def assert_close(ours, wanted, rtol, floor=0.0):
    """Asserts that each array of a tree agrees with the other within `rtol` of the largest element
    of the other, plus `floor`."""
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(wanted), strict=True):
        assert a.shape == b.shape
        size = np.max(np.abs(b), initial=0)
        np.testing.assert_allclose(a, b, rtol=0, atol=rtol * size + floor)


@pytest.fixture(autouse=True, scope="module")
def room_for_programs():
    """Drops all compiled programs when they take 4 GB; until then the tests of all files share
    them. These are some 12,000 of the 65,530 memory maps that Linux allows for a process. The
    garbage collector does not search the objects that are kept again."""
    yield
    sizes = pathlib.Path("/proc/self/statm")  # the second number: pages in memory
    if not sizes.exists() or int(sizes.read_text().split()[1]) * resource.getpagesize() > 4e9:
        jax.clear_caches()
        gc.unfreeze()
        gc.collect()
    gc.freeze()
