"""What a lidar is, and what one turn of it says.

A real scan is dirty: NaN, inf, 0.0, readings below the minimum or beyond the
maximum, rays in any order over any field of view. `Scan.from_ranges` sorts this
out once, at the boundary, into three kinds of ray:

- an **echo**: something stands at `ranges[n]` (`valid` and `echo`);
- **no echo within range**: information too, the space is free up to `range_max`
  (`valid`, not `echo`; the range is set to `range_max`);
- **invalid**: the sensor says nothing (not `valid`; range set to `range_max` so
  that no NaN travels on, and every sum masks it).

Bearings are in the sensor frame [rad], counter-clockwise, in the order in which
they came: a negative increment, [0, 2π) or [−π, π] layouts all work.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

__all__ = ["Lidar", "Scan"]


class Scan(eqx.Module):
    """One turn of a lidar; build one with `Scan.from_ranges`."""

    ranges: Float[Array, "rays"]
    """Measured ranges [m]; `range_max` where there was no echo or no information."""
    bearings: Float[Array, "rays"]
    """Directions of the rays in the sensor frame [rad], counter-clockwise."""
    valid: Bool[Array, "rays"]
    """Whether the ray says anything at all."""
    echo: Bool[Array, "rays"]
    """Whether the ray met something within range (implies `valid`)."""
    range_max: Float[Array, ""]
    """Farthest distance at which the sensor notices an obstacle [m]."""

    @classmethod
    def from_ranges(
        cls,
        ranges: Sequence | np.ndarray | Array,
        angle_min: float,
        angle_increment: float,
        range_min: float = 0.0,
        range_max: float = 30.0,
    ) -> "Scan":
        """A scan from the fields of a ROS `LaserScan`.

        Args:
            ranges: (rays,) ranges [m]. NaN, −inf, 0.0 and readings under `range_min`
                are invalid; +inf and readings from `range_max` on are "no echo".
            angle_min: bearing of the first ray [rad].
            angle_increment: step from ray to ray [rad], negative if clockwise.
            range_min: smallest range that the sensor measures [m].
            range_max: largest range that the sensor measures [m].

        Raises:
            ValueError: the ranges are not one row, are empty, or no ray holds
                information; an angle is not finite; the limits are not
                0 ≤ range_min < range_max.

        Example:
            >>> scan = Scan.from_ranges([1.0, np.inf, 0.0, np.nan], 0.0, 1.5, 0.1, 8.0)
            >>> scan.valid.tolist(), scan.echo.tolist()
            ([True, True, False, False], [True, False, False, False])
        """
        if not (
            np.isfinite(angle_min)
            and np.isfinite(angle_increment)
            and angle_increment != 0
        ):
            raise ValueError(
                "angle_min and angle_increment must be finite and the increment not 0, "
                f"got {angle_min} and {angle_increment}"
            )
        bearings = angle_min + angle_increment * np.arange(np.size(ranges))
        return cls.from_bearings(ranges, bearings, range_min, range_max)

    @classmethod
    def from_bearings(
        cls,
        ranges: Sequence | np.ndarray | Array,
        bearings: Sequence | np.ndarray | Array,
        range_min: float = 0.0,
        range_max: float = 30.0,
    ) -> "Scan":
        """A scan whose rays point in any directions; see `from_ranges`.

        Raises:
            ValueError: as `from_ranges`; also bearings of another shape than the
                ranges, or not finite.
        """
        ranges = np.asarray(ranges, float)
        bearings = np.asarray(bearings, float)
        if ranges.ndim != 1 or ranges.size == 0:
            raise ValueError(
                f"a scan is one non-empty row of ranges, got shape {ranges.shape}"
            )
        if bearings.shape != ranges.shape:
            raise ValueError(
                f"one bearing a range: expected shape {ranges.shape}, "
                f"got {bearings.shape}"
            )
        if not np.isfinite(bearings).all():
            raise ValueError(
                f"{np.sum(~np.isfinite(bearings))} bearings are not finite; "
                "every ray needs one"
            )
        if not (np.isfinite(range_max) and 0 <= range_min < range_max):
            raise ValueError(
                "range limits must be 0 ≤ range_min < range_max, "
                f"got {range_min} and {range_max}"
            )
        with np.errstate(invalid="ignore"):
            valid = (ranges >= range_min) & (ranges > 0)
            echo = valid & (ranges < range_max)
        if not valid.any():
            raise ValueError(
                f"none of the {ranges.size} rays holds information (all NaN, −inf, 0 "
                f"or under range_min = {range_min}); check the units (metres) and the "
                "driver"
            )
        # Not by asarray: that is a program, and each number of rays another one.
        real = jax.dtypes.canonicalize_dtype(float)
        put = lambda values, dtype: jax.device_put(np.array(values, dtype))
        return cls(
            ranges=put(np.where(echo, ranges, range_max), real),
            bearings=put(bearings, real),
            valid=put(valid, bool),
            echo=put(echo, bool),
            range_max=put(range_max, real),
        )

    @property
    def points(self) -> Float[Array, "rays 2"]:
        """End points in the sensor frame [m]; they mean something where `echo`."""
        return self.ranges[..., None] * jnp.stack(
            [jnp.cos(self.bearings), jnp.sin(self.bearings)], axis=-1
        )

    def thin(self, rays: int) -> "Scan":
        """A scan of `rays` rays spread evenly over the informative ones.

        Fixed shape, so that scans of any length meet one compiled function; rays
        repeat evenly where the scan has fewer informative ones than asked for.
        """
        informative_first = jnp.argsort(~self.valid, stable=True)
        count = jnp.maximum(jnp.sum(self.valid), 1)
        chosen = informative_first[(jnp.arange(rays) * count) // rays]
        return Scan(
            ranges=self.ranges[chosen],
            bearings=self.bearings[chosen],
            valid=self.valid[chosen],
            echo=self.echo[chosen],
            range_max=self.range_max,
        )


class Lidar(eqx.Module):
    """A simulated sensor: where its rays point, how far it sees, how noisy it is."""

    bearings: Float[Array, "rays"]
    """Directions of the rays in the sensor frame [rad], counter-clockwise."""
    range_max: Float[Array, ""]
    """Farthest measurable range [m]."""
    noise: Float[Array, ""]
    """Standard deviation of a range [m]."""
    dropout: Float[Array, ""]
    """Probability that a ray returns nothing at all (invalid)."""
    outliers: Float[Array, ""]
    """Probability that something unmapped stands somewhere along the ray."""

    @classmethod
    def create(
        cls,
        rays: int = 360,
        field_of_view: float = 2 * np.pi,
        range_max: float = 30.0,
        noise: float = 0.01,
        dropout: float = 0.0,
        outliers: float = 0.0,
    ) -> "Lidar":
        """An equiangular lidar looking forward, ray 0 at −field_of_view / 2.

        A full circle has rays at −π + 2πn/rays (no direction twice); a partial
        view includes both its edges.

        Raises:
            ValueError: fewer than 3 rays, a field of view outside (0, 2π], a
                range limit that is not positive, negative noise, or a
                probability outside [0, 1].
        """
        if rays < 3:
            raise ValueError(f"a lidar needs at least 3 rays, got {rays}")
        if not 0 < field_of_view <= 2 * np.pi + 1e-9:
            raise ValueError(
                f"field_of_view must lie in (0, 2π] rad, got {field_of_view}"
            )
        if not (np.isfinite(range_max) and range_max > 0 and noise >= 0):
            raise ValueError(
                f"expected range_max > 0, noise ≥ 0, got {range_max} and {noise}"
            )
        if not (0 <= dropout <= 1 and 0 <= outliers <= 1):
            raise ValueError(
                f"probabilities must lie in [0, 1], got {dropout} and {outliers}"
            )
        full = field_of_view > 2 * np.pi - 1e-6
        bearings = np.linspace(
            -field_of_view / 2, field_of_view / 2, rays, endpoint=not full
        )
        return cls(
            bearings=jnp.asarray(bearings, float),
            range_max=jnp.asarray(range_max, float),
            noise=jnp.asarray(noise, float),
            dropout=jnp.asarray(dropout, float),
            outliers=jnp.asarray(outliers, float),
        )

    def measure(self, key: PRNGKeyArray, exact: Float[Array, "rays"]) -> Scan:
        """A scan as this sensor would report the exact ranges (`raycast`'s) [m].

        Gaussian noise on echoes, some rays shortened by unmapped things, some
        lost: the noise models of the simulations.
        """
        key_noise, key_drop, key_out, key_where = jax.random.split(key, 4)
        shape, dtype = exact.shape, exact.dtype
        noisy = exact + self.noise * jax.random.normal(key_noise, shape, dtype)
        short = exact * jax.random.uniform(key_where, shape, dtype, 0.02, 1.0)
        blocked = jax.random.bernoulli(key_out, self.outliers, shape)
        ranges = jnp.where(blocked, short, noisy)
        valid = ~jax.random.bernoulli(key_drop, self.dropout, shape) & (ranges > 0)
        # No echo is what the geometry says, not what the noise does to 30.0 m.
        echo = valid & ((exact < self.range_max) | blocked) & (ranges < self.range_max)
        return Scan(
            ranges=jnp.where(echo, ranges, self.range_max),
            bearings=self.bearings,
            valid=valid,
            echo=echo,
            range_max=self.range_max,
        )
