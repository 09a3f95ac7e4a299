"""What later stages take from inside models: formulas of lights, points of meshes, repairs of measured tables."""

from shisd.models._measured import fill_nearest as fill_nearest
from shisd.models._projected import symmetric as symmetric
from shisd.models._visibility import surface_corners as surface_corners
from shisd.models.lights._outline import facing as facing
from shisd.models.lights._outline import towards as towards
from shisd.models.lights._sphere import versine as versine
