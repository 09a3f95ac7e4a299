"""Unit vectors, frames and motions."""

import numpy as np


def unit(vectors):
    """In extended precision."""
    x = np.asarray(vectors, np.longdouble)
    return x / np.sqrt(np.sum(x * x, axis=-1, keepdims=True))


def frame_of(normal):
    """Any frame (rows) whose last axis is the normal, in extended precision."""
    normal = unit(normal)
    x = unit(np.cross(normal, np.array([0.3, 0.5, -0.7], np.longdouble)))
    return np.stack([x, np.cross(normal, x), normal])


def tangential(rng, directions):
    """Random motions along the sphere."""
    u = np.asarray(directions, float)
    u = u / np.linalg.norm(u, axis=-1, keepdims=True)
    move = rng.normal(size=u.shape)
    return move - np.sum(move * u, axis=-1, keepdims=True) * u
