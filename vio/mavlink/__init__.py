"""Poses to a flight controller by MAVLink."""
