"""Lights: what they are physically, one file each. Tables that depend on a light are made where it is shaded with."""
