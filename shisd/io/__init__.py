"""Files: environment maps (OpenEXR, Radiance), MERL materials, and PNG images.

Reading never trusts a file: only ordinary files are opened, sizes are checked against what the header promises before
anything is allocated, and an error names the path, the reason and what to do. Writing never replaces a file unless told
to, and then puts the new one in its place when it is complete. OpenEXR and Pillow are imported where they are needed:
`pip install shisd[io]`.
"""

from shisd.io._files import optional as optional
from shisd.io._files import ordinary as ordinary
from shisd.io._files import read_npz as read_npz
from shisd.io._files import refuse_existing as refuse_existing
from shisd.io._files import write_atomically as write_atomically
from shisd.io._images import read_image as read_image
from shisd.io._images import tonemap as tonemap
from shisd.io._images import write_image as write_image
from shisd.io._merl import MERL_BINS as MERL_BINS
from shisd.io._merl import merl_above_horizon as merl_above_horizon
from shisd.io._merl import merl_directions as merl_directions
from shisd.io._merl import read_merl as read_merl
from shisd.io._merl import tabulate_merl as tabulate_merl
from shisd.io._merl import write_merl as write_merl
