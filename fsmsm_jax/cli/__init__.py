"""The command line: `fsmsm localise MAP LOG`, `match`, `track`, `odometry`, `slam`.

All end in a picture, as does `demo`. `localise` reads a map_server map and one scan of
a log (rosbag, CARMEN or .npz) and says where it was taken, how surely, and what else it
could have been; `match` says so more quickly where a first estimate is at hand; `track`
follows the lidar through a whole log; `odometry` says how it moved, from a log without
any map; `slam` makes a map of the landmarks that a log holds ranges and bearings of.
`--json` says it to a program. Text and JSON go to stdout, progress to stderr. An error
is one line on stderr and exit status 2; Ctrl-C is exit status 130.

Compiled programs are kept in $XDG_CACHE_HOME/fsmsm_jax (~/.cache/fsmsm_jax), which
takes seconds off every run but the first; FSMSM_NO_CACHE=1 turns that off, and
JAX_COMPILATION_CACHE_DIR moves it.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import tyro

from fsmsm_jax.cli.localise import localise
from fsmsm_jax.cli.match import match
from fsmsm_jax.cli.track import track
from fsmsm_jax.cli.odometry import odometry
from fsmsm_jax.cli.slam import slam
from fsmsm_jax.cli.demo import demo

__all__ = ["demo", "localise", "main", "match", "odometry", "slam", "track"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status is 0, 2 after an error, 130 after Ctrl-C."""
    try:
        _keep_compiled_programs()
        tyro.extras.subcommand_cli_from_dict(
            {
                "localise": localise,
                "match": match,
                "track": track,
                "odometry": odometry,
                "slam": slam,
                "demo": demo,
            },
            prog="fsmsm",
            description="Where is my lidar? 2D lidar localisation against a map.",
            args=arguments,
            config=(
                tyro.conf.FlagCreatePairsOff,
                tyro.conf.PositionalMetavarFromFieldName,
            ),
        )
    except (ValueError, OSError, ImportError) as error:
        print(f"fsmsm: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("fsmsm: interrupted", file=sys.stderr)
        return 130
    return 0


def _keep_compiled_programs() -> None:
    """Point JAX's compilation cache at the user's folder, if that can be written."""
    if {"FSMSM_NO_CACHE", "JAX_COMPILATION_CACHE_DIR"} & os.environ.keys():
        return
    root = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(root) / "fsmsm_jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
