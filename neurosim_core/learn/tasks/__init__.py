"""The tasks that come with the simulator; importing this registers them."""

from neurosim_core.learn.tasks import avoid, gates, hover, hover_paper

__all__ = ["avoid", "gates", "hover", "hover_paper"]
