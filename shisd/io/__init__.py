"""Files: environment maps (OpenEXR, Radiance), MERL materials, and PNG images.

Reading never trusts a file: only ordinary files are opened, sizes are checked against what the header promises before
anything is allocated, and an error names the path, the reason and what to do. Writing never replaces a file unless told
to, and then puts the new one in its place when it is complete. OpenEXR and Pillow are imported where they are needed:
`pip install shisd[io]`.
"""

from shisd.io._images import read_image as read_image
from shisd.io._images import tonemap as tonemap
from shisd.io._images import write_image as write_image
from shisd.io._merl import read_merl as read_merl
from shisd.io._merl import write_merl as write_merl
