"""The processes of the live stack, which talk over Cortex. Only modules in here import it."""

from neurosim_core.install import check_cortex

check_cortex()
