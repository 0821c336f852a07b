"""The filters as programs: dirty input, jit, vmap, gradients."""

import inspect
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.slam import (
    Association,
    Car,
    Drive,
    RangeBearing,
    SlamConfig,
    init,
    run,
    step,
)
from tests.slam.scene import SLOTS, START, begin, drive, filter_of, frame, steps

NAN, INF = np.nan, np.inf
quick = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def all_finite(tree):
    leaves = [a for a in jax.tree.leaves(tree) if jnp.issubdtype(a.dtype, jnp.floating)]
    return all(bool(jnp.all(jnp.isfinite(a))) for a in leaves)


def dirty():
    """The same drive, spoilt at the third step; by name."""
    clean = jax.tree.map(np.asarray, drive())
    detections = {
        "zero range": (slice(0, 2), [0.0, 0.4]),
        "negative range": (0, [-3.0, 0.4]),
        "nan": (0, [NAN, NAN]),
        "nan bearing": (slice(None), [5.0, NAN]),
        "infinite": (0, [INF, 0.0]),
        "a millimetre": (0, [1e-3, 0.0]),
        "far": (0, [1e6, 0.0]),
        "farther": (0, [1e12, 0.0]),
        "past float32": (0, [1e30, 0.0]),
        "many turns": (0, [9.0, 1e5]),
    }
    controls = {
        "steering nan": [1.0, NAN, 0.2],
        "speed infinite": [INF, 0.1, 0.2],
        "time nan": [1.0, 0.1, NAN],
        "a right angle": [1.0, np.pi / 2, 0.2],
        "too fast": [1e20, 0.1, 0.2],
    }
    cases = {"clean": clean, "blind": clean._replace(valid=np.zeros_like(clean.valid))}
    cases["one landmark"] = clean._replace(ids=np.zeros_like(clean.ids))
    cases["ids beyond"] = clean._replace(ids=clean.ids + 4)
    cases["ids below"] = clean._replace(ids=np.full_like(clean.ids, -2))
    for name, (column, value) in detections.items():
        spoilt = clean.detections.copy()
        spoilt[2, column] = value
        cases[name] = clean._replace(detections=spoilt)
    for name, value in controls.items():
        spoilt = clean.controls.copy()
        spoilt[2, 1] = value
        cases[name] = clean._replace(controls=spoilt)
    return cases


UNKNOWN = Association()
CASES = dirty()
HARMLESS = ["clean", "blind", "zero range", "negative range", "nan", "nan bearing", "infinite",
            "steering nan", "speed infinite", "time nan"]  # fmt: skip


@pytest.mark.parametrize(
    ("method", "association"),
    [
        ("ekf", None),
        ("fastslam1", None),
        ("fastslam2", UNKNOWN),
        ("lslam2", UNKNOWN),
        ("lslam2_joint", UNKNOWN),
    ],
)
def test_it_stays_finite_whatever_comes(method, association):
    config = filter_of(method, association)
    state = begin(config)
    many = Drive(
        *(
            jnp.stack([jnp.asarray(a) for a in field])
            for field in zip(*CASES.values(), strict=True)
        )
    )
    after, infos = quick(jax.vmap(lambda log: run(config, state, log)))(many)
    for n, name in enumerate(CASES):
        info = frame(infos, n)
        assert all_finite(frame((after.particles, after.log_weight), n)), name
        assert all_finite(info), name
        if name in HARMLESS:
            assert bool(jnp.all(info.usable)), name
            error = np.linalg.norm(info.pose[-1, :2] - infos.pose[0, -1, :2])
            assert error < 1.0, name  # of 5 m; noises are 0.1 to 0.4 a step
    known = np.array(infos.known)
    names = list(CASES)
    assert known[names.index("blind")].tolist() == [0] * 5
    matched = np.array(infos.matched)
    assert matched[0].tolist()[0] == 0  # on the first look all are new
    assert (matched[0][1:] >= 2).all()
    if association is None:
        assert known[names.index("one landmark")].tolist() == [1] * 5
        assert known[names.index("ids below")].tolist() == [0] * 5
        unplaced = np.array(infos.unplaced)[names.index("ids beyond")]
        expected = np.sum(
            np.asarray(CASES["ids beyond"].ids >= SLOTS) & CASES["clean"].valid, 1
        )
        assert unplaced.tolist() == expected.tolist()


def test_one_particle_and_one_slot():
    config = filter_of("lslam", UNKNOWN, particles=1, landmarks=1)
    state, info = run(config, begin(config), drive())
    assert all_finite((state.particles, info))
    assert info.known.tolist() == [1] * 5
    assert int(info.unplaced[0]) == 3


def test_no_columns_of_detections_and_controls():
    config = filter_of("lslam", particles=1, landmarks=1)
    log = Drive(*(a[:, :0] for a in drive()))
    state, _ = step(config, begin(config), frame(log, 0))
    np.testing.assert_allclose(state.particles.belief.mean[0], START, atol=1e-5)
    assert not bool(jnp.any(state.particles.landmarks.known))


def test_many_seeds_are_a_loop():
    """`run` of three seeds at once, against `step` by `step`.

    Sums in another order differ by 2e-6 m, as coordinates of 40 m do.
    """
    config, log = filter_of("lslam"), drive()
    states = [begin(config, seed) for seed in range(3)]
    many = jax.tree.map(lambda *a: jnp.stack(a), *states)
    _, together = quick(jax.vmap(lambda state: run(config, state, log)))(many)
    for n, state in enumerate(states):
        alone = [info.pose for *_, info in steps(config, log, state)]
        np.testing.assert_allclose(jnp.stack(alone), together.pose[n], atol=1e-4)
    assert np.std(np.asarray(together.pose)[:, -1, 0]) > 1e-3


def test_the_evidence_has_a_gradient():
    """By trim and noises, of a whole drive of the EKF: central differences.

    Also at the origin, where free slots lie under the vehicle."""
    with jax.enable_x64(True):
        log = drive()

        def evidence(numbers, start):
            offset, speed, steering, distance = numbers
            car = Car(trim=(1.0, offset), noise=(speed, steering))
            told = SlamConfig(
                "ekf", 1, SLOTS, car, RangeBearing((distance, 0.02)), None
            )
            return jnp.sum(run(told, begin(told, start=start), log)[1].log_evidence)

        slope = quick(jax.value_and_grad(evidence))
        at, h = jnp.array([0.01, 0.4, 0.05, 0.1]), 1e-5
        for start in (jnp.asarray(START), jnp.zeros(3)):
            value = lambda at, start=start: slope(at, start)[0]
            slopes = [
                (value(at + h * e) - value(at - h * e)) / (2 * h) for e in jnp.eye(4)
            ]
            # Third derivatives of 1e3 times h², and rounding of 1e-14 over h.
            np.testing.assert_allclose(
                slope(at, start)[1], slopes, rtol=1e-5, atol=1e-5
            )


def test_the_contract():
    assert list(inspect.signature(init).parameters) == [
        "config",
        "key",
        "start",
        "covariance",
    ]
    assert list(inspect.signature(step).parameters) == ["config", "state", "frame"]
    assert list(inspect.signature(run).parameters) == ["config", "state", "drive"]
    assert SlamConfig("ekf", particles=40).particles == 1
    with pytest.raises(
        ValueError, match="at least one particle and one landmark, got 0 and 64"
    ):
        SlamConfig(particles=0)
    with pytest.raises(ValueError, match="got 40 and 0"):
        SlamConfig(landmarks=0)
