"""Paths from a material and lights to radiance, one file each; `shade` chooses by the classes of both."""
