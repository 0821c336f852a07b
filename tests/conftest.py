"""Strictness and data for all tests.

Rank promotion is an error here: `(n,) + (m, n)` is nearly always a forgotten axis.
Hypothesis is made repeatable and patient (the first example pays for a compile).
Compiled programs are dropped between files when there are many: each holds some ten
memory maps, and a process that reaches the kernel's 65 530 (vm.max_map_count) dies
inside LLVM. The limit here leaves the next file 45 000.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from hypothesis import settings

jax.config.update("jax_numpy_rank_promotion", "raise")

settings.register_profile(
    "fixed", deadline=None, derandomize=True, database=None, max_examples=50
)
settings.load_profile("fixed")

_MAPS, _MANY = Path("/proc/self/maps"), 20_000


@pytest.fixture(scope="module", autouse=True)
def _drop_compiled() -> Iterator[None]:
    yield
    if not _MAPS.exists() or _MAPS.read_text().count("\n") > _MANY:
        jax.clear_caches()


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of third-party recordings; tests that need it skip where it is absent."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("FSMSM_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}; point FSMSM_DATA at them")
    return folder
