"""The processes of the live stack, which talk over Cortex. Only modules in here import it."""
