"""Slices of materials, by view: what they are, how they are made, and how they fit above the horizon."""
