"""Controls chained: rates of two published cars, motions and noise against loops."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.slam import Car, DiffDrive, increment
from fsmsm_jax.slam.belief import PoseBelief, move
from tests.oracles import slam as oracle

UTE = Car(
    wheel_base=2.83,
    wheel_offset=0.76,
    tracked=(3.78, 0.5),
    trim=(1.1, -0.02),
    noise=(0.7, 0.12),
)
CONTROLS = np.array(
    [[2.0, 0.3, 0.4], [3.0, -0.2, 0.1], [0.0, 0.1, 0.2], [-1.0, 0.4, 0.5]]
)

chained = jax.jit(increment)


@pytest.fixture(autouse=True)
def _x64():
    with jax.enable_x64(True):
        yield


def ute_rates(speed, steering):
    return oracle.acfr_rates(speed, 1.1 * steering - 0.02, 2.83, 0.76, 3.78, 0.5)


def robot_rates(speed, turning):
    return np.array([speed, 0.0, turning])


VEHICLES = {"ute": (UTE, ute_rates), "robot": (DiffDrive((0.2, 0.3)), robot_rates)}


@pytest.mark.parametrize(("vehicle", "rates"), VEHICLES.values(), ids=VEHICLES)
def test_motion_and_noise_are_those_of_a_loop(vehicle, rates):
    found = chained(vehicle, jnp.asarray(CONTROLS))
    np.testing.assert_allclose(found.pose, oracle.drive_on(rates, CONTROLS), atol=1e-12)
    expected = oracle.drive_noise(rates, CONTROLS, vehicle.noise)
    # Differences of 1e-5 err by 1e-10 of numbers near 1.
    np.testing.assert_allclose(found.covariance, expected, atol=1e-9)


def test_rates_are_the_utes_and_baileys():
    control = jnp.array([3.0, 0.25])
    np.testing.assert_allclose(UTE.rates(control), ute_rates(3.0, 0.25), rtol=1e-12)
    # T. Bailey: the front axle moves with the wheel, x += V dt cos(G + φ), φ += V dt sin(G) / WB.
    front = Car(wheel_base=4.0, tracked=(4.0, 0.0), front_wheel=True)
    expected = [3 * np.cos(0.25), 3 * np.sin(0.25), 3 * np.sin(0.25) / 4]
    np.testing.assert_allclose(front.rates(control), expected, rtol=1e-12)


def test_noise_is_that_of_many_drives():
    """To first order: noise a tenth of the published leaves second-order terms of 1 %."""
    quiet, many = 0.1 * np.array(UTE.noise), 4000
    controls = np.tile([3.0, 0.1, 0.1], (8, 1))
    rng = np.random.default_rng(0)
    said = np.tile(controls, (many, 1, 1))
    said[..., :2] += rng.normal(size=(many, 8, 2)) * quiet
    ends = np.asarray(
        jax.jit(jax.vmap(lambda u: increment(UTE, u).pose))(jnp.asarray(said))
    )
    found = chained(
        eqx.tree_at(lambda car: car.noise, UTE, tuple(quiet)), jnp.asarray(controls)
    )
    sigma = np.sqrt(np.diag(found.covariance))
    # A sample's covariance errs by √(2 / 4000) = 2.2 %: five of these.
    np.testing.assert_allclose(
        np.cov(ends.T) / np.outer(sigma, sigma),
        found.covariance / np.outer(sigma, sigma),
        atol=0.11,
    )
    np.testing.assert_allclose(
        (ends.mean(0) - found.pose) / sigma, 0, atol=5 / np.sqrt(many) + 0.01
    )


@pytest.mark.parametrize("where", [0, 2, 4])
def test_padding_moves_nothing(where):
    """Nor does a control that is not finite."""
    expected = chained(UTE, jnp.asarray(CONTROLS))
    for row in (
        [3.0, 0.4, 0.0],
        [np.nan, 0.1, 0.2],
        [1.0, np.inf, 0.2],
        [1.0, 0.1, np.nan],
    ):
        padded = jnp.asarray(np.insert(CONTROLS, where, row, axis=0))
        for a, b in zip(chained(UTE, padded), expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-15)


def test_no_controls_are_no_motion():
    for a in chained(UTE, jnp.zeros((0, 3))):
        np.testing.assert_array_equal(a, np.zeros_like(a))


def test_a_drive_in_two_halves_is_the_whole():
    """Increments chain by `belief.move`, noise included."""
    belief = PoseBelief(jnp.array([31.0, -17.0, 2.2]), jnp.zeros((3, 3)))
    onward = jax.jit(move)
    whole = onward(belief, chained(UTE, jnp.asarray(CONTROLS)))
    for part in (CONTROLS[:2], CONTROLS[2:]):
        belief = onward(belief, chained(UTE, jnp.asarray(part)))
    np.testing.assert_allclose(belief.mean, whole.mean, atol=1e-12)
    np.testing.assert_allclose(belief.covariance, whole.covariance, atol=1e-12)
