"""The settings of an event camera from recordings of a real one."""
