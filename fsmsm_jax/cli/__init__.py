"""The command line: `fsmsm localise MAP LOG`, `match`, `track`, `odometry`, `slam`.

`localise` reads a map_server map and one scan of a log (rosbag, CARMEN or .npz) and
says where it was taken, how surely, and what else it could have been; `match` says so
more quickly where a first estimate is at hand; `track` follows the lidar through a
whole log; `odometry` says how it moved, from a log without any map; `slam` makes a map
of the landmarks that a log holds ranges and bearings of. All end in a picture, as does
`demo`. `export` writes a tracker or a query into one file, for a robot; `bench` says
how fast everything is here.
`--json` says it to a program. Text and JSON go to stdout, progress to stderr. An error
is one line on stderr and exit status 2; Ctrl-C is exit status 130.

Compiled programs are kept in $XDG_CACHE_HOME/fsmsm_jax (~/.cache/fsmsm_jax), which
takes many seconds off every run but the first; FSMSM_NO_CACHE=1 turns that off, and
JAX_COMPILATION_CACHE_DIR moves it. A command's module, and all that only it needs, is
imported when it is asked for.
"""

import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module

import tyro

from fsmsm_jax.cli.console import keep_compiled_programs

__all__ = ["COMMANDS", "main", "run"]

COMMANDS = (
    "localise",
    "match",
    "track",
    "odometry",
    "slam",
    "export",
    "bench",
    "demo",
)
"""Each the function of this name in the module of this name."""
_SETTINGS = (tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status is 0, 2 after an error, 130 after Ctrl-C."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        keep_compiled_programs()
        if words and words[0] in COMMANDS:
            name, *words = words
            tyro.cli(
                _function(name), prog=f"fsmsm {name}", args=words, config=_SETTINGS
            )
        else:
            tyro.extras.subcommand_cli_from_dict(
                {name: _function(name) for name in COMMANDS},
                prog="fsmsm",
                description="Where is my lidar? 2D lidar localisation against a map.",
                args=words,
                config=_SETTINGS,
            )
    except (ValueError, OSError, ImportError) as error:
        print(f"fsmsm: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("fsmsm: interrupted", file=sys.stderr)
        return 130
    return 0


def run() -> None:
    """`main` for the shell: at its end the process goes at once.

    The system frees memory faster than the interpreter, which would take a tenth of the
    time of a whole `localise` to take JAX apart.
    """
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _function(name: str) -> Callable[..., None]:
    return getattr(import_module(f"fsmsm_jax.cli.{name}"), name)
