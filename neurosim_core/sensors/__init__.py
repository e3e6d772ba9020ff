"""The sensors, one file for each kind."""
