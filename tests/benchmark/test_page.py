"""Kept, compared, and told: baselines, the gate, and the README's table."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fsmsm_jax import benchmark
from fsmsm_jax.benchmark import Metric, Record, markdown, read_record, write_record
from fsmsm_jax.benchmark.page import BEGIN, END, with_page
from fsmsm_jax.cli.bench import bench

ROOT = Path(__file__).parents[2]
ROWS = [
    Metric("raycast/speed", 12.34, "Mrays/s", spread=[11.0, 13.0]),
    Metric("raycast/ratio", 1.5, "× reference", "lower", rel_tol=0.5),
    Metric("raycast/first_call", 2.0, "s", "lower"),
]
FACTS = {"device": "abacus, 10 cores", "commit": "abc1234"}


@pytest.fixture
def home(monkeypatch, tmp_path):
    """Small amounts, and a baseline that is not the committed one."""
    few = benchmark.Amounts(poses=16, scans=2, particles=100)
    monkeypatch.setattr(benchmark.Amounts, "of_device", classmethod(lambda cls: few))
    path = tmp_path / "cpu.json"
    monkeypatch.setattr(benchmark, "baseline_path", lambda: path)
    monkeypatch.setattr(benchmark, "baselines", lambda: [read_record(path)])
    return path


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "new" / "rows.json"
    write_record(path, ROWS)
    record = read_record(path)
    assert record.rows == ROWS
    assert {"commit", "device", "jax", "date"} <= record.circumstances.keys()


@pytest.mark.parametrize("text", [None, "", "{", "[]", '{"metrics": [{"colour": 1}]}'])
def test_what_is_no_record_is_refused(tmp_path, text):
    path = tmp_path / "rows.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match="--write-baseline"):
        read_record(path)


def test_markdown_has_a_row_for_everything_but_ratios():
    lines = markdown([Record(FACTS, ROWS), Record(FACTS, ROWS[:1])]).splitlines()
    assert len(lines) == 2 + 2 + 1
    assert lines[2] == (
        "| raycast/speed | 12.3 | Mrays/s | higher | 11.0 to 13.0 | abacus, 10 cores "
        "| abc1234 |"
    )


@pytest.mark.parametrize(
    "document", ["", BEGIN, f"{END}\n{BEGIN}", f"{BEGIN}{END}" * 2]
)
def test_a_page_without_its_marks_is_refused(document):
    with pytest.raises(ValueError, match="bench:begin"):
        with_page(document, "table")


def test_a_page_written_twice_is_the_same():
    once = with_page(f"before\n{BEGIN}\n{END}\nafter\n", "| a |")
    assert with_page(once, "| a |") == once
    assert once.startswith("before\n")
    assert once.endswith("\nafter\n")


def test_readme_shows_the_committed_baselines():
    document = (ROOT / "README.md").read_text()
    assert with_page(document, markdown(benchmark.baselines())) == document


def test_committed_baselines_know_every_stage():
    for record in benchmark.baselines():
        assert {row.section for row in record.rows} == set(benchmark.STAGES)
        gated = [row for row in record.rows if row.rel_tol is not None]
        assert len(gated) == len(benchmark.STAGES)


def test_bench_measures_writes_and_gates(home, tmp_path, capsys):
    """An honest baseline passes; a doctored one, of a machine ten times as fast, fails."""
    rows, page = tmp_path / "rows.json", tmp_path / "page.md"
    bench(quick=True, only=("raycast",), json=rows, markdown=True)
    said = capsys.readouterr().out
    assert "raycast/speed" in said
    assert "| raycast/speed |" in said
    record = json.loads(rows.read_text())

    home.write_text(json.dumps(record))
    page.write_text(f"# Speed\n{BEGIN}\n{END}\n")
    bench(page=page)
    assert "| raycast/first_call |" in page.read_text()
    assert capsys.readouterr().out == ""  # nothing was measured

    slower = [m | {"value": 10 * m["value"]} for m in record["metrics"]]
    home.write_text(json.dumps(record | {"metrics": slower}))
    bench(quick=True, only=("raycast",), gate=True)
    assert "no regressions" in capsys.readouterr().out

    faster = [m | {"value": 0.1 * m["value"]} for m in record["metrics"]]
    home.write_text(json.dumps(record | {"metrics": faster}))
    with pytest.raises(SystemExit) as stop:
        bench(quick=True, only=("raycast",), gate=True)
    assert stop.value.code == 1
    assert "REGRESSION raycast/ratio" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"only": ("flying",)}, "there is no stage flying: expected raycast"),
        ({"gate": True}, "--write-baseline"),  # there is none
        ({"gate": True, "write_baseline": True}, "not both"),
        ({"quick": True, "write_baseline": True}, "no --quick"),
    ],
)
def test_bench_refuses(home, options, message):
    with pytest.raises(ValueError, match=message):
        bench(**options)


@pytest.mark.slow
def test_script_quickly(tmp_path):
    command = [sys.executable, "scripts/benchmark.py", "--quick", "--only", "raycast"]
    run = subprocess.run(
        command, cwd=ROOT, env=dict(os.environ), capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert "raycast/speed" in run.stdout
