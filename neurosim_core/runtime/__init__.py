"""Tools that keep a device busy: streams, graphs, pinned memory, and wall-clock time by phase."""
