"""``python -m pewm_jax.memory``: the former name of ``pewm-jax memory``."""

import sys

from pewm_jax.cli import memory

if __name__ == "__main__":
    sys.exit(memory.main())
