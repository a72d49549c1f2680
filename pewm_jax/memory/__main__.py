"""``python -m pewm_jax.memory``: the deprecated name of ``pewm-jax memory``."""

import sys

from pewm_jax.cli import main

if __name__ == "__main__":
    sys.exit(main.deprecated("memory"))
