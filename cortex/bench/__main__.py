"""`python -m cortex.bench`."""

import sys

from cortex.bench.command import main

sys.exit(main())
