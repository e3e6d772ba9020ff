"""The tasks that come with the simulator; importing this registers them."""

from neurosim_core.learn.tasks import avoid, dodge, gates, hover

__all__ = ["avoid", "dodge", "gates", "hover"]
