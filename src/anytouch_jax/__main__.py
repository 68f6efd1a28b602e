"""`python -m anytouch_jax`: the `anytouch` command."""

import sys

from anytouch_jax.cli import main

sys.exit(main())
