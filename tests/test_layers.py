"""The house has one direction: imports only go down this table."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "fsmsm_jax"
FLOORS = {
    "geometry": 0,
    "resampling": 1,
    "world": 1,
    "sensing": 2,
    "alignment": 3,
    "calibration": 4,
    "localisation": 4,
    "slam": 4,
    "evaluation": 5,
    "plotting": 5,
    "io": 5,
    "benchmark": 5,
    "cli": 6,
    "__init__": 7,
}
FILES = sorted(PACKAGE.rglob("*.py"))


def room(path):
    """The part of the package a file belongs to: 'sensing' for sensing/lidar.py."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: write absolute imports"
            if node.module == "fsmsm_jax":
                yield from (name.name for name in node.names)
            elif (node.module or "").startswith("fsmsm_jax."):
                yield node.module.split(".")[1]
        elif isinstance(node, ast.Import):
            for name in node.names:
                assert not name.name.startswith("fsmsm_jax"), (
                    f"{path}: from fsmsm_jax …"
                )


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    here = room(path)
    for there in imported_rooms(path):
        assert there == here or FLOORS[there] < FLOORS[here], f"{here} imports {there}"


def test_private_parts_of_jax_and_equinox_are_left_alone():
    for path in FILES:
        text = path.read_text()
        for private in ("jax._src", "jax.experimental", "equinox.internal"):
            assert private not in text, f"{path} uses {private}"


def test_import_is_light_and_starts_no_backend():
    code = "import sys, fsmsm_jax; print('matplotlib' in sys.modules)"
    environment = os.environ | {"JAX_PLATFORMS": "nosuch"}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "False"
