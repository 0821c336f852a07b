"""Trajectories as TUM files: `t x y z qx qy qz qw`, a pose a line, as evo reads them.

A planar pose has z = 0 and turns about z only. `TumWriter` puts each pose on the disk
as soon as it is known, so that a run that dies leaves its trajectory so far:

    with TumWriter("run.tum") as out:
        out.write(stamp, pose)
"""

from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Array, Float, ScalarLike

from fsmsm_jax.io.frames import yaw
from fsmsm_jax.io.tables import rows_of

__all__ = ["TumWriter", "read_tum", "write_tum"]


class TumWriter:
    """Writes poses one by one; each is on the disk when `write` returns."""

    def __init__(self, path: str | Path):
        self._file = Path(path).open("w", encoding="utf-8")

    def __enter__(self) -> "TumWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; what was written stays."""
        self._file.close()

    def write(
        self, stamp: ScalarLike, pose: Float[np.ndarray, "3"] | Float[Array, "3"]
    ) -> None:
        """One line, or none if the pose is not finite.

        Args:
            stamp: time [s].
            pose: [m, m, rad], in the frame of the map as a rule.

        Raises:
            ValueError: the stamp is not finite; the file is closed.
        """
        stamp = float(np.asarray(stamp))
        if not np.isfinite(stamp):
            raise ValueError(f"a pose in a TUM file needs a finite time, got {stamp}")
        x, y, theta = np.asarray(pose, float)
        if not np.isfinite([x, y, theta]).all():
            return
        turn = f"{np.sin(theta / 2):.9f} {np.cos(theta / 2):.9f}"
        self._file.write(f"{stamp:.9f} {x:.6f} {y:.6f} 0 0 0 {turn}\n")
        self._file.flush()


def write_tum(
    path: str | Path,
    stamps: Float[np.ndarray, "stamps"],
    poses: Float[np.ndarray, "as_many 3"] | Float[Array, "as_many 3"],
) -> None:
    """A whole trajectory; poses that are not finite are left out.

    Args:
        path: the file, replaced if it exists.
        stamps: times [s].
        poses: [m, m, rad].

    Raises:
        ValueError: not as many stamps as poses, or a stamp that is not finite.
    """
    poses = np.asarray(poses)
    if poses.shape != (len(stamps), 3):
        raise ValueError(
            f"{len(stamps)} stamps need poses of shape ({len(stamps)}, 3), "
            f"got {poses.shape}"
        )
    with TumWriter(path) as out:
        for stamp, pose in zip(stamps, poses, strict=True):
            out.write(stamp, pose)


def read_tum(
    path: str | Path,
) -> tuple[Float[np.ndarray, "poses"], Float[np.ndarray, "poses 3"]]:
    """The stamps [s] and planar poses [m, m, rad] of a TUM file.

    Lines that begin with # are comments. A last line that was torn off is left out.

    Raises:
        ValueError: the file is missing, or another line is no pose.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no trajectory at {path}")

    def whole(fields):
        row = [float(field) for field in fields]
        if len(row) != 8:
            raise ValueError(f"{len(row)} numbers instead of 8")
        return row

    rows = rows_of(path, whole, " is no `t x y z qx qy qz qw`")
    table = np.array(rows, float).reshape(-1, 8)
    return table[:, 0], np.column_stack([table[:, 1:3], yaw(table[:, 4:])])
