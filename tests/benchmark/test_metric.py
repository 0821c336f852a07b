"""Rows: which way is better, and what counts as worse."""

import math

import pytest

from fsmsm_jax.benchmark import Metric, regressions


@pytest.mark.parametrize(
    ("direction", "value", "met"),
    [
        ("higher", 10.0, True),
        ("higher", 9.9, False),
        ("lower", 10.0, True),
        ("lower", 10.1, False),
        ("higher", math.nan, False),
        ("lower", math.nan, False),
    ],
)
def test_goal(direction, value, met):
    assert Metric("a/b", value, "ms", direction, goal=10.0).met is met


def test_a_row_without_a_goal_has_not_met_it_nor_missed_it():
    assert Metric("a/b", 1.0, "ms").met is None


@pytest.mark.parametrize(
    ("direction", "fine", "worse"), [("higher", 5.1, 4.9), ("lower", 14.9, 15.1)]
)
def test_worse_by_more_than_the_tolerance(direction, fine, worse):
    was = Metric("a/b", 10.0, "ms", direction, rel_tol=0.5)
    assert regressions([was._replace(value=fine)], [was]) == []
    (text,) = regressions([was._replace(value=worse)], [was])
    assert "a/b" in text
    assert "would do" in text


def test_nothing_measured_is_a_regression():
    was = Metric("a/b", 10.0, "ms", "lower", rel_tol=0.5)
    assert regressions([was._replace(value=math.nan)], [was])


def test_rows_without_a_tolerance_are_not_held_to_anything():
    was = Metric("a/b", 10.0, "s", "lower")
    assert regressions([was._replace(value=1e6)], [was]) == []


def test_a_row_that_is_gone_and_a_section_that_did_not_run():
    was = [Metric("a/b", 1.0, "s"), Metric("a/c", 1.0, "s"), Metric("d/e", 1.0, "s")]
    (text,) = regressions(was[:1], was)
    assert text.startswith("a/c is in the baseline")
