"""The tasks that come with the simulator; importing this registers them."""

from neurosim_core.learn.tasks import hover, hover_paper

__all__ = ["hover", "hover_paper"]
