"""The tasks that come with the simulator; importing this registers them."""

from neurosim_core.learn.tasks import avoid, hover, hover_paper

__all__ = ["avoid", "hover", "hover_paper"]
