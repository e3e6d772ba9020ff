"""Sensors: what turns the state of a vehicle, or the picture that it sees, into packets."""
