"""How fast is it, and is it slower than it was? This is `fsmsm bench`.

python scripts/benchmark.py                           # all stages on this device
python scripts/benchmark.py --quick --gate            # CI: no slower than before
python scripts/benchmark.py --plots pictures          # and how time grows
python scripts/benchmark.py --write-baseline --page README.md
"""

import sys

from fsmsm_jax.cli import main

if __name__ == "__main__":
    sys.exit(main(["bench", *sys.argv[1:]]))
