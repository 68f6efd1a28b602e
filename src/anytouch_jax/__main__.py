"""`python -m anytouch_jax`: the `anytouch` command."""

import sys

from anytouch_jax.cli.app import console

sys.exit(console())
