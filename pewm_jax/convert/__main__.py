"""``python -m pewm_jax.convert``: the former name of ``pewm-jax convert``."""

import sys

from pewm_jax.cli import convert

if __name__ == "__main__":
    sys.exit(convert.main())
