"""SLAM with landmarks: no map is given, it grows while the vehicle drives.

In reading order: `vehicle` chains controls, `sensor` makes a detection linear,
`belief` is what a particle knows of its pose, `landmarks` of the map, `association` of
which detection is which. `factored` (FastSLAM, L-SLAM) and `joint` (EKF-SLAM) put them
together for one particle, `filter` for all of them: `init`, `step`, `run`.
"""

from fsmsm_jax.slam.vehicle import (
    Car as Car,
    DiffDrive as DiffDrive,
    Increment as Increment,
    Vehicle as Vehicle,
    increment as increment,
)
from fsmsm_jax.slam.sensor import RangeBearing as RangeBearing
from fsmsm_jax.slam.drive import Drive as Drive, tidied as tidied
from fsmsm_jax.slam.association import Association as Association
from fsmsm_jax.slam.methods import METHODS as METHODS, Method as Method, Name as Name
from fsmsm_jax.slam.filter import (
    Info as Info,
    SlamConfig as SlamConfig,
    State as State,
    init as init,
    run as run,
    step as step,
)
from fsmsm_jax.slam.simulate import (
    Circle as Circle,
    Simulated as Simulated,
    scatter as scatter,
    simulate as simulate,
)
