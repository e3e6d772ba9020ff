"""`python -m neurosim_core` is the command `neurosim`."""

import sys

from neurosim_core.cli import main

sys.exit(main())
