"""Where a scan cannot come from, whichever way the sensor looked.

Turning a sensor permutes its ranges and changes none. So count them: how many rays end
in each *shell*, a ring of half a metre around the sensor. A place whose panorama has
two rays between 9 and 10 m cannot explain a scan with fifty of them there. With m the
map's counts and s the scan's, both of a circle of as many rays, no heading explains
more than

    E = Σ_b min(s_b, m_b) / Σ_b s_b

of the echoes. A scan of half the circle asks for half the rays, and the map may have
more: the bound holds for every field of view. The map's counts are those of a shell and
both beside it, since the sensor stands up to half a lattice diagonal off the node.

Places that explain too little are dropped before anything is correlated. People and
moved furniture lower E at the right place as well, so the limit sinks with the best E
of the map. What that loses and saves: `scripts/bench_localisation.py --only pruning`.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.sensing.panorama import panorama

__all__ = ["bins", "places_left", "scan_shells", "shells"]

_WIDTH = 0.5  # of a shell [m]
_LEAST = 0.85  # E of places that are kept in any case ...
_BEHIND = 0.15  # ... as are those so little behind the best


def bins(reach: float) -> int:
    """How many shells there are within the reach [m] of an atlas."""
    return int(np.ceil(reach / _WIDTH))


def shells(ranges: Float[Array, "rays"], reach: float) -> UInt8[Array, "bins"]:
    """Rays of a panorama in each shell and both beside it.

    Args:
        ranges: of the panorama [m]; those beyond the reach are in none.
        reach: [m]; static.
    """
    # One more than asked for: the last shell, too, has one beside it.
    count = _counts(ranges, jnp.ones(ranges.shape, bool), bins(reach) + 1)
    around = jnp.pad(count, (1, 0))
    three = around[:-2] + around[1:-1] + around[2:]
    return jnp.minimum(three, 255).astype(jnp.uint8)


def scan_shells(scan: Scan, rays: int, reach: float) -> Int[Array, "bins"]:
    """Echoes of a scan in each shell, of a circle of so many rays."""
    turn = panorama(scan, rays)
    return _counts(turn.ranges, turn.echo, bins(reach))


def _counts(ranges, counted, number):
    shell = jnp.floor(ranges / _WIDTH).astype(int)
    inside = counted[:, None] & (shell[:, None] == jnp.arange(number)[None, :])
    return jnp.sum(inside, axis=0)


def places_left(
    scan: Int[Array, "bins"], places: UInt8[Array, "*places bins"]
) -> Bool[Array, "*places"]:
    """Which places may explain the scan, if it is turned the right way.

    Args:
        scan: its echoes by shell.
        places: rays by shell and both beside it; all zeros where none can stand.
    """
    most = jnp.minimum(scan, 255).astype(jnp.uint8)
    same = jnp.minimum(places, jnp.broadcast_to(most, places.shape))
    explained = jnp.sum(same, axis=-1, dtype=jnp.int32)
    share = explained / jnp.maximum(jnp.sum(scan), 1)
    return share >= jnp.minimum(_LEAST, jnp.max(share) - _BEHIND)
