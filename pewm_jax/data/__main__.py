"""``python -m pewm_jax.data``: the deprecated name of ``pewm-jax data``."""

import sys

from pewm_jax.cli import main

if __name__ == "__main__":
    sys.exit(main.deprecated("data"))
