"""The scripts still run: a few of everything, with recordings and without."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_reproduce_thesis_quickly(tmp_path):
    """Where nothing is recorded, so that it runs everywhere; the tables say so."""
    nothing = {"FSMSM_DATA": str(tmp_path / "no"), "FSMSM_GOLDEN": str(tmp_path / "no")}
    page, pictures = tmp_path / "thesis.md", tmp_path / "pictures"
    command = [sys.executable, "scripts/reproduce_thesis.py", "--quick"]
    run = subprocess.run(
        [*command, "--markdown", str(page), "--out", str(pictures)],
        cwd=ROOT,
        env=os.environ | nothing,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert "generated offices" in run.stdout
    tables = page.read_text()
    for title in (
        "Main evaluation: errors",
        "Main evaluation: cost",
        "Orientation alone, no noise",
        "The position law alone",
        "CAER against pose error",
        "The largest sampling degree",
        "A shorter reach",
        "Milliseconds a match",
    ):
        assert f"### {title}" in tables
        assert title in run.stdout
    assert "author's C++" not in tables  # its results are not at hand
    assert {path.stem for path in pictures.iterdir()} == {
        "similarity",
        "position",
        "caer",
        "degrees",
    }
    assert all(path.stat().st_size < 200_000 for path in pictures.iterdir())


@pytest.mark.slow
def test_bench_accuracy_quickly(tmp_path):
    """Sections that need recordings are left out; the others print their tables."""
    page = tmp_path / "accuracy.md"
    command = [sys.executable, "scripts/bench_accuracy.py", "--quick"]
    run = subprocess.run(
        [*command, "--markdown", str(page)],
        cwd=ROOT,
        env=os.environ | {"FSMSM_DATA": str(tmp_path / "no")},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    tables = page.read_text()
    for title in ("polygon worlds", "Noise in the map, too", "occupancy grid", "Speed"):
        assert title in tables
    assert "real lidar" not in tables


@pytest.mark.slow
def test_bench_tracking_quickly(data, tmp_path):
    """One recording, kidnapped twice."""
    page = tmp_path / "tracking.md"
    command = [sys.executable, "scripts/bench_tracking.py", "--quick"]
    run = subprocess.run(
        [*command, "--only", "kidnap", "--markdown", str(page)],
        cwd=ROOT,
        env=os.environ | {"FSMSM_DATA": str(data)},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    for title in ("Kidnapped", "False alarms"):
        assert f"### {title}" in page.read_text()


@pytest.mark.slow
def test_reproduce_particles_quickly(tmp_path):
    """The parts that need no recordings."""
    page = tmp_path / "particles.md"
    command = [sys.executable, "scripts/reproduce_particles.py", "--quick"]
    run = subprocess.run(
        [*command, "--only", "corridor", "speed", "--markdown", str(page)],
        cwd=ROOT,
        env=os.environ | {"FSMSM_DATA": str(tmp_path / "no")},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert "updates/s" in page.read_text()
    assert "CORRIDOR" not in page.read_text()


@pytest.mark.slow
def test_reproduce_fsm_quickly(tmp_path):
    """In generated offices, where nothing published holds."""
    nothing = {"FSMSM_DATA": str(tmp_path / "no"), "FSMSM_GOLDEN": str(tmp_path / "no")}
    page = tmp_path / "fsm.md"
    command = [sys.executable, "scripts/reproduce_fsm.py", "--quick"]
    run = subprocess.run(
        [*command, "--only", "golden", "protocol", "--markdown", str(page)],
        cwd=ROOT,
        env=os.environ | nothing,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert "### Scan against scan: Position errors" in page.read_text()
    assert "generated offices" in page.read_text()
    assert "C++" not in page.read_text()  # its results are not at hand


@pytest.mark.slow
def test_reproduce_fmi_quickly(tmp_path):
    """Without maps a generated office stands in, and says so."""
    page = tmp_path / "fmi.md"
    command = [sys.executable, "scripts/reproduce_fmi.py", "--quick"]
    run = subprocess.run(
        [*command, "--only", "global", "--markdown", str(page)],
        cwd=ROOT,
        env=os.environ | {"FSMSM_DATA": str(tmp_path / "no")},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert "### generated office" in page.read_text()
    assert "in place of the thesis's maps" in run.stderr


@pytest.mark.slow
def test_reproduce_lslam_quickly(data, tmp_path):
    """Two filters of five particles, in simulation and on the car park."""
    page, pictures = tmp_path / "lslam.md", tmp_path / "pictures"
    command = [sys.executable, "scripts/reproduce_lslam.py", "--quick", "--out"]
    command += [str(pictures), "--markdown", str(page), "--only"]
    run = subprocess.run(
        [*command, "simulation", "carpark"],
        cwd=ROOT,
        env=os.environ | {"FSMSM_DATA": str(data)},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    for title in ("Simulation, 8 worlds", "Car park, as read", "as read: goals"):
        assert title in page.read_text()
    assert (pictures / "lslam_carpark_map.png").is_file()
